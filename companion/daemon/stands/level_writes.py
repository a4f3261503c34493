"""How the board sits in the aircraft, into the autopilot's level: ArduPilot's AHRS_TRIM, PX4's SENS_BOARD_X/Y_OFF.

ArduPilot turns the attitude that it reports, and that alone. PX4 turns what its IMUs give, so that their telemetry
shows it within a second; its EKF2 keeps the tilt that it has, and learns the new one slowly, or at a restart.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Mapping
from typing import Final, NamedTuple

import msgspec
import numpy as np

from companion.autopilot.firmware.ardupilot import TRIM
from companion.autopilot.firmware.px4 import LEVEL, read_level
from companion.autopilot.parameters.change import Change
from companion.autopilot.vehicle.own_attitude import OwnAttitude
from companion.component.service import MEASURED_PERCENT, WRITTEN_PERCENT
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import Job
from companion.daemon.offsets.subsystem import Offsets
from companion.errors import AutopilotError, CalibrationRefusedError
from companion.estimation.alignment.spot import Mounting
from companion.estimation.machine import Event
from companion.estimation.means.windows import Window
from companion.estimation.records.record import Outcome, WrittenParameter
from companion.physics.frames import Array, Matrix, body_from_ned, roll_pitch_from_up, rotation_matrix
from companion.storage.changes import Origin

MOST_DEG: Final = 10.0
SEEN_DEG: Final = 0.1
"""What shows in an attitude that wanders by hundredths of a degree; a smaller step is not looked for."""
SEEN_SHARE: Final = 0.2
WITHIN_S: Final = 15.0
USED_AFTER_S: Final = 1.5
"""Both firmwares look at their parameters once a second."""
LATEST_S: Final = 4.0
"""Of the attitude counts: on a busy link it comes seconds late, and an estimator wanders."""
POLL_S: Final = 0.25
_UP: Final = np.array([0.0, 0.0, -1.0])
REBOOT: Final = "reboot the autopilot before flight: PX4's attitude follows the new level after that"


class _Plan(NamedTuple):
    changes: list[Change]
    turn: Matrix
    """By which up turns in the vehicle's axes, (3, 3)."""


class LevelWrites:
    """Writes it, looks for its effect, and puts back what has none."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu], offsets: Offsets, own: OwnAttitude) -> None:
        self._core, self._machine, self._imus, self._own = core, core.machine, imus, own
        self._path, self._writer, self._owed = offsets.write_path, offsets.writer, offsets.owed

    async def write(
        self, job: Job, board: Mounting, last: Window, origin: Origin
    ) -> tuple[dict[str, WrittenParameter], str | None]:
        """Write and look; the aircraft stands still as in the last stand. What was written, and what to know of it.

        Raises:
            CompanionError: it failed, and why; the old values are back, or it is said which are not.
            JobCancelledError: cancelled; likewise.
        """
        if math.degrees(max(abs(board.roll_rad), abs(board.pitch_rad))) > MOST_DEG:
            raise CalibrationRefusedError("the board would sit more than 10 deg askew: no level is for that")
        plan = await self._plan(board)
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
                outcome, warning = await self._look(job, plan, before, last)
                if outcome is None:
                    raise AutopilotError("the attitude did not follow the new level, or it moved")
                if warning == REBOOT:
                    await self._owed.after(plan.changes)

            imus = list(self._imus.values()) if self._turns_imus else []
            await self._path.commit(plan.changes, origin, imus, apply, verify)
        assert outcome is not None
        for event in (Event.VERIFIED, Event.CONCLUDED):
            self._machine.on(event)
        return {name: msgspec.structs.replace(one, outcome=outcome) for name, one in written.items()}, warning

    @property
    def _turns_imus(self) -> bool:
        return self._core.vehicle.firmware == "px4"

    async def _plan(self, board: Mounting) -> _Plan:
        """What a level aircraft looks like to the board now, and the level under which that is up."""
        read = self._core.parameters.read
        seen = body_from_ned(board.roll_rad, board.pitch_rad, 0.0) @ _UP
        if not self._turns_imus:
            # The IMUs know nothing of the trim, and the whole of it is what they show.
            old = [await read(name) for name in TRIM]
            new = [board.roll_rad, board.pitch_rad]
            degrees = np.degrees([old, new])
            turns = [rotation_matrix((float(x), float(y), 0.0)) for x, y in degrees]
            return _Plan([Change(*each) for each in zip(TRIM, old, new, strict=True)], turns[1] @ turns[0].T)
        x, y, z = await read_level(self._core.parameters)
        level = rotation_matrix((x, y, z))
        roll, pitch = np.degrees(roll_pitch_from_up(level.T @ seen)).tolist()
        changes = [Change(LEVEL[0], x, roll), Change(LEVEL[1], y, pitch)]
        return _Plan(changes, rotation_matrix((roll, pitch, z)) @ level.T)

    async def _look(
        self, job: Job, plan: _Plan, before: Array | None, last: Window
    ) -> tuple[Outcome | None, str | None]:
        """The outcome, None where nothing followed; and what a pilot should know."""
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
        if self._turns_imus and await self._imus_turned(plan, last):
            return "verified", REBOOT
        unseen = before is None and not self._turns_imus
        return ("stored", "the effect of the new level was not seen: no ATTITUDE comes") if unseen else (None, None)

    async def _imus_turned(self, plan: _Plan, last: Window) -> bool:
        """Whether what the IMUs show has turned; PX4 alone turns it."""
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
    """Whether up has turned as it had to, nearly."""
    wanted = turn @ before
    return _angle_deg(after, wanted) < max(SEEN_DEG, SEEN_SHARE * _angle_deg(before, wanted))
