"""The course of one calibration: measure, work out, write, watch its effect, see to it that it is used.

It tells the state table where it is and raises where it cannot go on; who may start it, and what becomes of its end,
is the conductor's.
"""

from __future__ import annotations

import asyncio
import logging
from typing import Final

from companion.autopilot.parameters.change import WriteFailedError
from companion.calibration.collector.rolling import Window
from companion.calibration.machine import Event, Machine
from companion.calibration.solution.draft import Draft
from companion.component.service import MEASURED_PERCENT, WRITTEN_PERCENT
from companion.component.statustext import Severity
from companion.daemon.calibrating.measuring import Measuring
from companion.daemon.calibrating.solving import Solving
from companion.daemon.core import Core
from companion.daemon.job import Job
from companion.daemon.offsets.conclusion import Conclusion
from companion.daemon.offsets.dither import Ditherer
from companion.daemon.offsets.plan import Planner
from companion.daemon.offsets.push import Pusher

logger = logging.getLogger(__name__)

WRONG_IMU_ATTEMPTS: Final = 3
"""Of three IMUs two may have been taken for the one that is meant."""
_WATCHING: Final = "watching the telemetry take the new offsets"


class Course:
    """What a calibration does, from the first look at the readings to offsets that are known to be in use."""

    def __init__(
        self,
        core: Core,
        machine: Machine,
        measuring: Measuring,
        solving: Solving,
        ditherer: Ditherer,
        planner: Planner,
        pusher: Pusher,
        conclusion: Conclusion,
    ) -> None:
        self._core, self._machine = core, machine
        self._measuring, self._solving, self._ditherer = measuring, solving, ditherer
        self._planner, self._pusher, self._conclusion = planner, pusher, conclusion
        self.push = core.config.push.parameters
        """Whether results are written to the autopilot."""

    def switch(self, *, push: bool) -> None:
        """Change whether results are written."""
        self.push = push

    async def run(self, job: Job, draft: Draft) -> None:
        """Measure, work out, write, verify and settle, filling the draft on the way.

        Raises:
            CompanionError: it failed, and why; the autopilot is in order, or it is said what is not.
            JobCancelledError: cancelled; likewise.
        """
        if not job.automatic:
            self._core.say(Severity.NOTICE, "Calibration started: keep the aircraft still")
        self._measuring.begin()
        for _ in range(WRONG_IMU_ATTEMPTS - 1):
            try:
                await self._measure_and_push(job, draft)
            except WriteFailedError as error:
                if error.kind not in ("not as believed", "without effect") or error.left_changed:
                    raise
                self._machine.on(Event.MOVED)
                if error.kind == "not as believed":
                    logger.warning("%s; put back, measuring again for the right one", error.reason)
                    draft.begin_again(f"{error.reason}; put back, and written where it belongs")
                else:
                    logger.warning("%s; put back, measuring again", error.reason)
                    draft.begin_again(f"{error.reason}; put back, and tried again")
                job.check_cancelled()
            else:
                break
        else:
            await self._measure_and_push(job, draft)
        await self._solving.remember(job, draft, push=self.push)

    async def _measure_and_push(self, job: Job, draft: Draft) -> None:
        measured, window = await self._measure(job, draft)
        solution = await self._solving.solve(measured, window, job, draft, push=self.push)
        plan = await self._planner.plan(solution, draft, push=self.push)
        job.check_cancelled()
        if not plan.changes:
            self._machine.on(Event.NOTHING_TO_WRITE)
            return
        self._machine.on(Event.WRITE)
        job.progress(MEASURED_PERCENT, f"writing {len(plan.changes)} parameters")

        def go_on(words: str) -> None:
            job.check_cancelled()
            still_s = self._core.collector.status(asyncio.get_running_loop().time()).still_s
            share = min(still_s / self._measuring.settings.min_still_s, 1.0)
            job.progress(WRITTEN_PERCENT + (100.0 - WRITTEN_PERCENT) * share, words or _WATCHING)

        async with self._pusher.written(plan, draft, lambda words: job.progress(MEASURED_PERCENT, words)) as plan:
            self._machine.on(Event.WRITTEN)
            job.progress(WRITTEN_PERCENT, _WATCHING)
            await self._pusher.verify(plan, window, draft, go_on)
        await self._conclusion.conclude(job, plan, window, draft)
        self._machine.on(Event.CONCLUDED)

    async def _measure(self, job: Job, draft: Draft) -> tuple[Window, Window]:
        """A window of telemetry under the offsets in force; and the same, its means bettered where that is allowed."""
        while True:
            measured = window = await self._measuring.measure(job)
            if await self._pusher.offsets_still_hold(push=self.push):
                if self.push:
                    window = await self._ditherer.refine(measured, job, draft)
                if window is measured or await self._pusher.offsets_still_hold(push=self.push):
                    return measured, window
            # The window holds telemetry under other offsets than those now in force.
            self._machine.on(Event.MOVED)
