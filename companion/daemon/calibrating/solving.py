"""From a window to biases: by the readings, then with what is known from before, then what of it may be written."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping

import msgspec

from companion.calibration.collector.rolling import Window
from companion.calibration.request import What
from companion.calibration.solution.draft import Draft
from companion.calibration.solution.history import Point
from companion.calibration.solution.joint import Weighed, weigh
from companion.calibration.solution.prior import Expectation
from companion.calibration.solution.site import Whereabouts
from companion.calibration.solution.solve import Solution, solve_at
from companion.component.statustext import Severity
from companion.configured import models
from companion.daemon.calibrating import held_back
from companion.daemon.calibrating.alignment import AlignmentInForce
from companion.daemon.calibrating.bias_memory import BiasMemory
from companion.daemon.core import Core
from companion.daemon.job import Job
from companion.links.system.listeners import Listeners
from companion.samples import Triad


class Solving:
    """Works out biases, and remembers those that have come to a good end."""

    def __init__(self, core: Core, alignment: AlignmentInForce, memory: BiasMemory) -> None:
        self._core, self._alignment, self._memory = core, alignment, memory
        self._listeners: Listeners[Window, Window, Whereabouts, What, Expectation] = Listeners()
        self._written = {imu.name for imu in core.config.imu if imu.source == "autopilot" or imu.autopilot_instance}
        """IMUs whose offsets are in the autopilot."""

    def watch(self, tell: Callable[[Window, Window, Whereabouts, What, Expectation], object]) -> None:
        """Tell of every solution: the window measured and used, the place, what was asked for, what was known."""
        self._listeners.add(tell)

    async def solve(self, measured: Window, window: Window, job: Job, draft: Draft, *, push: bool) -> Solution:
        """The biases; fills the draft, and says what contradicts earlier ones.

        What contradicts is written where somebody has asked for it. Of a calibration by itself it is held back: what
        is in force was right once, and a gradienter that has moved would spoil it without anybody having looked.

        Raises:
            AutopilotError: the offsets in force are not known at the moment.
        """
        config, offload, memory = self._core.config, self._core.offload, self._memory
        where = models.whereabouts(config, self._core.vehicle)
        compass = models.compass_model(config.compass)
        solution: Solution = await offload(solve_at, window, where, self._alignment.model(), compass, job.what)
        draft.alignment, draft.solution = self._alignment.used, solution
        draft.measured_s = (measured.start_s, measured.end_s)
        unix_s = draft.started_at.timestamp()
        for name, words in memory.forgotten().items():
            draft.warn(name, words)
        expectation: Expectation = await offload(memory.expectation, solution, unix_s)
        self._listeners.tell(measured, window, where, job.what, expectation)
        whole = memory.whole(solution)
        weighed: Weighed = await offload(weigh, solution, whole, expectation)
        started_at = draft.started_at.isoformat(timespec="milliseconds")
        # From here on nobody can make this job theirs, so that a request is never answered with half of it.
        writes = job.automatic and push
        job.held_back = {key: doubt for key, doubt in weighed.doubted.items() if writes and key[0] in self._written}
        draft.solution, draft.held_back = weighed.solution, dict(job.held_back)
        draft.points = _less(memory.measured(solution, whole, weighed.doubts, started_at, unix_s), draft.held_back)
        for doubt in weighed.doubts:
            self._core.say(Severity.WARNING, doubt.words)
        if draft.held_back:
            what = held_back.in_words(draft.held_back)
            self._core.say(Severity.WARNING, f"Held back: {what}; calibrate on request to write it all the same")
        return weighed.solution

    async def remember(self, job: Job, draft: Draft, *, push: bool) -> None:
        """The calibration has come to a good end."""
        points = draft.points
        if push and not job.automatic:
            # Who has asked was told of every contradiction, and has what was measured in force: that is true now.
            points = {name: point.as_chosen() for name, point in points.items()}
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
