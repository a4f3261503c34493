"""One IMU of the PX4 double, with its estimator: means over an interval, corrected for offset and temperature.

A sample is the mean of the sensor over one interval, so its white noise is N / sqrt(interval). It is independent of the
next sample's (real outputs at 4 ms: autopilots 9.3.2). Rounding inside the sensor adds white noise only.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sim.earth import STANDARD_GRAVITY_M_S2, Array
from sim.imu_model import ImuModel
from sim.px4.calibration import SensorCalibration
from sim.px4.parameters import PX4Parameters

ACCEL_LIMIT_M_S2, GYRO_LIMIT_RAD_S = 0.4, 0.15
"""Limits of EKF2's bias estimates (EKF2_ABL_LIM, EKF2_GYR_B_LIM)."""
_LEARNS_S = 1.05
_SHARE_EARLY, _SHARE_LATE, _SETTLES_S = 0.3, 0.2, 60.0
"""Share of a horizontal change that goes into the tilt: about half soon after a start, a fifth later."""
_PUBLISHED_EVERY_S, _PUBLISHED_STEP = 1.0, 0.001
_WANDER = np.array([0.4 * math.radians(1.0 / 3600.0)] * 3 + [5e-6 * STANDARD_GRAVITY_M_S2] * 3)
"""Sigma of the wander from one publication to the next; the sum decays by a fiftieth each time."""
_OBVIOUS_M_S2 = 0.5
"""Size of an error above which EKF2 takes it for tilt, not bias."""


class Ekf2:
    """A coarse stand-in for EKF2: its bias estimates, and the tilt that has absorbed the accelerometer's bias.

    States are in vehicle FRD; `update` takes the current errors of the corrected IMU output (output minus truth).

    Gyro biases and the vertical accelerometer bias are estimated within seconds; the Earth's rotation is known. At the
    start, a horizontal accelerometer bias goes into the tilt. A later change goes mostly into a bias estimate: after a
    write, the old tilt stays for minutes or until a reboot. A new offset clears the estimate (autopilots 9.2, 9.3.2).

    Biases are published once a second, or as soon as one has moved by 0.001 (rad/s, m/s^2), and are constant between
    (`PublishSensorBias` of EKF2.cpp). At rest they wander: 0.2 to 0.5 deg/h, up to 10 micro-g in the real firmware.
    """

    def __init__(self, seed: int = 0) -> None:
        self.published = np.zeros(6)
        """Biases in the telemetry: rad/s, m/s^2."""
        self._published_s = 0.0
        self._random, self._wander = np.random.default_rng([seed, 11]), np.zeros(6)
        self.gyro_bias_rad_s = np.zeros(3)
        self.accel_bias_m_s2 = np.zeros(3)
        self._tilt_m_s2 = np.zeros(2)
        """Horizontal specific force, x and y, that corresponds to the tilt error."""
        self._started_s = 0.0
        self.time_s = 0.0
        """Time of the last update."""
        self.accel_steady_since_s = self.gyro_steady_since_s = 0.0

    def reset(self, t_s: float, accel_error: Array) -> None:
        """Start at this time: the accelerometer defines the horizontal."""
        self.gyro_bias_rad_s, self.accel_bias_m_s2 = np.zeros(3), np.zeros(3)
        self.published, self._published_s = np.zeros(6), t_s
        self._tilt_m_s2 = accel_error[:2].copy()
        self.time_s = self._started_s = t_s
        self.accel_steady_since_s = self.gyro_steady_since_s = t_s

    def forget_gyro_bias(self) -> None:
        """Handle a new gyro offset."""
        self.gyro_bias_rad_s = np.zeros(3)
        self.gyro_steady_since_s = self.time_s

    def forget_accel_bias(self) -> None:
        """Handle a new accelerometer offset or scale. The tilt stays."""
        self.accel_bias_m_s2 = np.zeros(3)
        self.accel_steady_since_s = self.time_s

    @property
    def tilt_error_rad(self) -> tuple[float, float]:
        x, y = self._tilt_m_s2 / STANDARD_GRAVITY_M_S2
        return -float(y), float(x)

    def update(self, t_s: float, gyro_error: Array, accel_error: Array) -> None:
        """Advance to this time, with the errors (output minus truth) since the last update."""
        span = max(t_s - self.time_s, 0.0)
        learnt = 1.0 - math.exp(-span / _LEARNS_S)
        self.gyro_bias_rad_s += learnt * (gyro_error - self.gyro_bias_rad_s)
        np.clip(self.gyro_bias_rad_s, -GYRO_LIMIT_RAD_S, GYRO_LIMIT_RAD_S, out=self.gyro_bias_rad_s)
        self.accel_bias_m_s2[2] += learnt * (accel_error[2] - self.accel_bias_m_s2[2])
        mismatch = accel_error[:2] - self.accel_bias_m_s2[:2] - self._tilt_m_s2
        share = _SHARE_LATE + _SHARE_EARLY * math.exp(-(self.time_s - self._started_s) / _SETTLES_S)
        if math.hypot(*mismatch) > _OBVIOUS_M_S2:
            share = 1.0
        self._tilt_m_s2 += learnt * share * mismatch
        self.accel_bias_m_s2[:2] += learnt * (1.0 - share) * mismatch
        np.clip(self.accel_bias_m_s2, -ACCEL_LIMIT_M_S2, ACCEL_LIMIT_M_S2, out=self.accel_bias_m_s2)
        self.time_s = t_s
        now = np.concatenate((self.gyro_bias_rad_s, self.accel_bias_m_s2))
        off = (now + self._wander - self.published).tolist()
        moved = max(math.hypot(*off[:3]), math.hypot(*off[3:])) > _PUBLISHED_STEP
        if moved or t_s - self._published_s >= _PUBLISHED_EVERY_S:
            self._wander = 0.98 * self._wander + _WANDER * self._random.standard_normal(6)
            self.published, self._published_s = now + self._wander, t_s


