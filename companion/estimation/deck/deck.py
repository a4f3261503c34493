"""Choice of a window's seconds on a deck that sways and turns (on the ground: `collector.measurement`).

The seconds of an IMU must follow one another without a gap, because the aircraft turns by an unknown angle in a gap.
"""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Sequence
from typing import Any, Final

import msgspec
import numpy as np

from companion.errors import CalibrationRefusedError
from companion.estimation.collector.intake import CollectorStatus, Settings
from companion.estimation.collector.measurement import Measurement, WindowSource, Work
from companion.estimation.deck.estimate import (
    MAX_S,
    MIN_LOOK_S,
    MIN_S,
    DeckFound,
    DeckWindow,
    ImuSecond,
    TriadVariances,
)
from companion.estimation.deck.smoother import passage
from companion.estimation.deck.waves import Fluid, Level, level
from companion.estimation.means.pose import CompassModel, GradienterModel
from companion.estimation.means.windows import WHITE_SHARE, ImuInput, Window
from companion.estimation.seconds.batch import Batch, BatchSource
from companion.physics.frames import Floats
from companion.physics.units import DEG, UNITS
from companion.samples import TRIADS

EVERY_S: Final = {180: 10, 600: 30, MAX_S: 60}
"""Interval between two window ends, s, by upper limit of window length, s: long windows cost more and change less."""
KEPT_S: Final = MAX_S + 2 * max(EVERY_S.values())
"""Number of seconds to store: those of the longest window, and those that arrive before the next window."""
LONGEST_GAP_S: Final = 0.5
_SETTLED_LAGS: Final = 10.0
_KEPT_SHOWN: Final = 4  # Seconds stored until the gradienter's readings arrive
_FALLS: Final = 2.5
"""Assumed exponent: white-noise variance falls with window length to this power. It predicts a sufficient length.

A compromise: 3 for a slope through waves, 1 for a sensor's white noise.
"""
_IN_MINUTES_S: Final = 90.0


class Stream:
    """Consecutive seconds of one IMU, without a gap; if there is a gradienter, each second is compared with it."""

    def __init__(self, imu: ImuInput, gradienter: GradienterModel | None) -> None:
        self.imu, self._gradienter = imu, gradienter
        self.seconds: deque[ImuSecond] = deque(maxlen=KEPT_S)
        self.levels: dict[int, Level] = {}
        self.clear()

    def clear(self) -> None:
        self.seconds.clear()
        self.levels.clear()
        self._last: Floats | None = None
        self._shown: dict[int, tuple[Floats, Floats]] = {}
        self._fluid = None if self._gradienter is None else Fluid(self._gradienter)
        self._settled_s = math.inf

    def add(self, batch: Batch, times: Floats, rows: Floats) -> bool:
        """Add one second of samples (n, 6), rates and specific forces, sensor's axes; return false after a gap."""
        own = np.column_stack([times, self._in_vehicle(rows)])
        last = self._last
        gap_s = max(float(np.diff(times).max(initial=0.0)), 0.0 if last is None else float(own[0, 0] - last[0]))
        if gap_s > LONGEST_GAP_S:
            self.clear()
            last = None
        self._last = own[-1]
        if self._fluid is not None:
            if last is None:
                self._settled_s = float(times[0]) + _SETTLED_LAGS * self._fluid.lag_s
            self._shown[batch.slot] = times, self._fluid.follow(times, own[:, 4:])
            _trim(self._shown, _KEPT_SHOWN)
        if last is None:
            return gap_s <= LONGEST_GAP_S
        whole = np.vstack([last, own])
        self.seconds.append((batch, passage(whole[:, 0], whole[:, 1:4], whole[:, 4:])))
        while self.levels and next(iter(self.levels)) < self.seconds[0][0].slot:
            del self.levels[next(iter(self.levels))]
        return True

    def compare(self, slot: int, times: Floats, tilts: Floats) -> None:
        shown = self._shown.get(slot)
        if shown is None or shown[0][0] < self._settled_s:
            return
        found = level(*shown, times, tilts)
        if found is not None:
            self.levels[slot] = found

    def _in_vehicle(self, rows: Floats) -> Floats:
        imu = self.imu
        if imu.steps is not None:
            # Truncation toward zero: with motion of more than a step, half a step is lost on average.
            rows = rows + np.sign(rows) * imu.steps / 2.0
        return np.hstack([rows[:, :3] @ imu.rotation.T, rows[:, 3:] @ imu.rotation.T])


