"""One-second batches: all that is kept of a stream.

Batches lie on one grid for all sources (slot k holds k <= t < k + 1 s of the host's clock), so that a slot of one
IMU and the same slot of the gradienter speak of the same second. Samples are plain tuples until a slot is over;
then numpy looks at them once.
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.physics.frames import Floats

MAX_LEVELS: Final = 1024
"""Integers between the lowest and the highest of one second that are counted one by one; at rest it is a tenth."""

_EVEN: Final = 1.4999
"""Steps of a counter that are all within so much of each other are one step each, whatever the usual one is."""
_OFF_BEAT: Final = 0.25
"""A step farther from a whole number of usual ones is no loss: lost samples leave whole steps out."""
_MOST_OFF_BEAT: Final = 0.2
"""Stamps of which a larger share does so count nothing: a sender that picks now this, now that sample."""
_LEAST_OF_A_PART: Final = 4
_FINEST: Final = 5
"""Halvings of a second: 1/32 s; what is faster is vibration."""
_PINNED_SIGMAS: Final = 4.0
_PINNED_SAMPLES: Final = 5
_PINNED_DISTINCT: Final = 8


class Counts(msgspec.Struct, frozen=True):
    """How often every integer came in one second."""

    lowest: NDArray[np.int64]
    """(c,) integer of the first row, in steps of the stream."""
    table: NDArray[np.int32]
    """(k, c), k at most `MAX_LEVELS`."""


class Batch(msgspec.Struct, frozen=True):
    """What one source said in one second; arrays are (c,) over its channels, in the source's units."""

    slot: int
    n: int
    mean: Floats
    variance: Floats
    """Of one sample, n - 1 in the denominator; zero for a single sample."""
    white: Floats
    """Half the mean square of successive differences (von Neumann): the part of the variance that is white."""
    low: Floats
    high: Floats
    distinct: NDArray[np.int64]
    clipped: bool
    """Some channel's commonest value is its extreme one: readings pile up at the end of the range."""
    largest_gap_s: float
    """Between samples, and to both ends of the slot."""
    missing: int | None
    """By the device's sequence counter or clock; None where it has neither, or one that does not count samples."""
    temperature_degc: float | None
    counts: Counts | None = None
    """Of a stream of integers; None for floats, and for a second that spans more than `MAX_LEVELS`."""
    allan: Floats = np.zeros((0, 0))
    """(k, c) Allan variances at averaging times of 1/2, 1/4 ... 1/32 of the second, each of four samples or more."""
    shared_variance: Floats = np.zeros(6)
    """(6,) of an IMU: of an error that its samples, and those of other seconds, have in common."""


def summary(
    slot: int,
    times: Floats,
    rows: Floats,
    stamps: Floats | None = None,
    temperature_degc: float | None = None,
    *,
    circle: bool = False,
    steps: Floats | None = None,
) -> Batch:
    """What (n, c) rows of one second, at least one, say; those of an angle are unrolled, `steps` are of integers."""
    n = len(rows)
    ordered = np.sort(rows, axis=0)
    distinct = 1 + (ordered[1:] != ordered[:-1]).sum(axis=0)
    # The very sums of `mean` and `var`, each once.
    centre = np.add.reduce(rows, axis=0) / n
    off, successive = rows - centre, rows[1:] - rows[:-1]
    gaps = times[1:] - times[:-1]
    edges = float(times[0]) - float(slot), slot + 1.0 - float(times[-1])
    return Batch(
        slot=slot,
        n=n,
        mean=np.mod(centre, 360.0) if circle else centre,
        variance=np.add.reduce(off * off, axis=0) / (n - 1) if n > 1 else np.zeros(rows.shape[1]),
        white=np.add.reduce(successive * successive, axis=0) / (n - 1) / 2.0 if n > 1 else np.zeros(rows.shape[1]),
        low=ordered[0],
        high=ordered[-1],
        distinct=np.asarray(distinct, dtype=np.int64),
        clipped=is_clipped(ordered, distinct),
        largest_gap_s=max(*edges, float(gaps.max()) if n > 1 else 0.0),
        missing=None if stamps is None else missing_of(stamps),
        temperature_degc=temperature_degc,
        counts=None if steps is None else counts_of(rows, steps),
        allan=_allan_within(off),
    )


