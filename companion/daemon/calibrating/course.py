"""The course of one calibration: measure, work out, write, watch its effect, see to it that it is used.

It tells the state table where it is and raises where it cannot go on; who may start it, and what becomes of its end,
is the conductor's.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Container, Mapping
from typing import Final, NamedTuple

import msgspec

from companion.autopilot.parameters.change import WriteFailedError
from companion.autopilot.vehicle.vehicle import ArmState
from companion.calibration.collector.outlook import Settings, Status
from companion.calibration.machine import Event, State
from companion.calibration.means.windows import Window
from companion.calibration.request import What
from companion.calibration.solution.draft import Draft, unseen_turn
from companion.calibration.solution.history import Point
from companion.calibration.solution.joint import Weighed, weigh
from companion.calibration.solution.prior import Expectation
from companion.calibration.solution.solve import Solution
from companion.component.service import MEASURED_PERCENT, WRITTEN_PERCENT
from companion.component.statustext import Severity
from companion.component.tunes import Tune
from companion.config.sections import Platform
from companion.configured import models
from companion.daemon.calibrating import held_back
from companion.daemon.calibrating.bias_memory import BiasMemory
from companion.daemon.calibrating.solver import Given, Solver
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu, not_ready
from companion.daemon.job import Job
from companion.daemon.offsets.dither import Ditherer
from companion.daemon.offsets.effect import TELEMETRY
from companion.daemon.offsets.plan import Planner
from companion.daemon.offsets.push import Conclusion, Pusher
from companion.errors import AutopilotError, CalibrationRefusedError
from companion.links.system.listeners import Listeners
from companion.samples import Triad

logger = logging.getLogger(__name__)

WRONG_IMU_ATTEMPTS: Final = 3
"""Of three IMUs two may have been taken for the one that is meant."""
_STARTED: Final[dict[Platform, str]] = {
    "ground": "Calibration started: keep the aircraft still",
    "deck": "Calibration started: the deck may sway",
}
_WATCHING: Final = "watching the telemetry take the new offsets"
POLL_S: Final = 0.2
"""A complete second is looked at when it is; this is how often for whatever else may change."""
SAY_WAITING_EVERY_S: Final = 10.0
SAY_LEFT_EVERY_S: Final = 75.0
"""Through minutes in which nothing is in the way; the first minute of a deck says nothing yet."""
READ_ATTEMPTS: Final = 2
"""How often, within one calibration, the autopilot's offsets may fail to be read."""
MOST_UPSETS: Final = 5
"""How often, within one calibration, other offsets may come into force, or the autopilot restart."""


class Stand(NamedTuple):
    """How the aircraft stands at this moment."""

    status: Status
    waiting_for: str | None
    """What is in the way of measuring."""
    hold_still_s: int | None
    """For how long to hold still, where nothing else is."""


