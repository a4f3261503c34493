"""Automatic calibrations, so that a fresh result is active before anyone arms.

If the setting `at_arm` is "gate" or "warn", the disarmed, motionless aircraft is calibrated at the first opportunity,
and again when new offsets would be clearly better. Every write wears the autopilot's flash. Therefore offsets that a
window without motion confirms are not written again. The number of writes a day is limited, also across restarts.

Choices of people are never overwritten: after an undo, a cancel, or a change by another station, automatic calibrations
stop with a message until the next request or restart.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import Mapping
from typing import Final

from companion.autopilot.vehicle.vehicle import ArmState
from companion.component.service import JobResult, Refusal
from companion.component.statustext import Severity, Weight
from companion.daemon.arming.in_force import ActiveCalibration
from companion.daemon.calibrating.manager import Precondition
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import NO_CALIBRATION, Job
from companion.daemon.poses.alignment import ActiveAlignment
from companion.errors import AutopilotError, StorageError
from companion.estimation.records.validity import Why
from companion.storage.state import BoundedList

logger = logging.getLogger(__name__)

REQUESTER: Final = "the companion itself"
POLL_S: Final = 1.0
SPACING_S: Final = 300.0
"""Minimum time between automatic writes; the accuracy of a result (sigma_use) is computed for the next 180 s."""
WORTH_FOR_S: Final = 30.0
"""Time during which every window must predict better offsets before good offsets are replaced automatically."""
PER_DAY: Final = 24
"""Maximum number of automatic writes a day (some 300 parameters in all); a flash page withstands 10 000 rewrites."""
FAILURES: Final = 3
RETRY_S: Final = 60.0  # Wait after a failure; doubled after each further one
TIMEOUT_S: Final = 180.0


class Automatic:
    """Starts automatic calibrations; `run` decides when."""

    def __init__(
        self, core: Core, imus: Mapping[str, AutopilotImu], in_force: ActiveCalibration, alignment: ActiveAlignment
    ) -> None:
        self._core, self._manager, self._imus, self._in_force = core, in_force.manager, imus, in_force
        self._alignment = alignment
        self._file = BoundedList(core.config.storage.path / "automatic.json", dict[str, float], PER_DAY + 8)
        self._writes: list[dict[str, float]] = []
        self._unsaved = False
        self._next_s = -math.inf
        self._failures = 0
        self.turns = 0
        self.stopped: str | None = None
        """Reason why automatic calibrations are stopped until the next request; None while they may start."""

    @property
    def wanted(self) -> bool:
        wanted = self._core.wanted
        return wanted.at_arm != "off" and wanted.push and self._core.only_listening is None

    def why_not(self) -> str | None:
        """Return the waiting time or the remedy, as text, if no automatic calibration can start now; otherwise None."""
        if self._alignment.contradicted:  # with a wrong mounting, new accelerometer offsets would be wrong
            return self._alignment.warning
        if not self.wanted or self.stopped is not None:
            return "calibrate"
        if self._writes_today() >= PER_DAY:
            return f"calibrate ({PER_DAY} writes today)"
        now_s = asyncio.get_running_loop().time()
        # Offsets replaced by a boot, and a new gradienter zero, are urgent unless a calibration has failed.
        urgent = any(finding.why in (Why.REPLACED, Why.ALIGNED) for finding in self._in_force.findings(now_s))
        if self._next_s > now_s and not (urgent and self._failures == 0):
            return f"calibrates by itself in {math.ceil((self._next_s - now_s) / 60)} min"
        return None

    def _writes_today(self) -> int:
        # If the clock has jumped back, writes in its future count as today's.
        since_s = time.time() - 86400.0
        return sum(write["at_unix_s"] > since_s for write in self._writes)

    async def run(self) -> None:
        self._writes = await self._core.offload(self._file.read)
        if self._manager.was_undone:
            self._stop("undone")
        while True:
            self.turns += 1
            await asyncio.sleep(POLL_S)
            try:
                await self._keep()
                await self._consider()
            except Exception:
                logger.exception("considering a calibration failed")

    async def _consider(self) -> None:
        if not self.wanted:
            return
        in_force, now_s = self._in_force, asyncio.get_running_loop().time()
        if in_force.offsets.foreign is not None and self.stopped is None:
            self._stop(in_force.offsets.foreign)
        if self.why_not() is not None or not (in_force.findings(now_s) or in_force.worth_writing_s >= WORTH_FOR_S):
            return
        if self._is_possible() and await self._still_ours() and self._is_possible():
            answer = self._manager.start_calibration(in_force.what, REQUESTER, TIMEOUT_S, automatic=True)
            if isinstance(answer, Refusal):
                logger.info("nothing is written by itself: %s", answer.reason)

    async def _still_ours(self) -> bool:
        """Read the offsets; return whether they are unchanged: another station could have changed them unnoticed."""
        try:
            same = [await imu.refresh() for imu in self._imus.values()]
        except AutopilotError as error:
            logger.info("nothing is written by itself: %s", error)
            return False
        self._in_force.poll(writing=False)
        return all(same)

    def _is_possible(self) -> bool:
        needed = (Precondition.IDLE, Precondition.DISARMED, Precondition.ARM_STATE_KNOWN)
        if self._manager.blocking_reason(needed) is not None:
            return False
        status = self._core.collector.status(asyncio.get_running_loop().time())
        return status.waiting_for is None and status.enough and self._in_force.measured

    def _stop(self, why: str) -> None:
        self.stopped = why
        if self.wanted:
            logger.warning("no automatic calibration until the next request: %s", why)
            self._core.say(Severity.WARNING, f"Auto calibration off until asked: {why}", Weight.REFUSAL)

    def on_ended(self, job: Job, result: JobResult) -> None:
        now_s = asyncio.get_running_loop().time()
        if job.kind == "undo":
            if result.outcome == "done" and job.undid_calibration:
                self._stop("undone")
        elif job.kind in NO_CALIBRATION:
            if result.outcome == "cancelled":  # whoever cancels an alignment has the aircraft in hand, in any pose
                self._next_s = max(self._next_s, now_s + SPACING_S)
        elif not job.automatic:
            self._next_s = now_s + SPACING_S
            if result.outcome == "done":
                self.stopped, self._failures = None, 0
        else:
            if job.record is not None and job.record.written:
                self._writes = [*self._writes, {"at_unix_s": time.time()}][-PER_DAY - 8 :]
                self._unsaved = True
            if result.outcome == "done":
                self._failures, self._next_s = 0, now_s + SPACING_S
            elif result.outcome == "cancelled":
                self._stop("cancelled")
            elif self._core.vehicle.arm_state is ArmState.DISARMED:
                self._failures += 1
                self._next_s = now_s + RETRY_S * 2 ** (self._failures - 1)
                if self._failures >= FAILURES:
                    self._stop(f"failed {FAILURES} times")

    async def _keep(self) -> None:
        if self._unsaved:
            self._unsaved = False
            try:
                await self._core.offload(self._file.write, self._writes)
            except StorageError as error:
                logger.warning("automatic write not counted: %s", error)

    def status(self) -> dict[str, object]:
        return {
            "wanted": self.wanted,
            "stopped": self.stopped,
            "writes_today": self._writes_today(),
            "most_per_day": PER_DAY,
        }