def _allan_within(off: Floats) -> Floats:
    """Allan variances of (n, c) rows of one second, in halves, quarters and so on, of which each holds four or more."""
    firsts, sizes = _parts_of(len(off))
    depth = len(sizes).bit_length() - 1
    found = np.empty((depth, off.shape[1]))
    means = np.add.reduceat(off, firsts, axis=0) / sizes
    for rung in range(depth - 1, -1, -1):
        step = means[1:] - means[:-1]
        found[rung] = np.add.reduce(step * step, axis=0) / (2 * len(step))
        means = (means[::2] + means[1::2]) / 2.0
    return found


@functools.lru_cache(maxsize=64)
def _parts_of(n: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Where the finest parts of n samples begin, (k,), and how many each has, (k, 1); k is a power of two."""
    depth = min(max(int(math.log2(n / _LEAST_OF_A_PART)), 0), _FINEST)
    edges = np.arange((1 << depth) + 1) * n >> depth
    return edges[:-1], np.diff(edges)[:, None]


def counts_of(rows: Floats, steps: Floats) -> Counts | None:
    """How often every integer came in (n, c) rows of so large steps; None where they span too much."""
    integers = np.rint(rows / steps).astype(np.int64)
    lowest = integers.min(axis=0)
    place = integers - lowest
    levels = int(place.max()) + 1
    if levels > MAX_LEVELS:
        return None
    width = rows.shape[1]
    flat = np.bincount((place * width + np.arange(width)).ravel(), minlength=levels * width)
    return Counts(lowest, flat.reshape(levels, width).astype(np.int32))


def unrolled(rows: Floats) -> Floats:
    """Angles in degrees, continued across north from the first finite one."""
    finite = rows[np.isfinite(rows[:, 0]), 0]
    if len(finite) == 0:
        return rows
    with np.errstate(invalid="ignore"):
        return np.asarray(finite[0] + np.mod(rows - finite[0] + 180.0, 360.0) - 180.0)


def first_of_each(stamps: Floats, rows: Floats) -> NDArray[np.bool_] | None:
    """False for a row whose stamp and values were already seen: the same packet over a second route; None: none was.

    A stamp alone is not enough: counters wrap, and some devices' clocks stand still.
    """
    if (stamps[1:] > stamps[:-1]).all():
        return None
    _, first, inverse = np.unique(stamps, return_index=True, return_inverse=True)
    if len(first) == len(stamps):
        return None
    original = first[inverse]
    fresh = np.asarray((original == np.arange(len(stamps))) | (rows != rows[original]).any(axis=1))
    return None if fresh.all() else fresh


def missing_of(stamps: Floats) -> int | None:
    """Samples that a counter says were lost; a clock in seconds counts in its own steps just as well.

    The step is learned (some devices count at an internal rate), and going down, as after a restart, is nobody's loss.
    None where the stamps count no samples: PX4's telemetry takes those of 4 ms that are there when a message is due.
    """
    steps = stamps[1:] - stamps[:-1]
    steps = steps[steps > 0]
    if len(steps) == 0 or steps.max() < _EVEN * steps.min():
        return 0
    beats = steps / np.partition(steps, len(steps) // 2)[len(steps) // 2]
    whole = np.maximum(np.rint(beats), 1.0)
    if np.mean(np.abs(beats - whole) > _OFF_BEAT) > _MOST_OFF_BEAT:
        return None
    return int((whole - 1.0).sum())


def is_clipped(ordered: Floats, distinct: NDArray[np.int64]) -> bool:
    """Whether some channel's lowest or highest value is by far its commonest.

    Noise thins out towards its ends; a pile at an end is the end of the range. Few distinct values prove nothing:
    a quantised stream of a still sensor looks like that. And of 50 integers the lowest is the commonest by chance now
    and then, so that it must be so by four standard deviations of such counts.
    """
    if len(ordered) <= _PINNED_SAMPLES:
        return False
    tail = _PINNED_SAMPLES - 1
    suspects = np.flatnonzero(
        (distinct >= _PINNED_DISTINCT) & ((ordered[0] == ordered[tail]) | (ordered[-1] == ordered[-1 - tail]))
    )
    for channel in suspects:
        _, counts = np.unique(ordered[:, channel], return_counts=True)
        if counts.argmax() in {0, len(counts) - 1}:
            pile, next_most = np.sort(counts)[[-1, -2]]
            if pile > next_most + _PINNED_SIGMAS * math.sqrt(next_most):
                return True
    return False


MAX_SAMPLES: Final = 4096
"""Kept of one slot; what comes beyond is dropped and counted. Ten times the fastest stream."""

_MAX_TIME_S: Final = 1e12
_BACKWARD_SAMPLES: Final = 20
"""Samples in a row from the past that mean that the clock went back, not that some were late."""
_BACKWARD_S: Final = 2.0
_PAUSE_S: Final = 3.0
"""A sensor that was silent for longer may have been switched off."""


class BatchSource:
    """Collects one stream into batches. Never raises on what arrives; counts what it drops by reason.

    Beyond `limits` (c,), absolute values, nothing is believed; `keep` batches are kept. `circle`: the single channel
    is an angle in degrees. `steps` (c,) are of a stream of integers, of which every second keeps how often each came.
    """

    def __init__(
        self, limits: tuple[float, ...], keep: int, *, circle: bool = False, steps: Floats | None = None
    ) -> None:
        self.dropped: Counter[str] = Counter()
        self.batches: dict[int, Batch] = {}
        self.closed_through: int | None = None
        """No batch of this slot or an earlier one will come any more."""
        self.last_s: float | None = None
        self.begun: int | None = None
        """The second since which it has come without a longer pause."""
        self.lost = 0
        """Samples that never came, by the device's counter or clock, since the beginning."""
        self.restarts = 0
        """How often the clock went back and everything was dropped."""
        self._limits, self._keep, self._circle, self.steps = np.asarray(limits), keep, circle, steps
        self.believed: Callable[[int, float | None], float | None] = lambda slot, degc: degc
        """What of the temperature of a second is believed."""
        self.on_second: Callable[[Batch, Floats, Floats], None] | None = None
        """Told of every second, its times (n,) and its rows (n, c), before those are dropped."""
        self._restart()

    def _restart(self) -> None:
        self._slot: int | None = None
        self._slot_start = self._slot_end = -math.inf
        self._newest = -_MAX_TIME_S
        self._partial = True
        self._backward = 0
        self._last_stamp = math.nan
        self._heard_s = -math.inf
        self._clear()

    def _clear(self) -> None:
        self._times: list[float] = []
        self._rows: list[tuple[float, ...]] = []
        self._stamps: list[float | None] = []
        self._degc: list[float] = []
        self._shared_variance: tuple[float, ...] | None = None

    def forget(self) -> None:
        """Drop all batches and the second under way; what was counted stays."""
        self.batches.clear()
        if self._slot is not None:
            self.closed_through = self._slot
        # The rest of the running second may still hold what is to be forgotten, so it is skipped.
        self._partial = True
        self._last_stamp = math.nan
        self._clear()

    def add(
        self,
        t_s: float,
        row: tuple[float, ...],
        temperature_degc: float | None = None,
        stamp: float | None = None,
        shared_variance: tuple[float, ...] | None = None,
    ) -> bool:
        """Take one sample; True when a second has ended with it, or its clock is found to have gone back."""
        ended = False
        if not self._newest <= t_s < self._slot_end:
            if not self._newest <= t_s < _MAX_TIME_S:
                return self._from_the_past(t_s)
            ended = self._open(math.floor(t_s))
        self._newest = t_s
        self.last_s = t_s
        self._backward = 0
        if len(self._rows) >= MAX_SAMPLES:
            self.dropped["too many a second"] += 1
            return ended
        self._times.append(t_s)
        self._rows.append(row)
        self._stamps.append(stamp)
        self._shared_variance = shared_variance
        if temperature_degc is not None and math.isfinite(temperature_degc):
            self._degc.append(temperature_degc)
        return ended

    def _from_the_past(self, t_s: float) -> bool:
        if not math.isfinite(t_s) or abs(t_s) >= _MAX_TIME_S:
            self.dropped["no valid time"] += 1
            return False
        self.dropped["late or out of order"] += 1
        self._backward = self._backward + 1 if t_s < self._newest - _BACKWARD_S else 0
        if self._backward < _BACKWARD_SAMPLES:
            return False
        self.dropped["time went back"] += 1
        self.restarts += 1
        self.batches.clear()
        self.closed_through = math.floor(t_s)
        self.last_s = t_s
        self._restart()
        self._newest = t_s
        return True

    def _open(self, slot: int) -> bool:
        first = self._slot is None
        self._close()
        self._slot = slot
        self._slot_start, self._slot_end = float(slot), slot + 1.0
        # A stream that has just begun did so in the middle of a second.
        self._partial = first
        self.closed_through = slot - 1
        return not first

    def close_before(self, t_s: float) -> bool:
        """Close the second under way if it ended before `t_s`; True when it did."""
        if self._slot is None or not self._slot_end <= t_s < _MAX_TIME_S:
            return False
        slot = math.floor(t_s)
        self._open(slot)
        # Whatever still comes from before is late now.
        self._newest = max(self._newest, self._slot_start)
        return True

    def _close(self) -> None:
        if self._rows:
            if self._times[0] - self._heard_s > _PAUSE_S:
                self.begun = math.floor(self._times[0])
            self._heard_s = self._times[-1]
        if self._slot is not None and self._rows and not self._partial:
            batch = self._summarise(self._slot)
            if batch is not None:
                self.batches[batch.slot] = batch
                while len(self.batches) > self._keep:
                    del self.batches[next(iter(self.batches))]
        self._clear()

    def _summarise(self, slot: int) -> Batch | None:
        times, rows = np.array(self._times), np.array(self._rows, dtype=np.float64)
        stamps = None if None in self._stamps else np.array(self._stamps, dtype=np.float64)
        if self._circle:
            rows = unrolled(rows)
        # NaN compares false, so this drops it too.
        believable = np.abs(rows) <= self._limits
        if not believable.all():
            sound = believable.all(axis=1)
            self.dropped["not a believable number"] += int((~sound).sum())
            rows, times = rows[sound], times[sound]
            stamps = None if stamps is None else stamps[sound]
        if stamps is not None and (fresh := first_of_each(stamps, rows)) is not None:
            self.dropped["repeated"] += int((~fresh).sum())
            rows, times, stamps = rows[fresh], times[fresh], stamps[fresh]
        if len(rows) == 0:
            return None
        if stamps is not None:
            self.lost += missing_of(np.concatenate(((self._last_stamp,), stamps))) or 0
            self._last_stamp = stamps[-1]
        batch = summary(
            slot,
            times,
            rows,
            stamps,
            self.believed(slot, sum(self._degc) / len(self._degc) if self._degc else None),
            circle=self._circle,
            steps=self.steps,
        )
        if self._shared_variance is not None:
            batch = msgspec.structs.replace(batch, shared_variance=np.array(self._shared_variance))
        if self.on_second is not None:
            self.on_second(batch, times, rows)
        return batch
