"""Stand after stand, each a still window, with words for whoever moves the aircraft.

Nobody has to press anything between the stands: a movement is seen, and the next stand begins when it has ended. So
one person alone can do it with the ground station's voice or the page; the command line only shows the same words.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Final, NamedTuple, TypeVar

import msgspec
import numpy as np

from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.component.service import JobResult
from companion.component.statustext import LINE_BYTES, Severity
from companion.component.tunes import Tune
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import Job
from companion.daemon.stands import align_steps
from companion.daemon.stands.align_steps import LEVEL, Hold, Plan, Seen
from companion.daemon.stands.measuring import POLL_S, Measuring
from companion.daemon.stands.taken import Taken
from companion.errors import CalibrationRefusedError
from companion.estimation.collector.outlook import Glance
from companion.estimation.machine import Event
from companion.estimation.means.windows import Window
from companion.physics.frames import Array
from companion.physics.units import DEG

STAND_S: Final = 12.0
"""Seconds of stillness for each stand: averaging beyond 10 s buys an accelerometer nothing (method 2.3)."""
SETTLE_S: Final = 1.0
STOP_WITHIN_DEG: Final = 5.0
"""Who would be that near what is asked for, or beyond, by the next look is told to stop."""
TURNS_DEG: Final = 2.0
"""From one look to the next, a second later."""
EARLY_S: Final = 3.0
"""A stand that has been measured for so long and moves was moved too early; before, it is still being set down."""
STILL_MOVING_S: Final = 20.0
"""Whoever takes that long to move it may not know that a hand or the wind is still on it."""
ARMED: Final = "armed during the alignment; the earlier one stays in force"

LEANED_DEG: Final = 0.03
"""Half of it is in the mean: as much as marks leave when they are met again."""

_T = TypeVar("_T")


class Asked(NamedTuple):
    """A stand that is asked for."""

    number: int
    """From 1."""
    total: int
    """How many there will be, about."""
    wish: str
    hold: Hold
    """The same as a picture."""
    unknown: tuple[str, ...] = ()
    """What the stands so far leave open, the worst first."""

    @property
    def words(self) -> str:
        """The same, counted; what comes behind its last pause need not be heard."""
        return f"{self.number} of {self.total}: {self.wish}"


class StandsShown(msgspec.Struct):
    """Where the latest alignment stands, for a page that may be closed and opened again meanwhile, and after it."""

    kind: str
    number: int
    total: int
    wish: str
    hold: Hold
    unknown: tuple[str, ...] = ()
    words: str = ""
    objection: str | None = None
    """Why what stood there last was not what was asked for."""
    share: float = 0.0
    """Of the present stand, 0 to 1."""
    done: list[tuple[float, float, float]] = []
    """Up in the aircraft's axes, of each stand so far, as its accelerometers read it."""
    outcome: str | None = None
    """None while it runs."""


class _Attempt:
    """At one stand, until it is the one that was asked for."""

    def __init__(self, since_s: float, *, moved: bool) -> None:
        self.since_s, self.moved = since_s, moved
        """Since when it has not moved; whether it has at all since the stand before, or since it was objected to."""
        self.still_s = 0.0
        self.moving_s = math.inf
        """Since when it has moved without a pause."""
        self.why = ""
        """What was wrong last."""
        self.told = False
        """To hold still."""