class Deck(WindowSource):
    """Collects the readings of a `DeckWindow` and chooses its seconds. It has no clock: time comes with the samples."""

    may_move = True

    def __init__(
        self, gradienter: GradienterModel | None, compass: CompassModel | None, horizon_s: float = 180.0
    ) -> None:
        super().__init__()
        self._gradienter, self._compass, self._horizon_s = gradienter, compass, horizon_s
        self._streams: dict[str, Stream] = {}
        self._headings: dict[int, float] = {}
        self._tilts: dict[int, tuple[Floats, Floats]] = {}
        self._reference_deg: tuple[float, float] | None = None
        """Mean tilt, deg, of the newest window; accelerometer means after a write are converted to this tilt."""
        self._is_good = True

    def set_imu(self, imu: ImuInput, batches: BatchSource | None = None, raw: BatchSource | None = None) -> None:
        self._streams[imu.name] = Stream(imu, self._gradienter)
        if batches is not None:
            batches.on_second = functools.partial(self.take_imu, imu.name)

    def set_pose(self, kind: str, batches: BatchSource) -> None:
        batches.on_second = self.take_heading if kind == "compass" else self.take_tilt

    def forget(self, imu: str | None) -> None:
        for name, stream in self._streams.items():
            if imu is None or name == imu:
                stream.clear()
        if imu is None:
            self._headings.clear()
        self._is_good = True
        self.clear()

    def new_stretch(self) -> None:
        """Do nothing: a movement does not end a window on a deck."""

    def add(self, slot: int, *, good: bool) -> bool:
        self._is_good = good
        return True

    def take_imu(self, name: str, batch: Batch, times: Floats, rows: Floats) -> None:
        """Add one second of samples (n, 6) of an IMU, in the IMU's own axes."""
        stream = self._streams[name]
        if not stream.add(batch, times, rows):
            self.clear()
        if batch.slot in self._tilts:
            stream.compare(batch.slot, *self._tilts[batch.slot])

    def take_tilt(self, batch: Batch, times: Floats, rows: Floats) -> None:
        """Add one second of gradienter readings (n, 2), degrees."""
        self._tilts[batch.slot] = times, rows
        _trim(self._tilts, _KEPT_SHOWN)
        for stream in self._streams.values():
            stream.compare(batch.slot, times, rows)

    def take_heading(self, batch: Batch, times: Floats, rows: Floats) -> None:
        """Add one second of compass headings (n, 1), degrees."""
        self._headings[batch.slot] = float(batch.mean[0]) * DEG
        _trim(self._headings, KEPT_S)

    @property
    def seconds(self) -> int:
        return min((len(stream.seconds) for stream in self._streams.values()), default=0)

    @property
    def stillness(self) -> CollectorStatus:
        seconds = float(self.seconds)
        return CollectorStatus(still_s=seconds, steady_s=seconds, good_now=self._is_good)

    def common(self, since_s: float | None = None) -> range:
        """Return the seconds after `since_s` that all IMUs have, up to the last end of a window by `EVERY_S`."""
        ends = [(one.seconds[0][0].slot, one.seconds[-1][0].slot) for one in self._streams.values() if one.seconds]
        if not ends or len(ends) < len(self._streams):
            return range(0)
        begin, now = max(first for first, _ in ends), min(last for _, last in ends) + 1
        if since_s is not None:
            begin = max(begin, math.ceil(since_s))
        end = max(min(now, begin + length) // every * every for length, every in EVERY_S.items() if length < MAX_S)
        end = max(end, now // EVERY_S[MAX_S] * EVERY_S[MAX_S])
        first = max(end - MAX_S, begin)
        return range(first, max(end, first))

    def slots(self, since_s: float | None) -> range:
        slots, needed = self.common(since_s), MIN_S if since_s is None else MIN_LOOK_S
        if len(slots) < needed:
            raise CalibrationRefusedError(self._at_least(needed))
        return slots

    def work(self, slots: Sequence[int], since_s: float | None = None) -> Work:
        streams = self._streams.values()
        estimate = DeckWindow(
            imus=[stream.imu for stream in streams],
            seconds=[[one for one in stream.seconds if one[0].slot in slots] for stream in streams],
            levels=[{slot: one for slot, one in stream.levels.items() if slot in slots} for stream in streams],
            headings={slot: heading for slot, heading in self._headings.items() if slot in slots},
            slots=slots,
            gradienter=self._gradienter,
            compass=self._compass,
            horizon_s=self._horizon_s,
            reference_deg=None if since_s is None else self._reference_deg,
        )
        return Work(slots, since_s, self.generation, estimate.run)

    def accept(self, work: Work, found: Any) -> bool:
        if not super().accept(work, found):
            return False
        if work.since_s is None and isinstance(found, tuple) and (tilt := found[0].tilt) is not None:
            self._reference_deg = tilt.x_deg, tilt.y_deg
        return True

    def measurement(self, since_s: float | None) -> Measurement:
        slots = self.slots(since_s)
        estimate = self.estimate_later(slots, since_s)

        def window() -> Window | CalibrationRefusedError:
            found: DeckFound | CalibrationRefusedError = estimate()
            return found[0] if isinstance(found, tuple) else found

        return Measurement(slots=slots, estimate=window)

    def status(self, settings: Settings, *, waits: bool) -> CollectorStatus:
        found, seconds = self.known(0, None), self.seconds
        status = functools.partial(msgspec.structs.replace, self.stillness)
        if found is None or seconds < MIN_S:
            left = self._at_least(MIN_S)
            return status(enough=False, progress=min(seconds / MIN_S, 1.0) / 4.0, measuring=left, left=left)
        if isinstance(found, CalibrationRefusedError):
            return status(enough=False, progress=0.0, measuring=str(found))
        targets = settings.target_gyro_sigma_rad_s, settings.target_accel_sigma_m_s2
        window, known = found
        span_s = window.end_s - window.start_s
        aims = [aim(span_s, each, targets[at % 2]) for at, each in enumerate(known)]
        if all(sigma <= goal for sigma, goal, _ in aims):
            return status(enough=True, progress=1.0, measuring="sigma is good enough")
        if seconds >= MAX_S:
            return status(enough=True, progress=1.0, measuring=f"measured for {MAX_S // 60} min")
        at, (sigma, goal, whole_s) = max(enumerate(aims), key=lambda each: each[1][2])
        left_s = max(whole_s - seconds, 1)
        left, unit = more(left_s), UNITS[TRIADS[at % 2]]
        words = f"{left}: {progress(sigma / unit.si, goal / unit.si, unit.name)}"
        return status(enough=False, progress=seconds / (seconds + left_s), measuring=words, left=left)

    def _at_least(self, needed: int) -> str:
        return f"at least {max(needed - self.seconds, 1)} s more"


def aim(span_s: float, known: TriadVariances, target: float) -> tuple[float, float, float]:
    """Return a triad's present sigma, its goal, and the predicted window length, s, after which sigma is at the goal.

    The goal is the target, or the smallest sigma that more time can reach. `known`: variances from `span_s` seconds.
    """
    use, white = known
    floor = use - white
    goal = max(target**2, floor * (1.0 + WHITE_SHARE))
    whole_s = span_s
    if use > goal:
        wanted = (goal - floor) / white
        whole_s = min(span_s * wanted ** (-1.0 / _FALLS), MAX_S) if wanted > 0.0 else MAX_S
    return math.sqrt(use), math.sqrt(goal), whole_s


def progress(sigma: float, goal: float, unit: str) -> str:
    return f"{_figure(sigma)} {unit}, goal {_figure(goal)}"


def more(left_s: float) -> str:
    if left_s < _IN_MINUTES_S:
        return f"some {math.ceil(left_s / 10.0) * 10} s more"
    return f"some {left_s / 60.0:.0f} min more"


def _figure(value: float) -> str:
    return f"{value:.{0 if value >= 9.95 else 1 if value >= 0.995 else 2}f}"


def _trim(kept: dict[int, Any], most: int) -> None:
    while len(kept) > most:
        del kept[next(iter(kept))]
