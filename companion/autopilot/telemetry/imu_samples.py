"""Samples of one of the autopilot's IMUs from the readings in its messages: the same for the daemon and a replay."""

from __future__ import annotations

import math
from typing import Final

import msgspec
import numpy as np

from companion.autopilot.firmware.imu_messages import Reading
from companion.samples import ImuSample

TEMPERATURE_AGE_S: Final = 5.0
"""The longest that a temperature counts: HIGHRES_IMU has none of the IMU, so it comes with the integer messages."""
_LATE_S: Final = 0.5
"""A device time that goes back by less is a repeated or late message; by more, the autopilot has restarted."""
_WALK: Final = np.repeat([2.4e-6, 3e-5], 3)
"""Random walk of the EKF's bias estimate in one second at rest, rad/s and m/s^2: 0.5 deg/h and 3 micro-g (real PX4: 0.2
to 0.5 deg/h)."""

Six = tuple[float, float, float, float, float, float]


class EkfBiasReading(msgspec.Struct, frozen=True):
    """Bias that PX4's EKF takes off HIGHRES_IMU, as read at its console."""

    bias: Six
    """Gyro in rad/s, accelerometer in m/s^2."""
    variance: Six
    """Squares of the same units."""
    read_s: float

    def restored(self, reading: Reading, now_s: float) -> tuple[Reading, Six]:
        """Return a HIGHRES_IMU as it was before the bias was taken off, and the variances of that bias."""
        gx, gy, gz, ax, ay, az = (np.array(reading.gyro_rad_s + reading.accel_m_s2) + self.bias).tolist()
        variance: Six = tuple((np.array(self.variance) + np.square(_WALK) * (now_s - self.read_s)).tolist())
        return Reading(reading.t_device_s, (gx, gy, gz), (ax, ay, az), None), variance


class ImuSamples:
    """Turns readings into samples. Knows no clock: time comes in with the messages."""

    def __init__(self) -> None:
        self.temperature: tuple[float, float] | None = None
        """Temperature of the IMU in deg C and its time; None: none since the restart."""
        self._device_s: dict[str, float] = {}

    def accept(self, message: str, reading: Reading, t_s: float) -> bool:
        """Note the reading's temperature; False: the message is repeated or late."""
        if -_LATE_S < reading.t_device_s - self._device_s.get(message, -math.inf) <= 0.0:
            return False
        self._device_s[message] = reading.t_device_s
        if reading.temperature_degc is not None:
            self.temperature = (reading.temperature_degc, t_s)
        return True

    def temperature_degc(self, now_s: float) -> float | None:
        """Return the IMU's temperature, unless it is too old."""
        known = self.temperature
        return None if known is None or now_s - known[1] > TEMPERATURE_AGE_S else known[0]

    def sample(self, reading: Reading, t_s: float, bias: EkfBiasReading | None = None) -> ImuSample:
        """Return the sample of a reading that was accepted; `bias` is added to it."""
        variance = None
        if bias is not None:
            reading, variance = bias.restored(reading, t_s)
        degc = self.temperature_degc(t_s)
        return ImuSample(
            t_s, reading.gyro_rad_s, reading.accel_m_s2, degc, None, reading.t_device_s, shared_variance=variance
        )
