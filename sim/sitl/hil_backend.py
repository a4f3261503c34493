"""The physics of a PX4 SITL: a TCP server that feeds HIL_SENSOR in lockstep with HIL_ACTUATOR_CONTROLS.

Time in HIL_SENSOR is what the firmware sets its clock to, so it starts near zero at every boot. Sensor 0 also carries
magnetometer and barometer; the firmware passes sensor 0's IMU values through 16 bits, sensor 1's unchanged
(autopilots 9.3).
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import socket
from collections.abc import Sequence
from typing import Self, cast

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import VirtualAircraft
from sim.earth import STANDARD_GRAVITY_M_S2, body_from_ned
from sim.firmware.compass import SimCompass
from sim.firmware.messages import pressure_hpa
from sim.imu_model import ImuModel
from sim.sitl.samples import Sample, SampleBlocks

IMU_FIELDS = 0o77
MAGNETOMETER_FIELDS = 0o700
BAROMETER_FIELDS = 0x200 | 0x800 | 0x1000
"""Flags for absolute pressure, pressure altitude and temperature, but not for differential pressure."""
ARMED_FLAG = mavlink.MAV_MODE_FLAG_SAFETY_ARMED


FIFO_STEPS = (math.radians(2000.0 / 32768.0),) * 3 + (STANDARD_GRAVITY_M_S2 / 2048.0,) * 3
"""Steps to which the firmware's simulator truncates sensor 0 (16-bit numbers): rad/s, m/s^2."""
_ABOVE = 1e-3


def on_fifo_grid(reading: Sequence[float]) -> list[float]:
    """Round a reading of sensor 0 to the firmware's steps, so that its truncation changes nothing.

    A real sensor rounds. Left to the firmware, half a step (110 deg/h, 0.24 mg) would go missing on every axis, and the
    sensor's bias would not be the model's.
    """
    steps = [round(value / step) for value, step in zip(reading, FIFO_STEPS, strict=True)]
    # A little beyond the number, or the conversion may fall back to the one before.
    return [(n + math.copysign(_ABOVE, n)) * step if n else 0.0 for n, step in zip(steps, FIFO_STEPS, strict=True)]


class Codec:
    """Packs the simulator's messages, and finds HIL_ACTUATOR_CONTROLS in the answers; never raises on bytes."""

    def __init__(self) -> None:
        self._codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
        self._codec.robust_parsing = True

    def sensor(
        self,
        time_us: int,
        number: int,
        reading: Sequence[float],
        *,
        magnetic_gauss: Sequence[float] | None = None,
        barometer: tuple[float, float, float] | None = None,
    ) -> bytes:
        """Encode HIL_SENSOR of one IMU.

        Args:
            time_us: time since boot.
            number: 0 or 1.
            reading: three rates (rad/s), three specific forces (m/s^2).
            magnetic_gauss: field in body axes, when the magnetometer has a new one.
            barometer: pressure (hPa), pressure altitude (m), temperature (degC), when new.
        """
        gx, gy, gz, ax, ay, az = reading
        fields = IMU_FIELDS
        mx = my = mz = 0.0
        pressure = altitude = temperature = 0.0
        if magnetic_gauss is not None:
            fields |= MAGNETOMETER_FIELDS
            mx, my, mz = magnetic_gauss
        if barometer is not None:
            fields |= BAROMETER_FIELDS
            pressure, altitude, temperature = barometer
        return self._pack(
            mavlink.MAVLink_hil_sensor_message(
                time_us, ax, ay, az, gx, gy, gz, mx, my, mz, pressure, 0.0, altitude, temperature, fields, number
            )
        )

    def gps(self, unix_us: int, latitude_e7: int, longitude_e7: int, height_mm: int) -> bytes:
        """Encode HIL_GPS: a good 3D fix at rest. The time is the date, unlike in HIL_SENSOR."""
        return self._pack(
            mavlink.MAVLink_hil_gps_message(
                unix_us, 3, latitude_e7, longitude_e7, height_mm, 30, 40, 0, 0, 0, 0, 65535, 14
            )
        )

    def actuator_controls(self, data: bytes) -> list[tuple[int, bool]]:
        """Return time in us and armed flag of every HIL_ACTUATOR_CONTROLS in the bytes."""
        try:
            messages = self._codec.parse_buffer(data) or ()
        except Exception:  # noqa: BLE001 - the generated parser's own faults on garbage
            self._codec.buf = bytearray()
            self._codec.buf_index = 0
            return []
        return [
            (int(message.time_usec), bool(message.mode & ARMED_FLAG))
            for message in messages
            if isinstance(message, mavlink.MAVLink_hil_actuator_controls_message)
        ]

    def _pack(self, message: mavlink.MAVLink_message) -> bytes:
        data: bytes = message.pack(self._codec)
        self._codec.seq = (self._codec.seq + 1) % 256
        return data


FRAME_HZ = 250
SLOW_EVERY = FRAME_HZ // 50
"""Number of frames between readings of magnetometer and barometer."""
GPS_EVERY = FRAME_HZ // 5
LOCKSTEP_TIMEOUT_S = 0.2
"""Timeout of the answer to a frame; then we go on alone. The firmware answers every frame once its outputs run."""
MAX_BEHIND_S = 0.25
"""Delay in s beyond which late frames are skipped."""
_MAGNETIC_NOISE_GAUSS = 0.0005
_PRESSURE_NOISE_HPA = 0.01
_POSITION_NOISE_E7 = 1.0