RAW_RATE_HZ = 1000.0
"""Rate of the sensor's own samples, whose rounding adds white noise."""


class VehicleImuSample(NamedTuple):
    t_s: float
    """End of the interval, aircraft time."""
    output: Array
    """Corrected rates and specific forces (6) in vehicle FRD."""


class VehicleImu:
    """IMU number `index` from 0, in the order of its uORB instances. Times are aircraft time."""

    def __init__(
        self,
        model: ImuModel,
        index: int,
        device_id: int,
        store: PX4Parameters,
        *,
        external: bool,
        rate_hz: float,
        seed: int,
    ) -> None:
        self.model, self.index, self.device_id, self.external = model, index, device_id, external
        self.interval_s = 1.0 / rate_hz
        self.estimator = Ekf2(seed * 10 + index)
        self._store = store
        self._random = np.random.default_rng([seed, 3, index])
        steps = np.repeat([model.spec.gyro.step, model.spec.accel.step], 3)
        density = np.sqrt(model.white**2 + steps**2 / 12.0 / RAW_RATE_HZ)
        self.density = density
        """White noise of the six axes that the firmware sees, in unit * sqrt(s)."""
        self._noise = np.empty((0, 6))
        self._last: VehicleImuSample | None = None
        self.restart()

    def restart(self) -> None:
        """Handle a boot: read all parameters again."""
        self.gyro = SensorCalibration("GYRO", self.device_id, self._store, external=self.external)
        self.accel = SensorCalibration("ACC", self.device_id, self._store, external=self.external)
        self._last = None

    @property
    def calibrated(self) -> bool:
        """True: both triads have a slot."""
        return self.gyro.calibrated and self.accel.calibrated

    def correct(self, raw: Array) -> Array:
        result: Array = np.concatenate((self.gyro.correct(raw[:3]), self.accel.correct(raw[3:])))
        return result

    def corrected(self, t_s: float) -> Array:
        """Return the output without noise (6): rates and specific forces in vehicle FRD."""
        return self.correct(self.model.expected(t_s))

    def sample(self, t_s: float) -> VehicleImuSample:
        """Return the newest sample at this time; it is constant within the interval."""
        end_s = math.floor(t_s / self.interval_s + 1e-6) * self.interval_s
        if self._last is None or end_s > self._last.t_s + 1e-9:
            if not len(self._noise):
                self._noise = self._random.standard_normal((256, 6)) * (self.density / math.sqrt(self.interval_s))
            noise, self._noise = self._noise[-1], self._noise[:-1]
            reading = self.correct(self.model.expected(end_s - self.interval_s / 2.0) + noise)
            self._last = VehicleImuSample(end_s, reading)
        return self._last

    def raw_mean(self, t_s: float, over_s: float) -> Array:
        """Return the sensor's mean (6) until this time, uncorrected, in vehicle FRD; repeated calls agree."""
        seed = [round(t_s / over_s), self.index, 7]
        noise = np.random.default_rng(seed).standard_normal(6) * (self.density / math.sqrt(over_s))
        raw = self.model.expected(t_s - over_s / 2.0) + noise
        result: Array = np.concatenate((self.gyro.rotation @ raw[:3], self.accel.rotation @ raw[3:]))
        return result
