"""PX4's `temperature_compensation`: what it takes off the gyros by temperature, once a second and by steps of a kelvin.

Facts: PX4 `src/modules/temperature_compensation`, `init.d/rc.thermal_cal` (2026-08), autopilots 10.2. The
accelerometers' half (TC_A*) is not modelled.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from sim.earth import Array
from sim.px4.defaults import SLOTS
from sim.px4.parameters import ParameterStore
from sim.px4.vehicle_imu import VehicleImu

Module = Literal["absent", "idle", "started"]
"""Not built, as for common boards: no TC_* at all. Built and never started, as in SITL. Started by TC_G_ENABLE."""
POLL_S = 1.0
STEP_K = 1.0
"""Only a temperature farther than this from that of the last publication is published."""


class ThermalCompensation:
    """The module, for one boot after the other."""

    def __init__(self, module: Module, store: ParameterStore, imus: list[VehicleImu]) -> None:
        self._module, self._store, self._imus = module, store, imus
        self.running = False
        self._published: list[float | None] = []
        self.restart()

    def restart(self) -> None:
        """A boot: whether it runs is decided now, and not again before the next one."""
        self.running = self._module == "started" and self._store["TC_G_ENABLE"] == 1
        self.parameters_updated()

    def parameters_updated(self) -> None:
        """Whatever has changed, the next poll publishes anew."""
        self._published = [None] * len(self._imus)

    def poll(self, t_s: float) -> None:
        """Work out and publish; switched off, it leaves standing what it has published last."""
        if not self.running or self._store["TC_G_ENABLE"] != 1:
            return
        degc = [imu.model.temperature_degc(t_s) for imu in self._imus]
        far = [last is None or abs(now - last) > STEP_K for last, now in zip(self._published, degc, strict=True)]
        slots = [self._slot(imu.device_id) for imu in self._imus]
        if not any(moved and slot is not None for moved, slot in zip(far, slots, strict=True)):
            return
        for k, (imu, slot, now) in enumerate(zip(self._imus, slots, degc, strict=True)):
            if slot is not None:
                imu.gyro.thermal = self._offset(slot, now)
            if far[k]:
                self._published[k] = now

    def _slot(self, device_id: int) -> int | None:
        return next((j for j in range(SLOTS) if self._store[f"TC_G{j}_ID"] == device_id), None)

    def _offset(self, slot: int, degc: float) -> Array:
        store, name = self._store, f"TC_G{slot}_"
        d = np.float32(min(max(degc, store[f"{name}TMIN"]), store[f"{name}TMAX"]) - store[f"{name}TREF"])
        x0, x1, x2, x3 = (
            np.array([store[f"{name}X{power}_{axis}"] for axis in range(3)], dtype=np.float32) for power in range(4)
        )
        return np.asarray(x0 + x1 * d + x2 * (d * d) + x3 * (d * d * d), dtype=np.float64)