class Stands:
    """Of one aircraft, for one job at a time."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu], measuring: Measuring) -> None:
        self._core, self._machine, self._collector, self._say = core, core.machine, core.collector, core.say
        self._imus, self._measuring = imus, measuring
        self._stand_s = max(STAND_S, core.config.calibration.min_still_s)
        self._last: Window | None = None
        self._first: dict[str, ImuCalibration] = {}
        self.shown: StandsShown | None = None
        """None before the first alignment."""

    def begin(self, job: Job, *, imus_alone: bool = False) -> None:
        """The next stand is the first, of this job.

        `imus_alone`: until it ends nobody waits for a gradienter or a compass: turned over, either may fall silent.
        """
        self._last, self._first = None, {}
        self._collector.count_turns(wanted=True)
        if imus_alone:
            self._collector.expect(gradienter=False, compass=False)
        self.shown = shown = StandsShown(job.kind, 1, 1, "", Hold(LEVEL))

        def ended(result: asyncio.Future[JobResult]) -> None:
            shown.outcome, shown.words, shown.share = result.result().outcome, result.result().reason, 0.0
            self._collector.count_turns(wanted=False)
            if imus_alone:
                config = self._core.config
                self._collector.expect(gradienter=config.gradienter is not None, compass=config.compass is not None)

        job.finished.add_done_callback(ended)

    async def next(
        self, job: Job, asked: Asked, take: Callable[[Window], tuple[_T, str | None]], if_armed: str | None = ARMED
    ) -> _T:
        """Wait until it stands as it should, and measure; returns what the first window told that was.

        `take` says what a window tells, and why it is not the stand that was asked for, if it is not.

        Raises:
            CalibrationRefusedError: armed (`if_armed` as in `Measuring.read_state`), out of time, or what was measured
                before is void.
            JobCancelledError: cancelled.
        """
        loop = asyncio.get_running_loop()
        number, total, wish, *_ = asked
        shown = self._show(asked)
        if number > 1:
            self._machine.on(Event.MOVED)
            self._core.tunes.play(Tune.NEXT)
        self._say(Severity.NOTICE, asked.words)
        # Whoever asks may yet put it down on a better spot: what was before that does not count.
        at = _Attempt(loop.time() if self._last is None else self._last.end_s, moved=self._last is None)
        turn = self._turn(asked)
        while True:
            now_s = loop.time()
            status, waiting_for, hold_still_s = await self._measuring.read_state(job, if_armed)
            self._check_known()
            glance = self._collector.glance(now_s)
            self._look(at, glance, now_s, asked)
            at.still_s = min(status.still_s, now_s - at.since_s - SETTLE_S)
            # What only has to go on standing still is measured from its first second on, and told so.
            standing = at.moved and (waiting_for is None or hold_still_s is not None)
            share = min(max(at.still_s, 0.0) / self._stand_s, 1.0) if standing else 0.0
            if not at.moved:
                words = f"{at.why or wish}; waiting for it to move"
            elif not standing:
                words = f"{at.why or wish}; {(glance.moving and turn(now_s)) or waiting_for}"
            else:
                turned = turn(now_s)
                words = f"measuring, {max(at.still_s, 0.0):.0f} of {self._stand_s:.0f} s, hands off"
                words += f" ({turned})" if turned else ""
                if not at.told:
                    at.told = True
                    self._core.prompt(Tune.HOLD_STILL, "Hold still")
            self._measuring.show(measuring=share > 0.0)
            job.progress(100.0 * (number - 1 + share) / total, f"{number} of {total}: {words}")
            shown.words, shown.share, shown.objection = words, round(share, 3), at.why or None
            if at.moved and waiting_for is None and at.still_s >= self._stand_s:
                window = await self._core.window(since_s=at.since_s + SETTLE_S)
                found, objection = take(window)
                if (leaned := self._leaned(window)) is not None:
                    at.since_s = now_s
                    self._object(leaned, asked, at)
                elif objection is None:
                    self._last = window
                    self._first = self._first or self._offsets()
                    shown.done.append(_up(window))
                    self._machine.on(Event.ENOUGH)
                    return found
                else:
                    at.moved = False
                    self._measuring.show(measuring=False)
                    self._object(objection, asked, at)
            await job.pause(POLL_S)

    def _turn(self, asked: Asked) -> Callable[[float], str]:
        """What tells how far it has been turned by now, counted once a second, and says once when to stop."""
        last, wanted_deg, looked_s, turned_deg, told = self._last, asked.hold.turn_deg, -math.inf, math.nan, False

        def words(now_s: float) -> str:
            nonlocal looked_s, turned_deg, told
            if last is None or not wanted_deg:
                return ""
            if now_s - looked_s >= 1.0:
                imu, before_deg = last.imus[0], turned_deg
                counted = self._collector.counted(imu.name, last.end_s, now_s, np.array(imu.gyro_rad_s))
                looked_s, turned_deg = now_s, math.nan if counted is None else abs(counted.angle_rad) / DEG
                per_look_deg = turned_deg - before_deg
                if not told and per_look_deg > TURNS_DEG and turned_deg + per_look_deg > wanted_deg - STOP_WITHIN_DEG:
                    told = True
                    self._say(Severity.NOTICE, "Stop turning")
            return "" if math.isnan(turned_deg) else f"turned {turned_deg:.0f} of {wanted_deg:.0f} degrees"

        return words

    def _look(self, at: _Attempt, glance: Glance, now_s: float, asked: Asked) -> None:
        """Whether it moves, and say so to who may not know: it was measured already, or it takes long."""
        if not glance.moving:
            at.moving_s = math.inf
            return
        if glance.moves is not None and at.moved:
            at.moving_s = min(at.moving_s, now_s)
            if at.still_s >= EARLY_S:
                words = f"it moved after {at.still_s:.0f} of {self._stand_s:.0f} seconds: hands off"
                self._object(words, asked, at)
            elif now_s - at.moving_s >= STILL_MOVING_S:
                at.moving_s = now_s
                self._say(Severity.NOTICE, "It still moves: set it down, hands off")
        at.moved, at.since_s, at.still_s = True, now_s, 0.0

    def _show(self, asked: Asked) -> StandsShown:
        shown = self.shown
        assert shown is not None
        shown.number, shown.total, shown.wish, shown.hold, shown.unknown = asked
        return shown

    def _leaned(self, window: Window) -> str | None:
        """Of a hand that is taken off too slowly for a movement, or of ground that gives way."""
        forces = self._collector.forces_m_s2(window.imus[0].name, window.start_s, window.end_s)
        leaned_deg = align_steps.leaned(np.array(forces))
        if leaned_deg < LEANED_DEG:
            return None
        return f"it leaned by {leaned_deg:.2g} degrees: hands off, firm ground"

    def _object(self, objection: str, asked: Asked, at: _Attempt) -> None:
        """Where it is too long to be heard whole, with what is asked for once more."""
        at.why, at.told = objection, False
        self._core.prompt(Tune.WRONG, objection)
        if len(objection) > LINE_BYTES:
            self._say(Severity.NOTICE, asked.words)

    async def take(
        self, job: Job, plan: Plan, taken: Sequence[Taken], see: Callable[[Window], Taken], if_armed: str | None = ARMED
    ) -> Taken:
        """The next stand of a plan, as `next`; `see` says how it stands."""
        seen = [one.seen for one in taken]

        def fits(window: Window) -> tuple[Taken, str | None]:
            found = see(window)
            return found, align_steps.objection(plan, seen, found.seen)

        asked = Asked(len(taken) + 1, plan.total, *align_steps.request(plan, seen))
        return await self.next(job, asked, fits, if_armed)

    def turned(self, plan: Plan, taken: Sequence[Taken], now: Window, up: Array, first_sigma_deg: float) -> Taken:
        """A stand whose heading is what the gyros of the first IMU have counted since the one before.

        Where samples are missing, as when the autopilot restarts, it was turned as was asked.
        """
        if not taken:
            return Taken(now, Seen(up, 0.0), first_sigma_deg)
        seen, before, (imu, *_) = [one.seen for one in taken], taken[-1].window, now.imus
        bias = (np.array(before.imus[0].gyro_rad_s) + np.array(imu.gyro_rad_s)) / 2.0
        counted = self._collector.counted(imu.name, before.end_s, now.start_s, bias)
        turn_deg, sigma_deg = align_steps.asked_turn_deg(plan, seen), align_steps.BY_EYE_SIGMA_DEG
        if counted is not None:
            turn_deg, sigma_deg = counted.angle_rad / DEG, counted.sigma_rad / DEG
        return Taken(now, Seen(up, seen[-1].heading_deg + turn_deg), sigma_deg, counted=True)

    async def check_offsets(self) -> None:
        """Read them afresh: somebody may have changed them without a word.

        Raises:
            CalibrationRefusedError: what was measured before is void.
            AutopilotError: they cannot be read.
        """
        for name, imu in self._imus.items():
            holds = await imu.refresh()
            self._check_known()
            if not holds:
                raise _changed(name)

    def _check_known(self) -> None:
        for name, imu in self._imus.items():
            first, now = self._first.get(name), imu.calibration
            if first is None or now is None or first.corrects_like(now):
                continue
            for old, new in ((first.accel_id, now.accel_id), (first.gyro_id, now.gyro_id)):
                if old != new:
                    raise CalibrationRefusedError(
                        f"imu {name} was exchanged in between (device id {old}, now {new}): align again"
                    )
            raise _changed(name)

    def _offsets(self) -> dict[str, ImuCalibration]:
        return {name: imu.calibration for name, imu in self._imus.items() if imu.calibration is not None}


def _up(window: Window) -> tuple[float, float, float]:
    """Up in the aircraft's axes, as well as one IMU reads it."""
    read = np.array(window.imus[0].accel_m_s2)
    x, y, z = (read / max(float(np.linalg.norm(read)), 1e-9)).round(3).tolist()
    return x, y, z


def _changed(name: str) -> CalibrationRefusedError:
    return CalibrationRefusedError(f"the offsets of imu {name} were changed in between: align again")
