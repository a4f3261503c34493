"""Writes of alignments to the autopilot: accelerometer offsets and scales, and the level of the board.

The level is ArduPilot's AHRS_TRIM, which rotates the reported attitude only, or PX4's SENS_BOARD_X/Y_OFF, which rotates
the output of the IMUs. PX4's telemetry shows a new level within a second, but EKF2 learns it slowly, or at a restart.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import msgspec
import numpy as np

from companion.autopilot.firmware.imu_calibration import output_step
from companion.autopilot.firmware.px4 import warnings_about
from companion.autopilot.parameters.change import Change
from companion.autopilot.telemetry.compass_fields import SELECTED, CompassFields, MeanField
from companion.autopilot.vehicle.ekf import OwnAttitude
from companion.component.service import MEASURED_PERCENT, WRITTEN_PERCENT
from companion.component.statustext import Severity
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import Job
from companion.daemon.offsets.plan import ImuPlan, Plan, WriteLog
from companion.daemon.offsets.subsystem import Offsets
from companion.errors import AutopilotError, CalibrationRefusedError
from companion.estimation.alignment.faces import Mounting
from companion.estimation.machine import Event
from companion.estimation.means.windows import Window
from companion.estimation.records.record import Outcome, WrittenParameter
from companion.physics.frames import Array, Matrix
from companion.storage.changes import Origin

MOST_DEG: Final = 10.0
SEEN_DEG: Final = 0.1  # Smallest step that is visible in an autopilot's attitude, which wanders by hundredths
SEEN_SHARE: Final = 0.2
SEEN_GAUSS: Final = 0.004  # Largest change of a compass' field at rest: digits, noise, and PX4's own bias estimate
FOLLOWS_SHARE: Final = 0.05
WITHIN_S: Final = 15.0
USED_AFTER_S: Final = 1.5  # Time until written parameters are in use: both firmwares read them once a second
LATEST_S: Final = 4.0  # Largest age of attitude messages: a busy link delays them, old estimates have wandered
POLL_S: Final = 0.25
REBOOT: Final = "reboot the autopilot before flight: PX4's attitude follows the new level after that"


class CompassStep(NamedTuple):
    """Planned changes of one compass, its corrected field (3,) after them, and the step (3,) to that field, gauss."""

    number: int
    changes: Sequence[Change]
    field_gauss: Array
    step_gauss: Array

    @property
    def name(self) -> str:
        return f"compass {self.number}"

    @property
    def shows(self) -> bool:
        return float(np.linalg.norm(self.step_gauss)) > 3.0 * SEEN_GAUSS

    def fits(self, field_gauss: Array) -> bool:
        # PX4's EKF forgets the bias that it had learned as soon as a correction changes.
        off = float(np.linalg.norm(field_gauss - self.field_gauss))
        return off < SEEN_GAUSS + FOLLOWS_SHARE * float(np.linalg.norm(self.step_gauss))


class AlignmentWrites:
    """Writes accelerometer offsets and scales, or the level, all or nothing, and verifies the effect.

    After an error or a cancel, old parameter values are restored; the error names any that are not.
    """

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu], offsets: Offsets, own: OwnAttitude) -> None:
        self._core, self._vehicle, self._imus, self._own = core, core.vehicle, imus, own
        self.path, self._writer, self._owed = offsets, offsets.writer, offsets.owed

    async def write_accelerometers(
        self, job: Job, last: Window, changes: Mapping[str, Sequence[Change]], log: WriteLog
    ) -> None:
        if not await self.path.offsets_still_hold():
            raise CalibrationRefusedError("the offsets were changed in between: align again")
        means = {imu.name: imu for imu in last.imus}
        targets: list[ImuPlan] = []
        for name, each in changes.items():
            calibration, read = self._imus[name].in_force, means[name].accel_m_s2
            _, step = output_step(calibration, each, read)
            residual = None, -np.array(step)
            targets.append(ImuPlan(name, calibration, tuple(each), residual, watched=True))
            log.warn(name, *warnings_about(calibration, each))
        plan = await self.path.write(job, Plan(tuple(targets), self._vehicle.boots), last, log)
        for target in targets:
            kept, names = log.written.get(target.name, {}), target.calibration.parameters
            if {kept[name].outcome for name in names.accel_offset if name in kept} == {"verified"}:
                # One verified step of the output confirms offsets and scales together.
                plan.mark(log, names.accel_scale, "verified")
        await self.path.settle(job, plan, last, log)

    async def write_compasses(
        self, job: Job, found: Sequence[CompassStep], fields: CompassFields, log: WriteLog
    ) -> None:
        """Write new corrections of compasses while the aircraft stands in its last pose, and see them in the field."""
        changes = [change for step in found for change in step.changes]
        selected_only = self._vehicle.kind.raw_fields
        await self.path.begin(job, len(changes))

        async def apply() -> list[Change]:
            written = await self._writer.apply(changes)
            for step in found:
                log.written[step.name] = {each.parameter: written[each.parameter] for each in step.changes}
            return changes

        async def verify() -> None:
            job.progress(WRITTEN_PERCENT, "checking the compasses for the new correction")
            since_s = asyncio.get_running_loop().time() + USED_AFTER_S
            seen = []
            for step in found:
                now = await self._field(job, fields, SELECTED if selected_only else step.number, since_s)
                if now is None:
                    continue
                if step.fits(now.mean_gauss):
                    seen.append(step)
                    if selected_only:
                        break  # the others are not seen, however alike their fields are
                elif not selected_only or step is found[-1]:
                    raise AutopilotError(f"{step.name}'s field did not follow, or the aircraft moved")
            for step in seen:
                written = log.written[step.name].items()
                log.written[step.name] = {
                    name: msgspec.structs.replace(one, outcome="verified" if step.shows else one.outcome)
                    for name, one in written
                }

        await self.path.commit(changes, Origin("compass", log.started), [], apply, verify)
        for event in (Event.VERIFIED, Event.CONCLUDED):
            self._core.machine.on(event)

    async def _field(self, job: Job, fields: CompassFields, number: int, since_s: float) -> MeanField | None:
        loop = asyncio.get_running_loop()
        while (now := fields.mean(number, since_s)) is None and loop.time() < since_s + WITHIN_S:
            await job.pause(POLL_S)
        return now

    async def write_level(self, job: Job, board: Mounting, last: Window, log: WriteLog) -> dict[str, WrittenParameter]:
        if math.degrees(max(abs(board.roll_rad), abs(board.pitch_rad))) > MOST_DEG:
            raise CalibrationRefusedError("the board would sit more than 10 deg askew: no level is for that")
        kind = self._vehicle.kind
        changes, turn = await kind.plan_level(self._core.parameters, board.roll_rad, board.pitch_rad)
        written: dict[str, WrittenParameter] = {}
        outcome: Outcome = "failed"
        warning: str | None = None
        with self._own.asked():
            job.progress(MEASURED_PERCENT, "reading the autopilot's attitude")
            before = await self._own.up_since(asyncio.get_running_loop().time())
            await self.path.begin(job, len(changes))

            async def apply() -> list[Change]:
                written.update(await self._writer.apply(changes))
                return changes

            async def verify() -> None:
                nonlocal outcome, warning
                outcome, warning = await self._verify_level(job, turn, before, last)
                if warning == REBOOT:
                    await self._owed.after(changes)

            imus = list(self._imus.values()) if kind.level_turns_imus else []
            await self.path.commit(changes, Origin("level", log.started), imus, apply, verify)
        for event in (Event.VERIFIED, Event.CONCLUDED):
            self._core.machine.on(event)
        if warning is not None:
            log.warnings.append(warning)
            self._core.say(Severity.WARNING, warning)
        return {name: msgspec.structs.replace(one, outcome=outcome) for name, one in written.items()}

    async def _verify_level(
        self, job: Job, turn: Matrix, before: Array | None, last: Window
    ) -> tuple[Outcome, str | None]:
        """Wait until the attitude has turned as expected; return outcome and warning, or raise AutopilotError."""
        loop, vehicle = asyncio.get_running_loop(), self._vehicle
        job.progress(WRITTEN_PERCENT, "checking the attitude for the new level")
        since_s, boots = loop.time() + USED_AFTER_S, vehicle.boots
        while loop.time() < since_s + WITHIN_S and vehicle.boots == boots:
            job.check_cancelled()
            now = self._own.up(max(since_s, loop.time() - LATEST_S))
            if before is not None and now is not None:
                if _angle_deg(turn @ before, before) < SEEN_DEG:
                    return "stored", "the level changed too little to verify"
                if _follows(before, now, turn):
                    return "verified", None
            await job.pause(POLL_S)
        if vehicle.kind.level_turns_imus:
            if await self._imus_turned(turn, last):
                return "verified", REBOOT
        elif before is None:
            return "stored", "the effect of the new level is not verified: no ATTITUDE messages"
        raise AutopilotError("the attitude did not follow the new level, or the aircraft moved")

    async def _imus_turned(self, turn: Matrix, last: Window) -> bool:
        with contextlib.suppress(CalibrationRefusedError):
            for imu in self._imus.values():
                await imu.refresh()
            were = {imu.name: np.array(imu.accel_m_s2) for imu in last.imus if imu.name in self._imus}
            after = {imu.name: np.array(imu.accel_m_s2) for imu in (await self._core.window()).imus}
            return all(_follows(were[name], after[name], turn) for name in were.keys() & after.keys())
        return False


def _angle_deg(one: Array, other: Array) -> float:
    cross = np.linalg.norm(np.cross(one, other))
    return math.degrees(math.atan2(float(cross), float(one @ other)))


def _follows(before: Array, after: Array, turn: Matrix) -> bool:
    wanted = turn @ before
    return _angle_deg(after, wanted) < max(SEEN_DEG, SEEN_SHARE * _angle_deg(before, wanted))
