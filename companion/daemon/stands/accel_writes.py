"""Accelerometer offsets and scales into the autopilot, after stands; seen in the telemetry of the last of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from companion.autopilot.firmware.imu_calibration import output_step
from companion.autopilot.firmware.px4 import warnings_about
from companion.autopilot.parameters.change import Change
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import Job
from companion.daemon.offsets.plan import Plan, Target, WriteLog, left_in
from companion.daemon.offsets.subsystem import Offsets
from companion.errors import CalibrationRefusedError
from companion.estimation.means.windows import ImuWindow, Window


class AccelWrites:
    """Writes what stands have told; all or nothing."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu], offsets: Offsets) -> None:
        self._core, self._imus, self._path = core, imus, offsets.write_path

    def why_not(self, *, write: bool) -> str | None:
        """Why there is nothing to measure, or nothing could be written; None where all is well."""
        if not self._imus:
            return "there is no IMU of the autopilot to measure: none is configured"
        if write and not self._core.wanted.push:
            return "nothing is written while push.parameters is false"
        return None

    async def prepare(self) -> None:
        """Before the first stand: see that the offsets in force are those that are in use.

        Raises:
            AutopilotError: they cannot be read, or be made sure.
            StorageError: the old values could not be kept.
        """
        await self._path.offsets_still_hold()

    async def write(self, job: Job, last: Window, changes: Mapping[str, Sequence[Change]], log: WriteLog) -> None:
        """By IMU; the aircraft stands still as in the last stand.

        Raises:
            CompanionError: it failed, and why; the old values are back, or it is said which are not.
            JobCancelledError: cancelled; likewise.
        """
        if not await self._path.offsets_still_hold():
            raise CalibrationRefusedError("the offsets were changed in between: align again")
        means = {imu.name: imu for imu in last.imus}
        targets = tuple(self._target(means[name], each) for name, each in changes.items())
        for target in targets:
            log.warn(target.name, *warnings_about(target.calibration, target.changes))
        plan = Plan(targets, self._core.vehicle.boots)
        plan = await self._path.write(job, plan, last, log)
        for target in targets:
            kept = log.written.get(target.name, {})
            seen = {kept[name].outcome for name in target.calibration.parameters.accel_offset if name in kept}
            if seen == {"verified"}:
                # One step of the output showed offsets and scales together.
                plan.mark(log, target.calibration.parameters.accel_scale, "verified")
        await self._path.settle(job, plan, last, log)

    def _target(self, imu: ImuWindow, changes: Sequence[Change]) -> Target:
        calibration = self._imus[imu.name].in_force
        _, step = output_step(calibration, changes, imu.accel_m_s2)
        solution = left_in(imu, None, -np.array(step))
        kind = self._imus[imu.name].stream.kind
        return Target(imu.name, calibration, tuple(changes), solution, kind, watched=True, read_m_s2=imu.accel_m_s2)
