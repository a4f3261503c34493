"""Serial IMUs with binary frames: MicroStrain MIP, Xsens MTData2, STIM300, WitMotion.

Each sends its model's readings in the axes that the real device has, and obeys the commands that start and stop it.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from sim.aircraft import VirtualAircraft
from sim.devices import Frame, ImuDevice
from sim.earth import Array
from sim.imu_model import ImuModel

_G = 9.80665


def mip_packet(descriptor_set: int, *fields: tuple[int, bytes]) -> bytes:
    payload = b"".join(bytes((2 + len(data), descriptor)) + data for descriptor, data in fields)
    packet = bytes((0x75, 0x65, descriptor_set, len(payload))) + payload
    one = two = 0
    for byte in packet:
        one = (one + byte) % 256
        two = (two + one) % 256
    return packet + bytes((one, two))


class _Commanded(ImuDevice):
    """An IMU that answers known messages."""

    def __init__(self, imu: ImuModel, **line: Any) -> None:
        super().__init__(imu, **line)
        self._pending = b""

    ANSWERS: ClassVar[dict[bytes, tuple[bytes, bool | None]]]
    """Answer to each known message, and whether the device streams afterwards (None: unchanged)."""

    def command(self, data: bytes, t_s: float) -> bytes:
        """Obey each complete known message; skip unknown ones."""
        answer = b""
        self._pending += data
        while True:
            found = [
                (at, message) for message in self.ANSWERS if (at := self._pending.find(message)) >= 0
            ]  # fmt: skip
            if not found:
                self._pending = self._pending[-16:]
                return answer
            at, message = min(found)
            self._pending = self._pending[at + len(message) :]
            said, streaming = self.ANSWERS[message]
            answer += said
            if streaming is not None:
                self.streaming = streaming


class MipImu(_Commanded):
    """MicroStrain 3DM-GX5 or CV5: set 0x80 with GPS time, accelerometer (g), gyro, magnetometer (gauss); FRD axes."""

    protocol = "mip"
    baud = 115200
    ANSWERS: ClassVar[dict[bytes, tuple[bytes, bool | None]]] = {
        mip_packet(0x01, (command, b"")): (mip_packet(0x01, (0xF1, bytes((command, 0)))), streaming)
        for command, streaming in ((0x01, None), (0x02, False), (0x06, True))
    }
    """Answers, with acknowledgement 0xF1, to: ping, go idle, resume."""

    def encode(self, times_s: Array, first: int) -> list[bytes]:
        return [
            mip_packet(
                0x80,
                (0x12, struct.pack(">dHH", device_s, 0, 0)),
                (0x04, struct.pack(">3f", *(value / _G for value in reading[3:]))),
                (0x05, struct.pack(">3f", *reading[:3])),
            )
            for _, device_s, reading in self._readings(times_s, first)
        ]


def xbus_message(identifier: int, data: bytes = b"") -> bytes:
    length = bytes((len(data),)) if len(data) < 255 else b"\xff" + struct.pack(">H", len(data))
    body = bytes((0xFF, identifier)) + length + data
    return b"\xfa" + body + bytes((-sum(body) % 256,))


class XsensImu(_Commanded):
    """Xsens MTi on its base: X forward, Y left, Z up; packet counter, time, acceleration, rate, field, status."""

    protocol = "xsens"
    baud = 230400
    ANSWERS: ClassVar[dict[bytes, tuple[bytes, bool | None]]] = {
        xbus_message(0x10): (xbus_message(0x11), True),
        xbus_message(0x30): (xbus_message(0x31), False),
        xbus_message(0x3F): (b"", False),
    }
    """Answers to GoToMeasurement, GoToConfig and WakeUpAck."""

    def banner(self) -> bytes:
        return xbus_message(0x3E)

    def encode(self, times_s: Array, first: int) -> list[bytes]:
        messages = []
        for number, (time, device_s, reading) in enumerate(self._readings(times_s, first), first):
            gx, gy, gz, ax, ay, az = reading
            mx, my, mz = self.imu.mounting.T @ self.aircraft.field_gauss(time) / self.aircraft.site.field_gauss
            fields = (
                (0x1020, struct.pack(">H", number % 65536)),
                (0x1060, struct.pack(">I", round(device_s * 1e4) % 2**32)),
                (0x4020, struct.pack(">3f", ax, -ay, -az)),
                (0x8020, struct.pack(">3f", gx, -gy, -gz)),
                (0xC020, struct.pack(">3f", mx, -my, -mz)),
                (0xE020, struct.pack(">I", 0x81)),
            )
            messages.append(xbus_message(0x36, b"".join(struct.pack(">HB", i, len(d)) + d for i, d in fields)))
        return messages


def _crc_table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte << 24
        for _ in range(8):
            crc = (crc << 1 ^ 0x04C11DB7 if crc & 0x80000000 else crc << 1) & 0xFFFFFFFF
        table.append(crc)
    return table


_TABLE = _crc_table()


def stim_datagram(body: bytes) -> bytes:
    """Return a datagram with its CRC over the body and the zeros that fill its last word."""
    crc = 0xFFFFFFFF
    for byte in body + bytes(-len(body) % 4):
        crc = (crc << 8 & 0xFFFFFFFF) ^ _TABLE[crc >> 24 ^ byte]
    return body + struct.pack(">I", crc)


class Stim300(ImuDevice):
    """Sensonor STIM300 on its base, X forward, Y left, Z up: datagram 0xA7 with all but AUX (TS1524 rev. 31).

    Args:
        upside_down: on its lid instead: X forward, Y right, Z down.
        inclination_noise_g: of each inclinometer.
    """

    protocol = "stim300"
    baud = 921600
    default_rate_hz = 250.0
    LATENCY_S = 506e-6
    TICKS_A_SECOND = 2000
    RANGE_CODE, ACCEL_BITS = 0, 19
    """Code of 10 g accelerometers in the configuration datagram, and their number of bits after the binary point."""

    def __init__(
        self,
        imu: ImuModel,
        *,
        upside_down: bool = False,
        inclination_noise_g: float = 1e-5,
        seed: int = 0,
        **line: Any,
    ) -> None:
        super().__init__(imu, **line)
        self.upside_down, self.inclination_noise_g = upside_down, inclination_noise_g
        self._random = np.random.default_rng([seed, 7])

    def banner(self) -> bytes:
        """Send part number, serial number and configuration."""
        code = self.RANGE_CODE
        settings = bytearray(22)
        settings[0] = 0xBC
        settings[1:5] = b"\x52\x01\x2e\x20"  # 250 Hz; temperature, inclination, acceleration
        settings[5] = settings[8] = settings[11] = 0x70  # all axes active; rate, acceleration
        settings[17], settings[18] = code << 4 | code, code << 4
        part, serial = b"\xb1" + bytes(15), b"\xb5N" + bytes(14)
        return b"".join(stim_datagram(each) for each in (part, serial, bytes(settings)))

    def frames_until(self, t_s: float) -> list[Frame]:
        """Return the frames; each describes a moment shortly before its transmission."""
        return [frame._replace(sampled_s=frame.sampled_s - self.LATENCY_S) for frame in super().frames_until(t_s)]

    def encode(self, times_s: Array, first: int) -> list[bytes]:
        sampled_s = times_s - self.LATENCY_S
        g = (self.aircraft.truth(sampled_s).force_m_s2 @ self.imu.mounting) / _G
        inclinations = g + self.inclination_noise_g * self._random.standard_normal(g.shape)
        signs = np.array([1.0, 1.0, 1.0] if self.upside_down else [1.0, -1.0, -1.0])
        datagrams = []
        readings = self._readings(sampled_s, first)
        for (time, device_s, reading), inclination in zip(readings, inclinations, strict=True):
            rate_deg_s = np.degrees(reading[:3]) * signs
            accel_g = np.asarray(reading[3:]) / _G * signs
            body = bytes((0xA7,)) + _cluster(rate_deg_s, 14) + _cluster(accel_g, self.ACCEL_BITS)
            body += _cluster(inclination * signs, 22)
            degrees = round(self.imu.temperature_degc(time) * 256)
            body += 3 * (struct.pack(">3h", degrees, degrees, degrees) + b"\0")
            ticks = round(device_s * self.TICKS_A_SECOND) % 256
            body += struct.pack(">BH", ticks, round(self.LATENCY_S * 1e6))
            datagrams.append(stim_datagram(body))
        return datagrams


def _cluster(values: Sequence[float] | Array, bits: int) -> bytes:
    """Encode three values as 24-bit numbers with `bits` after the point, and a status without fault."""
    counts = [max(-(2**23), min(2**23 - 1, round(float(value) * 2**bits))) for value in values]
    return b"".join(struct.pack(">i", count)[1:] for count in counts) + b"\0"


WIT_Z_UP = (180.0, 0.0, 0.0)
"""Mounting of a WitMotion device with X forward, Y left, Z up: roll, pitch, yaw of its axes seen from the vehicle's."""


