"""Calibrations that nobody asked for: so that a fresh result is in force before anyone arms.

A companion sees arming only after it has happened. So while the aircraft stands disarmed and still, and at_arm is
"gate" or "warn", it calibrates at the first opportunity, and again when that is worth it. Every write wears the
autopilot's flash: what is right already is not written (a still window that agrees counts as a calibration's proof),
and there are bounds on how often, which outlive a restart.

It never overwrites what somebody else has chosen: after an undo, a cancel, or a change by another station it stops
until the next request or restart, and says so.
"""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import Mapping
from typing import Final

import msgspec

from companion.autopilot.vehicle.vehicle import ArmState
from companion.component.service import JobResult, Refusal
from companion.component.statustext import Severity, Weight
from companion.daemon.arming.in_force import InForce
from companion.daemon.calibrating.manager import CalibrationManager
from companion.daemon.calibrating.why_not import Rung
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import NO_CALIBRATION, Job
from companion.errors import AutopilotError, StorageError
from companion.estimation.records.validity import Why
from companion.storage.state import BoundedList

logger = logging.getLogger(__name__)

REQUESTER: Final = "the companion itself"
POLL_S: Final = 1.0
SPACING_S: Final = 300.0
"""Between two automatic writes; the horizon of sigma_use is 180 s, so that nothing is lost by waiting."""
WORTH_FOR_S: Final = 30.0
"""How long better offsets must seem available before good ones are replaced."""
PER_BOOT: Final = 12
PER_DAY: Final = 24
"""A dozen parameters each: some 300 of the 10 000 rewrites that a page of flash is good for, spread over its log."""
FAILURES: Final = 3
RETRY_S: Final = 60.0
"""After a failure; doubled with each further one."""
TIMEOUT_S: Final = 180.0
_DAY_S: Final = 86400.0


class AutomaticWrite(msgspec.Struct, frozen=True):
    """One automatic calibration that wrote."""

    at_unix_s: float
    parameters: int