class HilBackend:
    """Two IMUs, magnetometer, barometer and GNSS for one firmware. An async context manager on a real event loop.

    Args:
        aircraft: the truth.
        imus: one or two models; the first becomes sensor 0, which the firmware reads through 16 bits.
        port: TCP port on 127.0.0.1 (the firmware wants 4560 plus its instance); 0 takes a free one, see `port`.
        seed: seed of the noise of magnetometer, barometer and GNSS.
    """

    def __init__(
        self,
        aircraft: VirtualAircraft,
        imus: Sequence[ImuModel],
        *,
        port: int = 0,
        seed: int = 0,
    ) -> None:
        if not 1 <= len(imus) <= 2:
            raise ValueError(f"imus: found {len(imus)}; allowed: 1 or 2")
        self._aircraft = aircraft
        # Rounded once: a sensor's finer steps would all but fall on the middle between two of the firmware's.
        first = imus[0].in_steps(FIFO_STEPS[0], FIFO_STEPS[3])
        self.blocks = SampleBlocks(aircraft, [first, *imus[1:]])
        self._wanted_port = port
        self.compass = SimCompass()
        self.gnss = True
        self._random = np.random.default_rng([seed, 7])
        self._server: asyncio.Server | None = None
        self._driving: asyncio.Task[None] | None = None
        self._answered = asyncio.Event()
        self.locked = False
        """True: the firmware answers our frames."""
        self.port = 0
        self.boots = 0
        """Number of connections, one for each start of the firmware."""
        self.frames = 0
        """Number of frames sent since the last boot."""
        self.unanswered = 0
        """Number of frames without an answer in time after the firmware had begun to answer."""
        self.armed = False
        """True: armed, according to the firmware's outputs."""

    @property
    def physics_s(self) -> float:
        return self.frames / FRAME_HZ

    async def __aenter__(self) -> Self:
        self._aircraft.begin(asyncio.get_running_loop().time())
        self._server = await asyncio.start_server(self._connected, "127.0.0.1", self._wanted_port)
        self.port = self._server.sockets[0].getsockname()[1]
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        if self._server is not None:
            self._server.close()
        if self._driving is not None:
            self._driving.cancel()
            await asyncio.gather(self._driving, return_exceptions=True)
            self._driving = None
        if self._server is not None:
            await self._server.wait_closed()
            self._server = None

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Handle a connection; an earlier firmware, if any, has ended."""
        if self._driving is not None:
            self._driving.cancel()
        cast("socket.socket", writer.get_extra_info("socket")).setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        codec = Codec()
        self.blocks.restart()
        self._answered.clear()
        self.locked = self.armed = False
        self.boots += 1
        self.frames = 0
        driving = self._driving = asyncio.create_task(self._drive(codec, writer), name="hil frames")
        try:
            while data := await reader.read(4096):
                for _, armed in codec.actuator_controls(data):
                    self.armed = armed
                    self.locked = True
                    self._answered.set()
        except OSError:  # the firmware has gone
            pass
        finally:
            driving.cancel()
            writer.close()
            with contextlib.suppress(OSError):
                await writer.wait_closed()

    async def _drive(self, codec: Codec, writer: asyncio.StreamWriter) -> None:
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        try:
            while True:
                self._answered.clear()
                self.frames += 1
                writer.write(self._frame(codec, self.blocks.next(1.0 / FRAME_HZ, self._aircraft.time_at(loop.time()))))
                await writer.drain()
                if self.locked and not self._answered.is_set():
                    await self._wait_answer()
                due_s += 1.0 / FRAME_HZ
                behind_s = loop.time() - due_s
                if behind_s > MAX_BEHIND_S:
                    due_s += behind_s
                await asyncio.sleep(max(-behind_s, 0.0))
        except OSError:  # the firmware has gone; the reader sees it too
            return

    async def _wait_answer(self) -> None:
        try:
            async with asyncio.timeout(LOCKSTEP_TIMEOUT_S):
                await self._answered.wait()
        except TimeoutError:
            self.unanswered += 1

    def _frame(self, codec: Codec, sample: Sample) -> bytes:
        """Encode everything that is new at this instant; sensor 0 first, since it moves the firmware's clock."""
        number = self.frames
        time_us = number * 1_000_000 // FRAME_HZ
        magnetic: list[float] | None = None
        barometer: tuple[float, float, float] | None = None
        if number % SLOW_EVERY == 0:
            attitude, noise = body_from_ned(*sample.angles_rad), self._random.standard_normal(4)
            field = self.compass.reading(attitude, 1e3 * self._aircraft.site.field_ned_gauss, self._random) * 1e-3
            magnetic = (field + _MAGNETIC_NOISE_GAUSS * noise[:3]).tolist()
            height = self._aircraft.site.height_m
            pressure = pressure_hpa(height) + _PRESSURE_NOISE_HPA * float(noise[3])
            barometer = (pressure, height, self._aircraft.temperature_degc(sample.t_s))
        data = codec.sensor(time_us, 0, on_fifo_grid(sample.readings[0]), magnetic_gauss=magnetic, barometer=barometer)
        for other, reading in enumerate(sample.readings[1:], 1):
            data += codec.sensor(time_us, other, reading)
        if self.gnss and number % GPS_EVERY == 0:
            data += self._gps(codec, sample.t_s)
        return data

    def _gps(self, codec: Codec, t_s: float) -> bytes:
        site = self._aircraft.site
        north, east = (self._random.standard_normal(2) * _POSITION_NOISE_E7).tolist()
        return codec.gps(
            int((self._aircraft.unix_s + t_s) * 1e6),
            round(site.latitude_deg * 1e7 + north),
            round(site.longitude_deg * 1e7 + east),
            round(site.height_m * 1000.0),
        )
