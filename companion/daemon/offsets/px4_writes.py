"""What a write to PX4 needs besides the writing: whose output it moves, and which offsets are in use at all."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from typing import Final

import numpy as np

from companion.autopilot.firmware.imu_calibration import ImuCalibration, output_step, vector_changes
from companion.autopilot.firmware.px4_slots import Sensor, SlotMemory
from companion.autopilot.parameters.change import Change, WriteFailedError
from companion.autopilot.parameters.writer import ParameterWriter
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.component.statustext import Say, Severity, Weight
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.offsets.far_step import FarMean, FarStep, FarStepWatch
from companion.daemon.offsets.ledger import Ledger
from companion.samples import Vector
from companion.storage.changes import ChangeSet

logger = logging.getLogger(__name__)

SENSORS: Final[tuple[Sensor, Sensor]] = ("accel", "gyro")

Look = Callable[[], Awaitable[str | None]]


class Px4Writes:
    """Stands by while parameters are written; of ArduPilot's it has nothing to say.

    Args:
        vehicle: the autopilot.
        writer: of its parameters.
        ledger: where the old values are kept.
        watch: of the telemetry.
        memory: of what was learned about slots.
        say: words for the ground stations.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        writer: ParameterWriter,
        ledger: Ledger,
        watch: FarStepWatch,
        memory: SlotMemory,
        say: Say,
    ) -> None:
        self._vehicle, self._writer, self._ledger = vehicle, writer, ledger
        self._watch, self._memory, self._say = watch, memory, say

    @contextlib.asynccontextmanager
    async def standing_by(
        self, targets: Sequence[tuple[ImuCalibration, Sequence[Change]]]
    ) -> AsyncIterator[Look | None]:
        """Over a write of these changes; gives what to call while the far values are in force (None: no need)."""
        steps = [step for calibration, changes in targets for step in far_steps(calibration, changes)]
        try:
            async with self._watch.watching(steps) as look:
                yield look
        except WriteFailedError as error:
            if steps and error.left_changed and self._vehicle.arm_state is ArmState.ARMED:
                # Between the steps the offsets are wrong on purpose, and while it is armed nobody may mend that.
                self._say(Severity.CRITICAL, "DISARM NOW: gyro/accel offsets are off", Weight.RESULT)
            if error.kind == "not as believed" and not self._watch.learned:
                # Nothing was learned: the same slot again, and not for ever.
                raise WriteFailedError("without effect", error.reason, error.written, error.left_changed) from error
            raise
        # Only a write that came to its end comes here.
        for calibration, changes in targets:
            if calibration.far_step is not None:
                after = _offsets(calibration, changes)
                self._memory.brought_into_use(calibration.parameters.accel_offset, after, self._vehicle.boots)

    def seen_far(self, calibration: ImuCalibration) -> Mapping[Sensor, FarMean]:
        """The output of an IMU while the far values of the last write were in force, as far as it was seen."""
        found = {sensor: self._watch.means.get((calibration.instance, sensor)) for sensor in SENSORS}
        return {sensor: mean for sensor, mean in found.items() if mean is not None}

    async def make_sure(self, imus: Sequence[AutopilotImu]) -> bool:
        """Bring offsets that may not be in use into use, unchanged; True when there were any.

        Raises:
            AutopilotError: this failed; the recovery puts right what may be left.
            StorageError: the values could not be kept, so nothing was written.
        """
        unsure = [imu for imu in imus if imu.in_force.accel_offset_may_be_unused]
        changes = [change for imu in unsure for change in _again(imu.in_force)]
        if not changes:
            return False
        logger.info("bringing offsets into use that PX4 may have ignored: %s", ", ".join(c.parameter for c in changes))
        targets = [(imu.in_force, _again(imu.in_force)) for imu in unsure]
        try:
            async with self._ledger.transaction(ChangeSet.of(self._vehicle.system_id, changes)):
                with contextlib.ExitStack() as stack:
                    for imu in unsure:
                        stack.enter_context(imu.changing())
                    async with self.standing_by(targets) as look:
                        await self._writer.apply(changes, look)
                await self._ledger.undone()
        except WriteFailedError as error:
            if error.kind != "not as believed" or error.left_changed:
                raise
            # Something was learned: the offsets are read again, from another slot.
        return True


def far_steps(calibration: ImuCalibration, changes: Sequence[Change]) -> list[FarStep]:
    """What the output must do when the far values of these changes come into force."""
    far = [dataclasses.replace(c, after=c.via, via=None) for c in changes if c.via is not None]
    gyro, accel = output_step(calibration, far)
    names, found = calibration.parameters, []
    for sensor, device_id, name, step in (
        ("gyro", calibration.gyro_id, names.gyro_id, gyro),
        ("accel", calibration.accel_id, names.accel_id, accel),
    ):
        if any(step) and device_id is not None:
            kind: Sensor = "gyro" if sensor == "gyro" else "accel"
            found.append(FarStep(calibration.instance, kind, device_id, name.removesuffix("_ID"), np.array(step)))
    return found


def step_from_far(calibration: ImuCalibration, changes: Sequence[Change]) -> tuple[Vector, Vector]:
    """By how much the output must move from the far values to the new ones: gyro rad/s, accelerometer m/s^2."""
    back = [dataclasses.replace(c, before=c.via, via=None) for c in changes if c.via is not None]
    return output_step(calibration, back)


def _again(calibration: ImuCalibration) -> list[Change]:
    offset, far = calibration.accel_offset_m_s2, calibration.far_step
    if far is None:
        return []
    return vector_changes(calibration.parameters.accel_offset, offset, offset, far.accel_m_s2)


def _offsets(calibration: ImuCalibration, changes: Sequence[Change]) -> Vector:
    """The accelerometer offsets after these changes."""
    by_name = {change.parameter: change.after for change in changes}
    names, before = calibration.parameters.accel_offset, calibration.accel_offset_m_s2
    x, y, z = (by_name.get(name, old) for name, old in zip(names, before, strict=True))
    return x, y, z