class Automatic:
    """Starts calibrations by itself; `run` decides when."""

    def __init__(
        self, core: Core, imus: Mapping[str, AutopilotImu], manager: CalibrationManager, in_force: InForce
    ) -> None:
        self._vehicle, self._collector, self._manager = core.vehicle, core.collector, manager
        self._wanted, self._only_listening = core.wanted, core.only_listening is not None
        self._imus, self._in_force = imus, in_force
        self._say, self._offload = core.say, core.offload
        self._file = BoundedList(core.config.storage.path / "automatic.json", AutomaticWrite, PER_DAY + 8)
        self._writes: list[AutomaticWrite] = []
        self._to_keep: list[AutomaticWrite] = []
        self._this_boot: tuple[int, int] = (0, 0)
        """Restarts of the autopilot seen, and automatic writes since the last one."""
        self._next_s = -math.inf
        self._failures = 0
        self.turns = 0
        """Of `run`, so that it is seen to go on."""
        self.stopped: str | None = None
        """Why it waits for a request, for people; None while it works."""

    # --- may it

    @property
    def wanted(self) -> bool:
        """Whether the configuration, or what was set since, asks for it."""
        return self._wanted.at_arm != "off" and self._wanted.push and not self._only_listening

    def why_not(self) -> str | None:
        """Why none will start by itself, as what to do about it; None when one will as soon as it is needed."""
        if not self.wanted or self.stopped is not None:
            return "calibrate"
        if self._writes_today() >= PER_DAY or self._writes_this_boot() >= PER_BOOT:
            return "calibrate (flash spared)"
        if (wait_s := self._next_s - asyncio.get_running_loop().time()) > 0 and not self._is_urgent():
            return f"again in {math.ceil(wait_s / 60)} min"
        return None

    def _is_urgent(self) -> bool:
        """A boot that threw our values away, or a new zero, is not answered with patience; failures are."""
        whys = {finding.why for finding in self._in_force.findings(asyncio.get_running_loop().time())}
        return bool(whys & {Why.REPLACED, Why.ALIGNED}) and self._failures == 0

    def _writes_this_boot(self) -> int:
        boots, writes = self._this_boot
        return writes if boots == self._vehicle.boots else 0

    def _writes_today(self) -> int:
        # The clock of a field computer may jump: what seems to lie in the future counts as of today.
        since_s = time.time() - _DAY_S
        return sum(write.at_unix_s > since_s for write in self._writes)

    # --- the work

    async def run(self) -> None:
        """Calibrate whenever it is worth it, until cancelled."""
        self._writes = await self._offload(self._file.read)
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
        if self._in_force.offsets.foreign is not None and self.stopped is None:
            self._stop(self._in_force.offsets.foreign)
        in_force, now_s = self._in_force, asyncio.get_running_loop().time()
        if self.why_not() is not None or not (in_force.findings(now_s) or in_force.worth_writing_s >= WORTH_FOR_S):
            return
        if self._is_possible() and await self._still_ours() and self._is_possible():
            answer = self._manager.start_calibration(self._in_force.what, REQUESTER, TIMEOUT_S, automatic=True)
            if isinstance(answer, Refusal):
                logger.info("nothing is written by itself: %s", answer.reason)

    async def _still_ours(self) -> bool:
        """What another station has set unheard by us must not be overwritten by what nobody asked for."""
        try:
            same = [await imu.refresh() for imu in self._imus.values()]
        except AutopilotError as error:
            logger.info("nothing is written by itself: %s", error)
            return False
        self._in_force.poll(writing=False)
        return all(same)

    def _is_possible(self) -> bool:
        """Disarmed, nothing else runs, and the window would not get better by waiting."""
        if self._manager.why_not((Rung.BUSY, Rung.ARMED, Rung.UNKNOWN)) is not None:
            return False
        status = self._collector.status(asyncio.get_running_loop().time())
        return status.waiting_for is None and status.enough and self._in_force.measured

    def _stop(self, why: str) -> None:
        self.stopped = why
        if not self.wanted:
            return
        logger.warning("no automatic calibration until the next request: %s", why)
        self._say(Severity.WARNING, f"Auto calibration off until asked: {why}", Weight.REFUSAL)

    # --- what comes of it

    def on_ended(self, job: Job, result: JobResult) -> None:
        """Count an automatic calibration, and decide when the next one may start."""
        if job.kind in NO_CALIBRATION:
            return
        now_s = asyncio.get_running_loop().time()
        if job.kind == "undo":
            if result.outcome == "done" and job.undid_calibration:
                self._stop("undone")
            return
        if not job.automatic:
            self.stopped, self._failures = None, 0
            self._next_s = now_s + SPACING_S
            return
        self._count(job)
        if result.outcome == "done":
            self._failures = 0
            self._next_s = now_s + SPACING_S
        elif result.outcome == "cancelled":
            self._stop("cancelled")
        elif self._vehicle.arm_state is ArmState.DISARMED:
            self._failures += 1
            self._next_s = now_s + RETRY_S * 2 ** (self._failures - 1)
            if self._failures >= FAILURES:
                self._stop(f"failed {FAILURES} times")

    def _count(self, job: Job) -> None:
        parameters = sum(len(imu.written) for imu in job.record.imus) if job.record is not None else 0
        if parameters:
            write = AutomaticWrite(time.time(), parameters)
            self._writes = [*self._writes, write][-PER_DAY - 8 :]
            self._to_keep.append(write)
            self._this_boot = (self._vehicle.boots, self._writes_this_boot() + 1)

    async def _keep(self) -> None:
        while self._to_keep:
            write = self._to_keep.pop()
            try:
                await self._offload(self._file.append, write)
            except StorageError as error:
                logger.warning("automatic write not counted: %s", error)

    def status(self) -> dict[str, object]:
        """For `companion status`."""
        return {
            "wanted": self.wanted,
            "stopped": self.stopped,
            "writes_this_boot": self._writes_this_boot(),
            "writes_today": self._writes_today(),
            "most_per_boot": PER_BOOT,
            "most_per_day": PER_DAY,
        }
