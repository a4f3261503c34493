"""WitMotion devices: 11-byte frames that begin with 0x55 (WT901 data sheet p. 10-14; WT901SDCL p. 13-16).

Axes are as the device is mounted, and Z up is the maker's: `WT901` and `WT901SDCL` are mountings that lie flat.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Final

import numpy as np

from sim.aircraft import VirtualAircraft
from sim.devices import ImuDevice, SerialDevice
from sim.earth import Array, mounting_matrix
from sim.imu_model import ImuModel

WT901: Final = (180.0, 0.0, 90.0)
"""Mounting of a device with X right, Y forward, Z up: roll, pitch, yaw of its axes seen from the vehicle's FRD."""
WT901SDCL: Final = (180.0, 0.0, 0.0)
"""The same with X forward, Y left, Z up."""


def packet(kind: int, values: Sequence[float], last: int = 0) -> bytes:
    """Three numbers cut to 16 bits, a fourth, and the sum."""
    cut = [max(-32768, min(32767, round(value))) for value in values]
    body = bytes([0x55, kind]) + struct.pack("<4h", *cut, last)
    return body + bytes([sum(body) % 256])


def angles_deg(aircraft: VirtualAircraft, t_s: float, mounting: Array) -> tuple[float, float, float]:
    """Roll, pitch and yaw, turned Z-Y-X from east, north, up to the device's own axes, of its apparent attitude."""
    x, y, z = (mounting.T @ aircraft.truth_at(t_s).force_m_s2).tolist()
    roll, pitch = math.degrees(math.atan2(y, z)), math.degrees(math.atan2(-x, math.hypot(y, z)))
    north, east, _ = (aircraft.body_from_ned(t_s).T @ mounting[:, 0]).tolist()
    return roll, pitch, math.degrees(math.atan2(north, east))


class WitMotionImu(ImuDevice):
    """A nine-axis device set to 115200 baud and 200 Hz: acceleration, rate, angles, field, as it comes.

    Its axes are those of the IMU's mounting.
    """

    protocol = "witmotion"
    baud = 115200

    def __init__(self, imu: ImuModel, *, rate_hz: float | None = None, clock_ppm: float = 0.0) -> None:
        super().__init__(imu, rate_hz=rate_hz, clock_ppm=clock_ppm)

    def encode(self, times_s: Array, first: int) -> list[bytes]:
        """Four frames a sample."""
        return [self._epoch(time, reading) for time, _, reading in self._readings(times_s, first)]

    def _epoch(self, t_s: float, reading: Sequence[float]) -> bytes:
        degc = round(self.imu.temperature_degc(t_s) * 100.0)
        angles = angles_deg(self.aircraft, t_s, self.imu.mounting)
        declination = math.radians(self.aircraft.site.declination_deg)
        ned_mg = np.array([280.0 * math.cos(declination), 280.0 * math.sin(declination), 450.0])
        field = (self.imu.mounting.T @ self.aircraft.body_from_ned(t_s) @ ned_mg).tolist()
        return (
            packet(0x51, [value / 9.80665 / 16.0 * 32768.0 for value in reading[3:]], degc)
            + packet(0x52, [math.degrees(value) / 2000.0 * 32768.0 for value in reading[:3]], degc)
            + packet(0x53, [angle / 180.0 * 32768.0 for angle in angles])
            + packet(0x54, field, degc)
        )


class WitMotionInclinometer(SerialDevice):
    """SINxT: angles only, 10 a second, X forward, Y left, Z up."""

    protocol = "witmotion"
    baud = 9600
    default_rate_hz = 10.0

    def __init__(
        self,
        aircraft: VirtualAircraft,
        *,
        seed: int = 0,
        noise_deg: float = 0.003,
        offset_deg: tuple[float, float] = (0.0, 0.0),
        mounting_deg: tuple[float, float, float] = WT901SDCL,
        rate_hz: float | None = None,
        clock_ppm: float = 0.0,
    ) -> None:
        super().__init__(aircraft, rate_hz=rate_hz, clock_ppm=clock_ppm)
        self.noise_deg, self.offset_deg = noise_deg, offset_deg
        self._mounting = mounting_matrix(*mounting_deg)
        self._random = np.random.default_rng([seed, 23])

    def encode(self, times_s: Array, first: int) -> list[bytes]:
        """One frame a sample; the offsets are those of roll and pitch as it counts them."""
        return [self._frame(float(time)) for time in times_s]

    def _frame(self, t_s: float) -> bytes:
        roll, pitch, yaw = angles_deg(self.aircraft, t_s, self._mounting)
        noise = self.noise_deg * self._random.standard_normal(2)
        roll, pitch = roll + self.offset_deg[0] + float(noise[0]), pitch + self.offset_deg[1] + float(noise[1])
        return packet(0x53, [angle / 180.0 * 32768.0 for angle in (roll, pitch, yaw)])
