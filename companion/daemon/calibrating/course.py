"""The course of one calibration: wait for stillness, measure, work out, write, watch its effect, let the EKF settle.

It tells the state table where it is and raises where it cannot go on; who may start it, and what becomes of its end,
is the conductor's.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Container, Mapping
from typing import Final

import msgspec

from companion.autopilot.parameters.change import WriteFailedError
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.calibration.collector.rolling import Settings, Window
from companion.calibration.machine import Event, Machine, State
from companion.calibration.request import What
from companion.calibration.solution.draft import Draft
from companion.calibration.solution.history import Point, Triad
from companion.calibration.solution.joint import Weighed, weigh
from companion.calibration.solution.prior import Expectation
from companion.calibration.solution.site import Whereabouts
from companion.calibration.solution.solve import Solution, solve_at
from companion.component.service import MEASURED_PERCENT, WRITTEN_PERCENT
from companion.component.statustext import Say, Severity, Weight
from companion.config import Config
from companion.configured import models
from companion.daemon import offload as estimating
from companion.daemon.calibrating import held_back
from companion.daemon.calibrating.alignment import AlignmentInForce
from companion.daemon.calibrating.bias_memory import BiasMemory
from companion.daemon.devices.autopilot_imu import AutopilotImu, not_ready
from companion.daemon.job import Job, JobCancelledError
from companion.daemon.offload import Offload
from companion.daemon.offsets.dither import Ditherer
from companion.daemon.offsets.plan import Plan
from companion.daemon.offsets.push import Pusher
from companion.daemon.offsets.reboot import Reboot
from companion.errors import AutopilotError, CalibrationRefusedError
from companion.links.system.listeners import Listeners
from companion.recording.collector import RecordedCollector

logger = logging.getLogger(__name__)


POLL_S: Final = 0.2
"""A second that is complete is looked at when it is; so often at what else may change."""
SAY_WAITING_EVERY_S: Final = 10.0
READ_ATTEMPTS: Final = 2
"""So often, within one calibration, the autopilot's offsets may fail to be read."""
MOST_UPSETS: Final = 5
"""So often, within one calibration, other offsets may come into force, or the autopilot restart."""
WRONG_IMU_ATTEMPTS: Final = 3
"""Of three IMUs two may have been taken for the one that is meant."""
SETTLING_PERCENT: Final = 95.0


