"""One IMU of the PX4 double: means over an integration interval, corrected, and its estimator.

A sample is the mean of the sensor over one interval, so its white noise is N / sqrt(interval) and independent of the
next one's (the real one's outputs at 4 ms: autopilots 9.3.2); rounding inside the sensor adds white noise only.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sim.earth import Array
from sim.imu_model import ImuModel
from sim.px4.calibration import SensorCalibration
from sim.px4.estimator import Ekf2
from sim.px4.parameters import ParameterStore

RAW_RATE_HZ = 1000.0
"""Rate of the sensor's own samples; their rounding adds white noise."""


class Sample(NamedTuple):
    """What `vehicle_imu` says."""

    t_s: float
    """End of the interval, aircraft time."""
    output: Array
    """Corrected rates and specific forces (6), vehicle FRD."""


class VehicleImu:
    """IMU number `index` from 0, in the order of its uORB instances. Times are aircraft time."""

    def __init__(
        self,
        model: ImuModel,
        index: int,
        device_id: int,
        store: ParameterStore,
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
        """White noise of the six axes as the firmware sees it, unit * sqrt(s)."""
        self._noise = np.empty((0, 6))
        self._last: Sample | None = None
        self.restart()

    def restart(self) -> None:
        """A boot: everything is read anew."""
        self.gyro = SensorCalibration("GYRO", self.device_id, self._store, external=self.external)
        self.accel = SensorCalibration("ACC", self.device_id, self._store, external=self.external)
        self._last = None

    @property
    def calibrated(self) -> bool:
        """Both triads have a slot."""
        return self.gyro.calibrated and self.accel.calibrated

    def correct(self, raw: Array) -> Array:
        """Six raw values, corrected."""
        result: Array = np.concatenate((self.gyro.correct(raw[:3]), self.accel.correct(raw[3:])))
        return result

    def corrected(self, t_s: float) -> Array:
        """The output without noise (6): rates and specific forces in vehicle FRD."""
        return self.correct(self.model.expected(t_s))

    def sample(self, t_s: float) -> Sample:
        """The newest sample at this time; asked again within the interval it is the same."""
        end_s = math.floor(t_s / self.interval_s + 1e-6) * self.interval_s
        if self._last is None or end_s > self._last.t_s + 1e-9:
            if not len(self._noise):
                self._noise = self._random.standard_normal((256, 6)) * (self.density / math.sqrt(self.interval_s))
            noise, self._noise = self._noise[-1], self._noise[:-1]
            self._last = Sample(end_s, self.correct(self.model.expected(end_s - self.interval_s / 2.0) + noise))
        return self._last

    def raw_mean(self, t_s: float, over_s: float) -> Array:
        """Mean (6) of the sensor until this time, turned into vehicle FRD and nothing else; asked again, the same."""
        seed = [round(t_s / over_s), self.index, 7]
        noise = np.random.default_rng(seed).standard_normal(6) * (self.density / math.sqrt(over_s))
        raw = self.model.expected(t_s - over_s / 2.0) + noise
        result: Array = np.concatenate((self.gyro.rotation @ raw[:3], self.accel.rotation @ raw[3:]))
        return result
