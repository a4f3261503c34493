"""ArduPilot's own gyro calibration, which takes the Earth for at rest."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sim.ardupilot.inertial import InertialPath
from sim.ardupilot.parameters import ParameterStore, caltemp_name, device_id, gyro_id_name, offset_names
from sim.earth import Array

GYRO_TIME_S = 0.55
GYRO_GIVES_UP_S = 30.0
AVERAGED_S = 0.5


@dataclass(slots=True)
class Calibrations:
    """Works on the parameters of all IMUs at once. Offsets are found in board axes, before scale and orientation."""

    paths: list[InertialPath]
    store: ParameterStore
    random: np.random.Generator
    gyros_ok: bool = True
    """Whether the last gyro calibration converged; if not, it does not arm."""

    def _mean(self, path: InertialPath, t_s: float) -> Array:
        """The sensor's mean over the averaging time that ends now, with its white noise."""
        times = np.linspace(t_s - AVERAGED_S, t_s, 21)[1:]
        mean: Array = path.model.expected_block(times).mean(axis=0)
        return mean + self.random.standard_normal(6) * path.model.white / math.sqrt(AVERAGED_S)

    def clear_gyros(self) -> None:
        """The start of a gyro calibration: what is read meanwhile is zero."""
        for path in self.paths:
            for name in offset_names(path.instance, "gyro"):
                self.store.set(name, 0.0)

    def gyros(self, t_s: float, *, converged: bool = True) -> tuple[str, ...]:
        """Mean rate becomes the offset: the Earth's rotation goes into it. Returns the names that it has saved.

        Also without success; only the temperature is then not noted. What belongs to no gyro is set to nothing.
        """
        before = dict(self.store.values)
        for path in self.paths:
            mean = self._mean(path, t_s)
            for name, value in zip(offset_names(path.instance, "gyro"), mean[:3], strict=True):
                self.store.set(name, float(value))
            self.store.set(gyro_id_name(path.instance), device_id(path.instance))
            if converged:
                self.store.set(caltemp_name(path.instance, "GYR"), path.model.temperature_degc(t_s))
        for instance in range(len(self.paths) + 1, 6):
            if (auxiliary := instance > 3) and gyro_id_name(instance) not in self.store:
                continue
            fitted = auxiliary and self.store.values[gyro_id_name(instance)] != 0
            for name in offset_names(instance, "gyro"):
                self.store.set(name, float(self.random.normal(0.0, 1e-4)) if fitted else 0.0)
            if not fitted:
                self.store.set(gyro_id_name(instance), 0)
                self.store.set(caltemp_name(instance, "GYR"), -300.0)
        self.gyros_ok = converged
        return tuple(name for name, value in self.store.values.items() if value != before[name])
