"""Writes bias curves over temperature to the autopilot's own temperature calibration, on request.

The output at the present temperature stays, and that is verified.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from companion.autopilot.firmware.imu_calibration import Thermal
from companion.autopilot.parameters.wire import same_float32
from companion.component.service import MEASURED_PERCENT
from companion.daemon.biases.memory import LOOK_K, BiasMemory
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import CurvesWritten, Job
from companion.daemon.offsets.plan import ImuPlan, Plan, WriteLog
from companion.daemon.offsets.subsystem import Offsets
from companion.daemon.stands.measuring import Measuring
from companion.errors import CalibrationRefusedError
from companion.estimation.machine import Event
from companion.estimation.means.windows import Window
from companion.estimation.temperature.curve import Curve, Polynomial, of_curve
from companion.storage.changes import BY_TEMPERATURE


class IntoAutopilot:
    """Writes the curves of all IMUs, or none."""

    def __init__(
        self,
        core: Core,
        imus: Mapping[str, AutopilotImu],
        measuring: Measuring,
        memory: BiasMemory,
        offsets: Offsets,
    ) -> None:
        self._core, self._imus, self._measuring, self._memory = core, imus, measuring, memory
        self._path, self._ledger = offsets, offsets.ledger

    def why_no_undo(self) -> str | None:
        """Return why the write of curves cannot be undone; None where it is the latest write."""
        steps = self._ledger.steps(self._core.vehicle.system_id)
        after = [step.origin.what or "a write" for step in steps]
        if BY_TEMPERATURE not in after:
            return "no curve was written that could be undone"
        later = after[: after.index(BY_TEMPERATURE)]
        return None if not later else f"written since: {', '.join(later)}; companion undo puts that back first"

    async def run(self, job: Job, *, overwrite: bool) -> str:
        """Measure, write and verify; return in words what was written.

        `overwrite`: replace a temperature calibration that is not ours. After an error or a cancel the old values are
        restored, or the error names those that are not.
        """
        log = WriteLog()
        await self._core.offload(self._memory.follow)
        self._measuring.begin()
        window = await self._measuring.measure(job)
        if not await self._path.offsets_still_hold():
            raise CalibrationRefusedError("the autopilot's values were changed in between: try again")
        job.progress(MEASURED_PERCENT, "reading the autopilot's temperature calibration")
        targets, words, left = await self._find(window, overwrite=overwrite)
        if not targets:
            raise CalibrationRefusedError("; ".join(left or ["no IMU of the autopilot was measured"]))
        log.warnings += left
        if not any(target.all for target in targets):
            self._core.machine.on(Event.NOTHING_TO_WRITE)
            return "already in force"
        plan = await self._path.write(job, Plan(tuple(targets), self._core.vehicle.boots), window, log)
        await self._path.settle(job, plan, window, log)
        warnings = (*log.warnings, *(words for each in log.imu_warnings.values() for words in each))
        job.product = CurvesWritten(log.written, warnings)
        return f"written: {'; '.join(words)}"

    async def _find(self, window: Window, *, overwrite: bool) -> tuple[list[ImuPlan], list[str], list[str]]:
        """Return the targets of the write, their words, and why other IMUs are left as they are."""
        exchanged = self._memory.forgotten()  # the curve of an IMU that was replaced must not be written
        targets: list[ImuPlan] = []
        words: list[str] = []
        left: list[str] = []
        for means in (means for means in window.imus if means.name in self._imus):
            name, degc = means.name, means.temperature_degc
            curve, calibration = self._memory.curves.of(name, "gyro"), self._imus[name].in_force
            enabled_by = calibration.thermal.enabled_by
            if curve is None:
                left.append(exchanged.get(name) or f"imu {name}: no curve yet (companion temperature)")
            elif degc is None:
                left.append(f"imu {name}: it tells no temperature now")
            elif enabled_by and not overwrite and not self._is_ours(calibration.thermal):
                left.append(
                    f"imu {name}: {enabled_by} is on, and not by the companion: kept"
                    " (companion temperature --overwrite replaces it)"
                )
            else:
                gyro, accel = of_curve(curve, calibration.orientation), self._of_accelerometers(name, curve)
                kind, parameters = self._core.vehicle.kind, self._core.parameters
                changes = await kind.thermal_changes(parameters, calibration, gyro, accel, degc)
                named = {change.parameter for target in targets for change in target.unseen}
                unseen = tuple(change for change in changes if change.parameter not in named)
                targets.append(ImuPlan(name, calibration, (), (np.zeros(3), np.zeros(3)), watched=True, unseen=unseen))
                low, high = curve.span_degc
                words.append(f"{name}, {low:.0f} to {high:.0f} degC")
        return targets, words, left

    def _of_accelerometers(self, name: str, gyro: Curve) -> Polynomial | None:
        """Return the accelerometers' curve if it spans the gyros' temperatures: an autopilot has one span for both."""
        curve, calibration = self._memory.curves.of(name, "accel"), self._imus[name].in_force
        if curve is None or not np.allclose(curve.span_degc, gyro.span_degc, rtol=0.0, atol=LOOK_K):
            return None
        return of_curve(curve, calibration.orientation, calibration.accel_scale)

    def _is_ours(self, thermal: Thermal) -> bool:
        """Return whether the values are those of our latest write."""
        ours: dict[str, float | None] = {}
        for step in reversed(self._ledger.steps(self._core.vehicle.system_id)):
            if step.origin.what == BY_TEMPERATURE:
                ours |= {one.parameter: one.after for one in step.changes}
        found = [(ours[name], value) for name, value in thermal.values.items() if name in ours]
        return bool(found) and all(after is not None and same_float32(after, now) for after, now in found)