class Measuring:
    """Of one aircraft, for one job at a time."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu]) -> None:
        self._core, self._machine, self._imus = core, core.machine, imus
        self._upsets: dict[str, int] = {}
        """By IMU, how many there had been before this calibration."""
        self._said, self._said_s = "", -math.inf

    def begin(self) -> None:
        """A calibration begins, which may measure more than once."""
        self._said, self._said_s = "", -math.inf
        self._upsets = {name: imu.upsets for name, imu in self._imus.items()}

    async def read_state(self, job: Job, if_armed: str | None) -> Stand:
        """How it stands now.

        Args:
            job: what it is looked at for.
            if_armed: why the job fails where it was armed since it began; None: it goes on once it is disarmed.

        Raises:
            CalibrationRefusedError: armed (in those words), or out of time.
        """
        armed = self._core.vehicle.arm_state is ArmState.ARMED
        if if_armed is not None and (armed or job.was_armed):
            raise CalibrationRefusedError(if_armed)
        job.check_time()
        await self._core.catch_up()
        status = self._core.collector.status(asyncio.get_running_loop().time())
        if armed:
            return Stand(status, "armed: it goes on once it is disarmed", None)
        other = not_ready(self._core.vehicle, self._imus) or models.place_doubt(self._core.config, self._core.vehicle)
        if other is not None or status.obstacle is None:
            return Stand(status, other, None)
        return Stand(status, status.obstacle.words, status.obstacle.hold_still_s)

    def show(self, *, measuring: bool) -> None:
        """Let the state table follow."""
        if measuring and self._machine.state is State.WAITING:
            self._machine.on(Event.STILL)
        elif not measuring and self._machine.state is State.COLLECTING:
            self._machine.on(Event.MOVED)

    async def measure(self, job: Job) -> Window:
        """Wait for stillness and for enough of it; returns the averages.

        Raises:
            CalibrationRefusedError: armed in the middle, out of time, or the readings fail their checks.
            JobCancelledError: cancelled.
        """
        collector = self._core.collector
        collector.retarget(self._wanted(job.what))
        failures = {name: imu.failures for name, imu in self._imus.items()}
        stop = collector.seconds.add(job.look_again)
        try:
            while True:
                status, waiting_for, hold_still_s = await self.read_state(job, "armed; nothing written")
                self._check_imus(failures)
                self.show(measuring=waiting_for is None)
                words = waiting_for or status.measuring
                job.progress(MEASURED_PERCENT * status.progress, words, hold_still_s)
                if waiting_for is None and status.enough:
                    self._machine.on(Event.ENOUGH)
                    job.progress(MEASURED_PERCENT, "working out the biases")
                    return await self._core.window()
                if waiting_for or status.left:
                    self.tell(job, words, SAY_WAITING_EVERY_S if waiting_for else SAY_LEFT_EVERY_S)
                await job.pause(POLL_S)
        finally:
            stop()

    def tell(self, job: Job, words: str, every_s: float = SAY_WAITING_EVERY_S) -> None:
        """Tell whoever has asked what is waited for: news, and not too often."""
        now_s = asyncio.get_running_loop().time()
        if words != self._said and not job.automatic and now_s - self._said_s >= every_s:
            self._said, self._said_s = words, now_s
            self._core.say(Severity.INFO, f"Calibration: {words}")

    def _check_imus(self, failures: dict[str, int]) -> None:
        for name, imu in self._imus.items():
            failures[name] = min(failures[name], imu.failures)
            if imu.failures - failures[name] >= READ_ATTEMPTS:
                # Patience is for what can change by itself; an autopilot that does not answer is a fault.
                raise AutopilotError(f"imu {name}: {imu.problem}")
            if (upsets := imu.upsets - self._upsets.get(name, 0)) >= MOST_UPSETS:
                raise AutopilotError(
                    f"{imu.upset}, {upsets} times now: does something else write, or pretend to be the autopilot?"
                )

    def _wanted(self, what: What) -> Settings:
        """The targets of what was asked for; the rest may be as bad as it likes."""
        settings = self._core.wanted.settings
        return msgspec.structs.replace(
            settings,
            target_gyro_sigma_rad_s=settings.target_gyro_sigma_rad_s if what.gyros else math.inf,
            target_accel_sigma_m_s2=settings.target_accel_sigma_m_s2 if what.accelerometers else math.inf,
        )


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
        whole = memory.whole(solution)
        weighed: Weighed = await offload(weigh, solution, whole, expectation)
        started_at = draft.started_at.isoformat(timespec="milliseconds")
        # From here on nobody can make this job theirs, so that a request is never answered with half of it.
        writes = job.automatic and self._core.wanted.push
        held = {key: doubt for key, doubt in weighed.doubted.items() if writes and key[0] in self._written}
        job.hold_back(held)
        draft.solution, draft.held_back = weighed.solution, dict(held)
        draft.points = _less(memory.measured(solution, whole, weighed.doubts, started_at, unix_s), draft.held_back)
        for doubt in weighed.doubts:
            self._core.say(Severity.WARNING, doubt.words)
        if not job.automatic:
            for words in unseen_turn(weighed.solution):
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
        job.check_cancelled()
        if not plan.changes:
            self._machine.on(Event.NOTHING_TO_WRITE)
            return
        self._machine.on(Event.WRITE)
        job.progress(MEASURED_PERCENT, f"writing {len(plan.changes)} parameters")

        def go_on(words: str) -> None:
            job.check_cancelled()
            now_s = asyncio.get_running_loop().time()
            still_s = self._core.collector.status(now_s).still_s
            moves = self._core.collector.glance(now_s).moves
            if moves is not None and words != TELEMETRY:
                self._measuring.tell(job, moves)
            share = min(still_s / self._core.wanted.settings.min_still_s, 1.0)
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
            if await self._pusher.offsets_still_hold():
                window = await self._ditherer.refine(measured, job, draft)
                if window is measured or await self._pusher.offsets_still_hold():
                    return measured, window
            # The window holds telemetry under other offsets than those now in force.
            self._machine.on(Event.MOVED)
