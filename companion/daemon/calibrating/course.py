"""The course of one calibration: measure, work out, write, watch its effect, see to it that it is used.

It tells the state table where it is and raises where it cannot go on; who may start it, and what becomes of its end,
is the conductor's.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Container, Mapping
from typing import Final

import msgspec

from companion.autopilot.parameters.change import WriteFailedError
from companion.component.service import WRITTEN_PERCENT
from companion.component.statustext import Severity
from companion.component.tunes import Tune
from companion.config.sections import Platform
from companion.daemon.biases.memory import BiasMemory
from companion.daemon.calibrating import held_back
from companion.daemon.calibrating.solver import Given, Solver
from companion.daemon.core import Core
from companion.daemon.job import Job
from companion.daemon.offsets.conclusion import Conclusion
from companion.daemon.offsets.dither import Ditherer
from companion.daemon.offsets.effect import TELEMETRY
from companion.daemon.offsets.plan import Planner
from companion.daemon.offsets.push import WATCHING, Pusher
from companion.daemon.stands.measuring import Measuring
from companion.estimation.machine import Event
from companion.estimation.means.windows import Window
from companion.estimation.records.history import Point
from companion.estimation.request import What
from companion.estimation.solution.draft import Draft, unseen_turn, when_warm
from companion.estimation.solution.joint import Weighed, weigh
from companion.estimation.solution.prior import Expectation
from companion.estimation.solution.solve import Solution
from companion.links.system.listeners import Listeners
from companion.samples import Triad

logger = logging.getLogger(__name__)

WRONG_IMU_ATTEMPTS: Final = 3
"""Of three IMUs two may have been taken for the one that is meant."""
_STARTED: Final[dict[Platform, str]] = {
    "ground": "Calibration started: keep the aircraft still",
    "deck": "Calibration started: the deck may sway",
}


class Solving:
    """Works out biases, and remembers those that have come to a good end."""

    def __init__(self, core: Core, solver: Solver, memory: BiasMemory) -> None:
        self._core, self._solver, self._memory = core, solver, memory
        self.on_solved: Listeners[Window, Window, Given, What, Expectation] = Listeners()
        """Told of every solution: the window measured and used, what else was given, what was asked for and known."""
        self._written = {imu.name for imu in core.config.imu if imu.source == "autopilot" or imu.autopilot_instance}
        """IMUs whose offsets are in the autopilot."""

    async def solve(self, measured: Window, window: Window, job: Job, draft: Draft) -> Solution:
        """The biases; fills the draft, and says what contradicts earlier ones.

        What contradicts is written where somebody has asked for it. Of a calibration by itself it is held back: what
        is in force was right once, and a gradienter that has moved would spoil it without anybody having looked.

        Raises:
            AutopilotError: the offsets in force are not known at the moment.
        """
        offload, memory = self._core.offload, self._memory
        solution, given = await self._solver.solve(window, job.what)
        draft.alignment, draft.solution = self._solver.alignment.used, solution
        draft.measured_s = (measured.start_s, measured.end_s)
        unix_s = draft.started_at.timestamp()
        for name, words in memory.forgotten().items():
            draft.warn(name, words)
        expectation: Expectation = await offload(memory.expectation, solution, unix_s)
        self.on_solved.tell(measured, window, given, job.what, expectation)
        draft.device_ids = memory.device_ids()
        whole = memory.whole(solution)
        weighed: Weighed = await offload(weigh, solution, whole, expectation)
        # From here on nobody can make this job theirs, so that a request is never answered with half of it.
        writes = job.automatic and self._core.wanted.push
        held = {key: doubt for key, doubt in weighed.doubted.items() if writes and key[0] in self._written}
        job.hold_back(held)
        draft.solution, draft.held_back = weighed.solution, dict(held)
        draft.points = _less(memory.measured(solution, whole, weighed.doubts, draft.started, unix_s), draft.held_back)
        for doubt in weighed.doubts:
            self._core.say(Severity.WARNING, doubt.words)
        if not job.automatic:
            for words in (*unseen_turn(weighed.solution), *when_warm(weighed.solution)):
                self._core.say(Severity.NOTICE, words)
        if draft.held_back:
            what = held_back.in_words(draft.held_back)
            self._core.say(Severity.WARNING, f"Held back: {what}; calibrate on request to write it all the same")
        return weighed.solution

    async def remember(self, job: Job, draft: Draft) -> None:
        """The calibration has come to a good end."""
        points = draft.points
        if self._core.wanted.push and not job.automatic:
            # Who has asked was told of every contradiction, and has what was measured in force: that is true now. But
            # gyros that may have turned are no new ones.
            told = draft.solution is not None and draft.solution.turn.by != "earlier calibrations"
            points = {name: point.as_chosen(gyro=told) for name, point in points.items()}
        await self._memory.keep(points)
        if draft.held_back:
            draft.notes.append(f"{held_back.in_words(draft.held_back)} held back")


def _less(points: Mapping[str, Point], less: Container[tuple[str, Triad]]) -> dict[str, Point]:
    """What is to be remembered: what was held back must not become a habit by being measured again and again."""
    left = {
        name: msgspec.structs.replace(
            point,
            gyro=None if (name, "gyro") in less else point.gyro,
            accel=None if (name, "accel") in less else point.accel,
        )
        for name, point in points.items()
    }
    return {name: point for name, point in left.items() if point.gyro is not None or point.accel is not None}


class Course:
    """What a calibration does, from the first look at the readings to offsets that are known to be in use."""

    def __init__(
        self,
        core: Core,
        measuring: Measuring,
        solving: Solving,
        ditherer: Ditherer,
        planner: Planner,
        pusher: Pusher,
        conclusion: Conclusion,
    ) -> None:
        self._core, self._machine = core, core.machine
        self._measuring, self._solving, self._ditherer = measuring, solving, ditherer
        self._planner, self._pusher, self._conclusion = planner, pusher, conclusion

    async def run(self, job: Job, draft: Draft) -> None:
        """Measure, work out, write, verify and settle, filling the draft on the way.

        Raises:
            CompanionError: it failed, and why; the autopilot is in order, or it is said what is not.
            JobCancelledError: cancelled; likewise.
        """
        if not job.automatic:
            platform = self._core.config.vehicle.platform
            self._core.say(Severity.NOTICE, _STARTED[platform])
            if platform == "ground":
                self._core.tunes.play(Tune.HOLD_STILL)
        self._measuring.begin()
        for left in reversed(range(WRONG_IMU_ATTEMPTS)):
            try:
                await self._measure_and_push(job, draft)
            except WriteFailedError as error:
                if not left or error.kind not in ("not as believed", "without effect") or error.left_changed:
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
        await self._solving.remember(job, draft)

    async def _measure_and_push(self, job: Job, draft: Draft) -> None:
        measured, window = await self._measure(job, draft)
        solution = await self._solving.solve(measured, window, job, draft)
        plan = await self._planner.plan(solution, draft, anyway=job.reboot)
        if not plan.changes:
            job.check_cancelled()
            self._machine.on(Event.NOTHING_TO_WRITE)
            return

        def go_on(words: str) -> None:
            job.check_cancelled()
            now_s = asyncio.get_running_loop().time()
            still_s = self._core.collector.status(now_s).still_s
            moves = self._core.collector.glance(now_s).moves
            if moves is not None and words != TELEMETRY:
                self._measuring.tell(job, moves)
            share = min(still_s / self._core.wanted.settings.min_still_s, 1.0)
            job.progress(WRITTEN_PERCENT + (100.0 - WRITTEN_PERCENT) * share, words or WATCHING)

        plan = await self._pusher.push(job, plan, window, draft, go_on)
        await self._conclusion.conclude(job, plan, window, draft)

    async def _measure(self, job: Job, draft: Draft) -> tuple[Window, Window]:
        """A window of telemetry under the offsets in force; and the same, its means bettered where that is allowed."""
        while True:
            measured = window = await self._measuring.measure(job)
            if await self._pusher.offsets_still_hold():
                window = await self._ditherer.refine(measured, job, draft)
                if window is measured or await self._pusher.offsets_still_hold():
                    return measured, window
            # The window holds telemetry under other offsets than those now in force.
            self._machine.on(Event.MOVED)