def wit_packet(kind: int, values: Sequence[float], last: int = 0) -> bytes:
    """Encode a packet of three numbers limited to 16 bits, a fourth number, and the checksum."""
    cut = [max(-32768, min(32767, round(value))) for value in values]
    body = bytes([0x55, kind]) + struct.pack("<4h", *cut, last)
    return body + bytes([sum(body) % 256])


def wit_angles_deg(aircraft: VirtualAircraft, t_s: float, mounting: Array) -> tuple[float, float, float]:
    """Return roll, pitch, yaw of the device's apparent attitude: rotations Z-Y-X from east, north, up to its axes."""
    x, y, z = (mounting.T @ aircraft.truth_at(t_s).force_m_s2).tolist()
    roll, pitch = math.degrees(math.atan2(y, z)), math.degrees(math.atan2(-x, math.hypot(y, z)))
    north, east, _ = (aircraft.body_from_ned(t_s).T @ mounting[:, 0]).tolist()
    return roll, pitch, math.degrees(math.atan2(north, east))


class WitMotionImu(ImuDevice):
    """WitMotion nine-axis device at 200 Hz: 11-byte frames of acceleration, rate, angles, field.

    WT901 data sheet p. 10-14, WT901SDCL p. 13-16. Its axes are those of the IMU's mounting.
    """

    protocol = "witmotion"
    baud = 115200

    def encode(self, times_s: Array, first: int) -> list[bytes]:
        return [self._epoch(time, reading) for time, _, reading in self._readings(times_s, first)]

    def _epoch(self, t_s: float, reading: Sequence[float]) -> bytes:
        degc = round(self.imu.temperature_degc(t_s) * 100.0)
        angles = wit_angles_deg(self.aircraft, t_s, self.imu.mounting)
        field_mg = (self.imu.mounting.T @ self.aircraft.field_gauss(t_s) * 1000.0).tolist()
        return (
            wit_packet(0x51, [value / _G / 16.0 * 32768.0 for value in reading[3:]], degc)
            + wit_packet(0x52, [math.degrees(value) / 2000.0 * 32768.0 for value in reading[:3]], degc)
            + wit_packet(0x53, [angle / 180.0 * 32768.0 for angle in angles])
            + wit_packet(0x54, field_mg, degc)
        )
