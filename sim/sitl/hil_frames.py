"""PX4's simulator messages, bytes only: HIL_SENSOR and HIL_GPS out, HIL_ACTUATOR_CONTROLS in (autopilots 9.3).

Time in HIL_SENSOR is what the firmware sets its clock to, so it starts near zero at every boot. Sensor 0 also carries
magnetometer and barometer; the firmware passes its IMU values through 16 bits, those of sensor 1 as they are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.earth import STANDARD_GRAVITY_M_S2

IMU_FIELDS = 0o77
MAGNETOMETER_FIELDS = 0o700
BAROMETER_FIELDS = 0x200 | 0x800 | 0x1000
"""Absolute pressure, pressure altitude, temperature; without differential pressure."""
ARMED_FLAG = mavlink.MAV_MODE_FLAG_SAFETY_ARMED


FIFO_STEPS = (math.radians(2000.0 / 32768.0),) * 3 + (STANDARD_GRAVITY_M_S2 / 2048.0,) * 3
"""What the firmware's simulator makes of sensor 0: 16-bit numbers, cut off towards zero."""
_ABOVE = 1e-3


def on_fifo_grid(reading: Sequence[float]) -> list[float]:
    """A reading of sensor 0, in the firmware's steps already, put so that its cutting off changes nothing.

    A real sensor rounds. Left to the firmware, half a step (110 deg/h, 0.24 mg) would go missing on every axis, and
    the sensor's bias would not be the model's.
    """
    steps = [round(value / step) for value, step in zip(reading, FIFO_STEPS, strict=True)]
    # A little beyond the number, or the conversion may fall back to the one before.
    return [(n + math.copysign(_ABOVE, n)) * step if n else 0.0 for n, step in zip(steps, FIFO_STEPS, strict=True)]


def pressure_hpa(height_m: float) -> float:
    """Static pressure of the standard atmosphere."""
    return float(1013.25 * (1.0 - height_m / 44330.8) ** 5.25588)


class Codec:
    """Packs what a simulator says, and finds HIL_ACTUATOR_CONTROLS in what comes back; never raises on bytes."""

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
        """HIL_SENSOR of one IMU.

        Args:
            time_us: since boot.
            number: 0 or 1.
            reading: three rates (rad/s), three specific forces (m/s^2).
            magnetic_gauss: in body axes, when the magnetometer has something new.
            barometer: pressure (hPa), pressure altitude (m), temperature (degC), when that has.
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
        """HIL_GPS: a good 3D fix at rest. The time is the date, unlike in HIL_SENSOR."""
        return self._pack(
            mavlink.MAVLink_hil_gps_message(
                unix_us, 3, latitude_e7, longitude_e7, height_mm, 30, 40, 0, 0, 0, 0, 65535, 14
            )
        )

    def actuator_controls(self, data: bytes) -> list[tuple[int, bool]]:
        """Of every HIL_ACTUATOR_CONTROLS in the bytes: its time in us, and whether the vehicle is armed."""
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