class Course:
    """What a calibration does, from the first look at the readings to offsets that are known to be in use."""

    def __init__(
        self,
        config: Config,
        machine: Machine,
        vehicle: Vehicle,
        collector: RecordedCollector,
        imus: Mapping[str, AutopilotImu],
        pusher: Pusher,
        say: Say,
        offload: Offload,
        reboot: Reboot,
        ditherer: Ditherer,
        alignment: AlignmentInForce,
        memory: BiasMemory,
    ) -> None:
        self._memory = memory
        self._config, self._vehicle, self._collector, self._imus = config, vehicle, collector, imus
        self._pusher, self._ditherer, self._reboot = pusher, ditherer, reboot
        self._say, self._offload, self._alignment = say, offload, alignment
        self.machine = machine
        self.settings = models.settings(config)
        """How good is good enough."""
        self._listeners: Listeners[Window, Window, Whereabouts, What, Expectation] = Listeners()
        self._written = {imu.name for imu in config.imu if imu.name in imus or imu.autopilot_instance is not None}
        """IMUs whose offsets are in the autopilot."""
        self._settled_by_s = 0.0
        self._upsets: dict[str, int] = {}
        """By IMU, how many there had been before this calibration."""

    def watch(self, tell: Callable[[Window, Window, Whereabouts, What, Expectation], object]) -> None:
        """Tell of every solution: the window measured and used, the place, what was asked for, what was known."""
        self._listeners.add(tell)

    def retarget(self, settings: Settings) -> None:
        """Change how good is good enough."""
        self.settings = settings

    @property
    def push(self) -> bool:
        """Whether results are written to the autopilot."""
        return self._pusher.enabled

    def switch(self, *, push: bool) -> None:
        """Change that."""
        self._pusher.enabled = push

    @property
    def settling_s(self) -> float:
        """For how long the autopilot's EKF will be waited for yet, at most."""
        return max(0.0, self._settled_by_s - asyncio.get_running_loop().time())

    @property
    def dither_s(self) -> float:
        """How long a dither under way will take yet."""
        return self._ditherer.left_s

    async def run(self, job: Job, draft: Draft) -> None:
        """Measure, work out, write, verify and settle, filling the draft on the way.

        Raises:
            CompanionError: it failed, and why; the autopilot is in order, or it is said what is not.
            JobCancelledError: cancelled; likewise.
        """
        if not job.automatic:
            self._say(Severity.NOTICE, "Calibration started: keep the aircraft still", Weight.NEWS)
        self._upsets = {name: imu.upsets for name, imu in self._imus.items()}
        for _ in range(WRONG_IMU_ATTEMPTS - 1):
            try:
                await self._measure_and_push(job, draft)
            except WriteFailedError as error:
                if error.kind not in ("not as believed", "without effect") or error.left_changed:
                    raise
                self.machine.on(Event.MOVED)
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
        points = draft.points
        if self._pusher.enabled and not job.automatic:
            # Who has asked was told of every contradiction, and has what was measured in force: that is true now.
            points = {name: point.as_chosen() for name, point in points.items()}
        await self._memory.keep(points)
        if draft.held_back:
            draft.notes.append(f"{held_back.in_words(draft.held_back)} held back")

    async def _measure_and_push(self, job: Job, draft: Draft) -> None:
        self._collector.retarget(self._wanted(job.what))
        while True:
            self._collector.on_second = job.look_again
            try:
                measured = window = await self._measure(job)
            finally:
                self._collector.on_second = _nobody
            if await self._pusher.offsets_still_hold():
                window = await self._refine(measured, job, draft)
                if window is measured or await self._pusher.offsets_still_hold():
                    break
            # The window holds telemetry under other offsets than those now in force.
            self.machine.on(Event.MOVED)
        where = models.whereabouts(self._config, self._vehicle)
        solution: Solution = await self._offload(
            solve_at,
            window,
            where,
            self._alignment.model(),
            models.compass_model(self._config.compass),
            job.what,
        )
        draft.alignment = self._alignment.used
        draft.measured_s = (measured.start_s, measured.end_s)
        solution = await self._weighed(
            solution,
            job,
            draft,
            lambda expectation: self._listeners.tell(measured, window, where, job.what, expectation),
        )
        plan = await self._pusher.plan(solution, draft)
        job.check_cancelled()
        if not plan.changes:
            self.machine.on(Event.NOTHING_TO_WRITE)
            return
        self.machine.on(Event.WRITE)
        job.progress(MEASURED_PERCENT, f"writing {len(plan.changes)} parameters")

        def go_on(words: str) -> None:
            job.check_cancelled()
            share = self._collector.status(asyncio.get_running_loop().time()).still_s / self.settings.min_still_s
            job.progress(
                WRITTEN_PERCENT + (100.0 - WRITTEN_PERCENT) * min(share, 1.0),
                words or "watching the telemetry take the new offsets",
            )

        async with self._pusher.written(plan, draft, lambda words: job.progress(MEASURED_PERCENT, words)) as plan:
            self.machine.on(Event.WRITTEN)
            job.progress(WRITTEN_PERCENT, "watching the telemetry take the new offsets")
            await self._pusher.verify(plan, window, draft, go_on)
        if job.reboot:
            self.machine.on(Event.REBOOT)
        boots = self._vehicle.boots
        await self._reboot.conclude(job, plan, window, draft)
        self.machine.on(Event.VERIFIED)
        if self._vehicle.boots == boots:  # after a restart the EKF has started afresh
            await self._settle(job, plan, draft)
            if self._vehicle.boots != boots:
                await self._reboot.survived(plan, draft)
        self.machine.on(Event.CONCLUDED)

    async def _weighed(
        self, solution: Solution, job: Job, draft: Draft, tell: Callable[[Expectation], None]
    ) -> Solution:
        """The solution with what is known from before; fills the draft, and says what contradicts.

        What contradicts is written where somebody has asked for it. Of a calibration by itself it is held back: what
        is in force was right once, and a gradienter that has moved would spoil it without anybody having looked.

        Raises:
            AutopilotError: the offsets in force are not known at the moment.
        """
        draft.solution = solution
        unix_s = draft.started_at.timestamp()
        for name, words in self._memory.forgotten().items():
            draft.warn(name, words)
        expectation: Expectation = await self._offload(self._memory.expectation, solution, unix_s)
        tell(expectation)
        whole = self._memory.whole(solution)
        weighed: Weighed = await self._offload(weigh, solution, whole, expectation)
        started_at = draft.started_at.isoformat(timespec="milliseconds")
        draft.points = self._memory.measured(solution, whole, weighed.doubts, started_at, unix_s)
        draft.solution = weighed.solution
        # From here on nobody can make this job theirs, so that a request is never answered with half of it.
        writes = job.automatic and self._pusher.enabled
        job.held_back = {key: doubt for key, doubt in weighed.doubted.items() if writes and key[0] in self._written}
        draft.held_back = dict(job.held_back)
        draft.points = _less(draft.points, draft.held_back)
        for doubt in weighed.doubts:
            self._say(Severity.WARNING, doubt.words, Weight.NEWS)
        if draft.held_back:
            what = held_back.in_words(draft.held_back)
            self._say(
                Severity.WARNING, f"Held back: {what}; calibrate on request to write it all the same", Weight.NEWS
            )
        return weighed.solution

    async def _settle(self, job: Job, plan: Plan, draft: Draft) -> None:
        """The write is done and stays; a cancel ends only the waiting for the autopilot's EKF."""

        def go_on(words: str) -> None:
            job.check_cancelled()
            job.progress(SETTLING_PERCENT, words)

        self._settled_by_s = asyncio.get_running_loop().time() + self._pusher.settles_within_s(plan)
        try:
            words = await self._pusher.settle(plan, go_on)
        except JobCancelledError as cancelled:
            words = f"{cancelled} while the EKF was settling: the new offsets stay, wait 2 min before take-off"
        if words is not None:
            draft.warnings.append(words)
            self._say(Severity.WARNING, words, Weight.NEWS)

    async def _refine(self, window: Window, job: Job, draft: Draft) -> Window:
        """The window with better means for IMUs whose integers do not tell, where that is allowed."""
        if not self._pusher.enabled:
            return window
        return await self._ditherer.refine(window, job, draft, lambda words: job.progress(MEASURED_PERCENT, words))

    def _wanted(self, what: What) -> Settings:
        """The targets of what was asked for; the rest may be as bad as it likes."""
        return msgspec.structs.replace(
            self.settings,
            target_gyro_sigma_rad_s=self.settings.target_gyro_sigma_rad_s if what.gyros else math.inf,
            target_accel_sigma_m_s2=self.settings.target_accel_sigma_m_s2 if what.accelerometers else math.inf,
        )

    async def _measure(self, job: Job) -> Window:
        """Wait for stillness and for enough of it; returns the averages.

        Raises:
            CalibrationRefusedError: armed in the middle, out of time, or the readings fail their checks.
            JobCancelledError: cancelled.
        """
        loop = asyncio.get_running_loop()
        said_s = -math.inf
        said = ""
        failures = {name: imu.failures for name, imu in self._imus.items()}
        while True:
            now_s = loop.time()
            if job.armed or self._vehicle.arm_state is ArmState.ARMED:
                raise CalibrationRefusedError("armed during the measurement; nothing was written")
            for name, imu in self._imus.items():
                failures[name] = min(failures[name], imu.failures)
                if imu.failures - failures[name] >= READ_ATTEMPTS:
                    # Patience is for what can change by itself; an autopilot that does not answer is a fault.
                    raise AutopilotError(f"imu {name}: {imu.problem}")
                if (upsets := imu.upsets - self._upsets.get(name, 0)) >= MOST_UPSETS:
                    raise AutopilotError(
                        f"{imu.upset}, {upsets} times now: does something else write, or pretend to be the autopilot?"
                    )
            await estimating.catch_up(self._collector, self._offload)
            status = self._collector.status(now_s)
            doubt = models.place_doubt(self._config, self._vehicle)
            waiting_for = not_ready(self._vehicle, self._imus) or doubt or status.waiting_for
            if waiting_for is not None:
                if self.machine.state is State.COLLECTING:
                    self.machine.on(Event.MOVED)
                job.progress(MEASURED_PERCENT * status.progress, waiting_for)
                if not job.automatic and waiting_for != said and now_s - said_s >= SAY_WAITING_EVERY_S:
                    said, said_s = waiting_for, now_s
                    self._say(Severity.INFO, f"Calibration: {waiting_for}", Weight.NEWS)
            else:
                if self.machine.state is State.WAITING:
                    self.machine.on(Event.STILL)
                job.progress(MEASURED_PERCENT * status.progress, f"still for {status.still_s:.0f} s, measuring")
                if status.enough:
                    self.machine.on(Event.ENOUGH)
                    job.progress(MEASURED_PERCENT, "working out the biases")
                    return await estimating.window(self._collector, self._offload)
            if job.deadline_s is not None and now_s >= job.deadline_s:
                raise CalibrationRefusedError(f"not finished in the time given: {job.words}")
            await job.pause(POLL_S)


def _nobody() -> None:
    """Waits for the next second."""


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
