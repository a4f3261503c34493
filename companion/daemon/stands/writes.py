"""Writes of alignments to the autopilot: accelerometer offsets and scales, and the level of the board.

The level is ArduPilot's AHRS_TRIM or PX4's SENS_BOARD_X/Y_OFF. ArduPilot turns the attitude that it reports, and that
alone. PX4 turns the output of its IMUs, so that their telemetry shows it within a second; its EKF2 keeps its tilt, and
learns the new one slowly, or at a restart.
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
from companion.autopilot.vehicle.ekf import OwnAttitude
from companion.component.service import MEASURED_PERCENT, WRITTEN_PERCENT
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import Job
from companion.daemon.offsets.plan import Plan, Target, WriteLog, left_in
from companion.daemon.offsets.subsystem import Offsets
from companion.errors import AutopilotError, CalibrationRefusedError
from companion.estimation.alignment.faces import Mounting
from companion.estimation.machine import Event
from companion.estimation.means.windows import ImuWindow, Window
from companion.estimation.records.record import Outcome, WrittenParameter
from companion.physics.frames import Array, Matrix
from companion.storage.changes import Origin

MOST_DEG: Final = 10.0
SEEN_DEG: Final = 0.1
"""Least step that shows in an attitude that wanders by hundredths of a degree."""
SEEN_SHARE: Final = 0.2
WITHIN_S: Final = 15.0
USED_AFTER_S: Final = 1.5
"""Both firmwares read their parameters once a second."""
LATEST_S: Final = 4.0
"""Age of the attitude that counts: on a busy link it comes seconds late, and an estimator wanders."""
POLL_S: Final = 0.25
REBOOT: Final = "reboot the autopilot before flight: PX4's attitude follows the new level after that"


class AccelWrites:
    """Writes accelerometer offsets and scales, all or nothing."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu], offsets: Offsets) -> None:
        self._core, self._imus, self._path = core, imus, offsets.write_path

    def why_not(self, *, write: bool) -> str | None:
        """Say why nothing can be measured or written; None when it can."""
        if not self._imus:
            return "there is no IMU of the autopilot to measure: none is configured"
        if write and not self._core.wanted.push:
            return "nothing is written while push.parameters is false"
        return None

    async def prepare(self) -> None:
        """Verify, before the first stand, that the parameters are the offsets in use.

        Raises:
            AutopilotError: they cannot be read, or be made sure.
            StorageError: the old values could not be kept.
        """
        await self._path.offsets_still_hold()

    async def write(self, job: Job, last: Window, changes: Mapping[str, Sequence[Change]], log: WriteLog) -> None:
        """Write the changes of each IMU; the aircraft stands still as in the last stand.

        Raises:
            CompanionError: it failed, and why; the old values are restored, or the error names those that are not.
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


class _LevelPlan(NamedTuple):
    changes: list[Change]
    turn: Matrix
    """Rotation of up in the vehicle's axes, (3, 3)."""


class LevelWrites:
    """Writes the level, verifies its effect, and restores the old one without it."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu], offsets: Offsets, own: OwnAttitude) -> None:
        self._core, self._machine, self._imus, self._own = core, core.machine, imus, own
        self._path, self._writer, self._owed = offsets.write_path, offsets.writer, offsets.owed

    async def write(
        self, job: Job, board: Mounting, last: Window, origin: Origin
    ) -> tuple[dict[str, WrittenParameter], str | None]:
        """Write and verify; the aircraft stands still as in the last stand. Returns what was written, and a warning.

        Raises:
            CompanionError: it failed, and why; the old values are restored, or the error names those that are not.
            JobCancelledError: cancelled; likewise.
        """
        if math.degrees(max(abs(board.roll_rad), abs(board.pitch_rad))) > MOST_DEG:
            raise CalibrationRefusedError("the board would sit more than 10 deg askew: no level is for that")
        plan = _LevelPlan(
            *await self._core.vehicle.kind.plan_level(self._core.parameters, board.roll_rad, board.pitch_rad)
        )
        with self._own.asked():
            job.progress(MEASURED_PERCENT, "reading the autopilot's attitude")
            before = await self._own.up_since(asyncio.get_running_loop().time())
            await self._path.begin(job, len(plan.changes))
            written: dict[str, WrittenParameter] = {}
            outcome: Outcome | None = None
            warning: str | None = None

            async def apply() -> list[Change]:
                written.update(await self._writer.apply(plan.changes))
                return plan.changes

            async def verify() -> None:
                nonlocal outcome, warning
                outcome, warning = await self._verify(job, plan, before, last)
                if outcome is None:
                    raise AutopilotError("the attitude did not follow the new level, or it moved")
                if warning == REBOOT:
                    await self._owed.after(plan.changes)

            imus = list(self._imus.values()) if self._core.vehicle.kind.level_turns_imus else []
            await self._path.commit(plan.changes, origin, imus, apply, verify)
        assert outcome is not None
        for event in (Event.VERIFIED, Event.CONCLUDED):
            self._machine.on(event)
        return {name: msgspec.structs.replace(one, outcome=outcome) for name, one in written.items()}, warning

    async def _verify(
        self, job: Job, plan: _LevelPlan, before: Array | None, last: Window
    ) -> tuple[Outcome | None, str | None]:
        """Watch the attitude; returns the outcome, None if it did not follow, and a warning."""
        loop = asyncio.get_running_loop()
        job.progress(WRITTEN_PERCENT, "watching the attitude take the new level")
        since_s = loop.time() + USED_AFTER_S
        boots = self._core.vehicle.boots
        while loop.time() < since_s + WITHIN_S and self._core.vehicle.boots == boots:
            job.check_cancelled()
            now = self._own.up(max(since_s, loop.time() - LATEST_S))
            if before is not None and now is not None:
                if _angle_deg(plan.turn @ before, before) < SEEN_DEG:
                    return "stored", "the new level is too near the old one to be seen"
                if _follows(before, now, plan.turn):
                    return "verified", None
            await job.pause(POLL_S)
        if self._core.vehicle.kind.level_turns_imus and await self._imus_turned(plan, last):
            return "verified", REBOOT
        unseen = before is None and not self._core.vehicle.kind.level_turns_imus
        return ("stored", "the effect of the new level was not seen: no ATTITUDE comes") if unseen else (None, None)

    async def _imus_turned(self, plan: _LevelPlan, last: Window) -> bool:
        """Verify that the output of the IMUs has turned; only PX4 turns it."""
        with contextlib.suppress(CalibrationRefusedError):
            for imu in self._imus.values():
                await imu.refresh()
            after = await self._core.window()
            were = {imu.name: np.array(imu.accel_m_s2) for imu in last.imus}
            return all(
                _follows(were[imu.name], np.array(imu.accel_m_s2), plan.turn)
                for imu in after.imus
                if imu.name in self._imus and imu.name in were
            )
        return False


def _angle_deg(one: Array, other: Array) -> float:
    cross = np.linalg.norm(np.cross(one, other))
    return math.degrees(math.atan2(float(cross), float(one @ other)))


def _follows(before: Array, after: Array, turn: Matrix) -> bool:
    """Verify that up has turned nearly as predicted."""
    wanted = turn @ before
    return _angle_deg(after, wanted) < max(SEEN_DEG, SEEN_SHARE * _angle_deg(before, wanted))
