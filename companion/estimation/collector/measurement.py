"""Interface that chooses the seconds of a window and caches its estimate, and the implementation for the ground.

A still stretch is the time since the aircraft came to rest. It begins with `min_still_s` good seconds in a row. After
these, at most 20 % of all its seconds are allowed to be bad (a gust, a knock), as the mean is robust. More than three
bad seconds in a row show that the aircraft was moved, and end the stretch.

Choosing the seconds takes far less time than the estimate, which another thread can therefore compute (`Work`).
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from companion.errors import CalibrationRefusedError
from companion.estimation.collector.intake import CollectorObstacle, CollectorStatus, Settings
from companion.estimation.means.pose import FieldWindow, heading_window, tilt_window
from companion.estimation.means.windows import WHITE_SHARE, Estimate, ImuInput, ImuWindow, Window, imu_window
from companion.estimation.seconds.batch import Batch, BatchSource
from companion.estimation.turning.turn import Turn
from companion.physics.frames import Floats

MIN_BATCHES: Final = 5
"""Least number of seconds in a window that verifies a write; fewer seconds do not show their own scatter."""
MAX_REJECTED: Final = 0.20
MAX_REJECTED_RUN: Final = 3
_NO_ROOM: Final = 1e-300


class Work(NamedTuple):
    """Computation of an estimate over the seconds `slots`, ascending. `since_s`: earliest start of `slots`, if any.

    `run` returns the estimate, or a `CalibrationRefusedError` with the reason; another thread may call it.
    """

    slots: Sequence[int]
    since_s: float | None
    generation: int
    run: Callable[[], Any]


class Measurement(msgspec.Struct, frozen=True, kw_only=True):
    """Readings of one window, and the function that computes the estimate from these readings; immutable.

    `slots`: good seconds, ascending, at least one. `tilt`, `heading`: batches of gradienter and compass from seconds in
    which these were settled; None without the sensor. `begun_s`: host time of power-up of each IMU, if known.
    `estimate` returns a list with an estimate of each IMU, or a whole `Window`, or a `CalibrationRefusedError`.
    """

    slots: Sequence[int]
    estimate: Callable[[], Any]
    settling: str | None = None  # Reason why a pose sensor's mean has to wait
    tilt: list[Batch] | None = None
    heading: list[Batch] | None = None
    from_field: bool = False
    wander_deg: float | None = None  # Both as in `HeadingWindow`
    field: FieldWindow | None = None
    begun_s: dict[str, float] = {}
    turn: Turn = Turn()

    def window(self) -> Window:
        """Compute the window, which takes milliseconds.

        Raises:
            CalibrationRefusedError: a sensor fails its checks.
        """
        estimates = self.estimate()
        if isinstance(estimates, CalibrationRefusedError):
            raise estimates
        if isinstance(estimates, Window):
            return estimates
        if self.settling is not None:
            raise CalibrationRefusedError(self.settling)
        for name, batches in (("gradienter", self.tilt), ("compass", self.heading)):
            if batches == []:
                raise CalibrationRefusedError(f"no reading from {name} in {len(self.slots)} s")
        return Window(
            start_s=float(self.slots[0]),
            end_s=self.slots[-1] + 1.0,
            imus=tuple(window for _, window in estimates),
            tilt=None if self.tilt is None else tilt_window(self.tilt),
            heading=None
            if self.heading is None
            else heading_window(self.heading, from_field=self.from_field, wander_deg=self.wander_deg),
            field=self.field,
            powered_s={name: self.slots[-1] + 1.0 - since_s for name, since_s in self.begun_s.items()},
            turn=self.turn,
        )


class WindowSource(ABC):
    """Chooses the seconds of a window; caches the newest estimate, and the estimate of one window after a write."""

    may_move = False
    """True if movements are allowed: a second is then rejected only for a fault of a sensor."""

    def __init__(self) -> None:
        self._kept: dict[float | None, tuple[int, Any]] = {}
        self.generation = 0  # Number of the current stretch

    @abstractmethod
    def set_imu(self, imu: ImuInput, batches: BatchSource, raw: BatchSource) -> None:
        """Add an IMU, or replace it after its stream changed. `batches`: the stream; `raw`: extra means in floats."""

    def set_pose(self, kind: str, batches: BatchSource) -> None:  # noqa: B027 - not every source of windows needs it
        """Add the one-second batches of a gradienter or compass."""

    def forget(self, imu: str | None) -> None:
        self.clear()

    @abstractmethod
    def new_stretch(self) -> None: ...

    @abstractmethod
    def add(self, slot: int, *, good: bool) -> bool:
        """Add a second that the gates judged as `good` or not; return false if this second ends the still stretch."""

    @property
    @abstractmethod
    def stillness(self) -> CollectorStatus: ...

    def good_slots(self, since_s: float | None) -> list[int]:
        """Return the good seconds after `since_s` (None: all), to check that gradienter and compass have settled."""
        return []

    @abstractmethod
    def slots(self, since_s: float | None) -> Sequence[int]:
        """Return the seconds of the longest window that begins after `since_s`; None: begins at any time.

        Raises:
            CalibrationRefusedError: too few seconds.
        """

    @abstractmethod
    def work(self, slots: Sequence[int], since_s: float | None) -> Work: ...

    @abstractmethod
    def status(self, settings: Settings, *, waits: bool) -> CollectorStatus:
        """Return the progress of the newest estimate towards its targets; `waits`: something blocks the measurement."""

    def clear(self) -> None:
        self._kept.clear()
        self.generation += 1

    def known(self, last: int, since_s: float | None) -> Any:
        """Return the cached estimate of a window after `since_s`; None if no such window reaches second `last`."""
        kept = self._kept.get(since_s)
        return kept[1] if kept is not None and kept[0] >= last else None

    def pending(self, since_s: float | None) -> Work | None:
        try:
            slots = self.slots(since_s)
        except CalibrationRefusedError:
            return None
        return None if self.known(slots[-1], since_s) is not None else self.work(slots, since_s)

    def accept(self, work: Work, found: Any) -> bool:
        """Cache the result `found` of `work`; return false if a new still stretch has begun since `work` was made."""
        if work.generation != self.generation:
            return False
        self._kept = {key: one for key, one in self._kept.items() if key is None or key == work.since_s}
        self._kept[work.since_s] = (work.slots[-1], found)
        return True

    def measurement(self, since_s: float | None) -> Measurement:
        """Return the readings of a window, without gradienter and compass; raises the errors of `slots`."""
        slots = self.slots(since_s)
        return Measurement(slots=slots, estimate=self.estimate_later(slots, since_s))

    def estimate_later(self, slots: Sequence[int], since_s: float | None, late: int = 0) -> Callable[[], Any]:
        """Return a function that returns the estimate over `slots`, or a cached one that lacks the last `late` s."""
        found = self.known(slots[-1] - late, since_s)
        if found is not None:
            return lambda: found
        work = self.work(slots, since_s)

        def estimate() -> Any:
            found = work.run()
            self.accept(work, found)
            return found

        return estimate


class Stretch:
    """Counts good and rejected seconds, and detects the start and the end of a still stretch."""

    def __init__(self, min_good: int, max_slots: int) -> None:
        self._min_good = min_good
        self.flags: deque[bool] = deque(maxlen=max_slots)
        self.clear()

    def clear(self) -> None:
        self.start: int | None = None
        self.good = 0
        self.begun = False
        self.flags.clear()
        self._run = 0
        self._steady = 0

    def add(self, slot: int, *, good: bool) -> bool:
        """Add the next second; return false if this second ends the still stretch."""
        self._steady = self._steady + 1 if good else 0
        self.flags.append(good)
        if good:
            self.start = slot if self.start is None else self.start
            self.good, self._run = self.good + 1, 0
            self.begun = self.begun or self.good >= self._min_good
            return True
        self._run += 1
        rejected = self.flags.count(False)
        if not self.begun or self._run > MAX_REJECTED_RUN or rejected > MAX_REJECTED * len(self.flags):
            was = self.start is not None
            self.clear()
            return not was
        return True

    @property
    def steady(self) -> int:
        return min(self._steady, len(self.flags))

    @property
    def good_now(self) -> bool:
        return bool(self.flags) and self.flags[-1]

    @property
    def full(self) -> bool:
        return len(self.flags) == self.flags.maxlen


class GroundWindows(WindowSource):
    """Windows of an aircraft on the ground: good seconds of the current still stretch."""

    def __init__(self, settings: Settings) -> None:
        super().__init__()
        self._horizon_s, self._min_good, self._max_slots = settings.horizon_s, settings.min_slots, settings.max_slots
        self._least = min(MIN_BATCHES, self._min_good)
        self._stretch = Stretch(self._min_good, self._max_slots)
        self._imus: dict[str, tuple[ImuInput, BatchSource, BatchSource]] = {}
        self._next = 0

    def set_imu(self, imu: ImuInput, batches: BatchSource, raw: BatchSource) -> None:
        self._imus[imu.name] = imu, batches, raw

    def new_stretch(self) -> None:
        self._stretch.clear()
        self.clear()

    def add(self, slot: int, *, good: bool) -> bool:
        self._next = slot + 1
        return self._stretch.add(slot, good=good)

    @property
    def stillness(self) -> CollectorStatus:
        stretch = self._stretch
        left_s = 0 if stretch.begun else self._min_good - stretch.good
        return CollectorStatus(
            still_s=float(stretch.good),
            steady_s=float(stretch.steady),
            good_now=stretch.good_now,
            hold_still_s=left_s,
        )

    def good_slots(self, since_s: float | None) -> list[int]:
        """Return the good seconds of the current still stretch that begin after `since_s`; None: all of them."""
        first = -math.inf if since_s is None else since_s
        flags = self._stretch.flags
        return [slot for slot, good in enumerate(flags, self._next - len(flags)) if good and slot >= first]

    def slots(self, since_s: float | None) -> list[int]:
        slots = self.good_slots(since_s)
        # Up to a fifth of a stretch may have been rejected since it began.
        needed = self._least if since_s is not None else 1 if self._stretch.begun else self._min_good
        if len(slots) < needed:
            needed = self._min_good if since_s is None else self._least
            raise CalibrationRefusedError(f"still for {len(slots)} s only, needs {needed} s")
        return slots

    def work(self, slots: Sequence[int], since_s: float | None) -> Work:
        # A window with `since_s` verifies that new offsets are in use, which raw readings do not show.
        with_raw = slots if since_s is None else ()
        streams = [
            (
                imu,
                [source.batches[slot] for slot in slots],
                [raw.batches[slot] for slot in with_raw if slot in raw.batches],
            )
            for imu, source, raw in self._imus.values()
        ]
        end_s, horizon_s, rejected = slots[-1] + 1.0, self._horizon_s, slots[-1] - slots[0] + 1 - len(slots)

        def run() -> list[tuple[Estimate, ImuWindow]] | CalibrationRefusedError:
            try:
                return [imu_window(*each, end_s=end_s, horizon_s=horizon_s, rejected=rejected) for each in streams]
            except CalibrationRefusedError as error:
                return error

        return Work(slots, since_s, self.generation, run)

    def status(self, settings: Settings, *, waits: bool) -> CollectorStatus:
        """Return the progress of the still stretch towards the targets, from an estimate that may be a second old."""
        stretch = self._stretch
        share = 0.0 if stretch.start is None else stretch.good / self._max_slots
        status = msgspec.structs.replace(self.stillness, progress=share, measuring=f"still for {stretch.good} s")
        if not stretch.begun or waits:
            return status
        estimates = self.estimate_later(self.slots(None), None, late=1)()
        if isinstance(estimates, CalibrationRefusedError):
            return msgspec.structs.replace(status, progress=0.0, obstacle=CollectorObstacle(str(estimates)))
        own = [each for each, _ in estimates]
        needed, enough = max(expected_s(settings, own), stretch.good + 1), stretch.full or is_enough(settings, own)
        share = 1.0 if enough else stretch.good / needed
        left = "" if enough else f", about {needed - stretch.good} s more"
        return msgspec.structs.replace(status, enough=enough, progress=share, measuring=f"{status.measuring}{left}")


def is_enough(settings: Settings, found: Sequence[Estimate]) -> bool:
    """Return true if each axis meets its target or has white noise below 30 % of the other noise (method.md 3.2)."""
    return all(bool((each.white_variance <= _room(settings, each)).all()) for each in found)


def expected_s(settings: Settings, found: Sequence[Estimate]) -> int:
    """Predict the number of good seconds after which `is_enough` is true, if the noise does not change."""
    needed = [np.square(each.white) / np.maximum(_room(settings, each), _NO_ROOM) for each in found]
    longest = max((float(each.max()) for each in needed), default=0.0)
    return min(max(math.ceil(min(longest, settings.max_s)), settings.min_slots), settings.max_slots)


def _room(settings: Settings, own: Estimate) -> Floats:
    """Return the white-noise variance (6,) that is low enough; -1 if integers do not determine the mean yet."""
    target = np.repeat([settings.target_gyro_sigma_rad_s, settings.target_accel_sigma_m_s2], 3)
    stays = own.use_variance - own.white_variance
    room = np.maximum(np.square(target) - stays, WHITE_SHARE * stays)
    return np.where(own.undecided & np.isfinite(target), -1.0, room)
