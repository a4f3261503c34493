"""One-second batches: the summary of a stream that is stored instead of its samples.

All streams share one grid of seconds: slot k holds the samples with k <= t < k + 1 s of the host's clock. Samples are
plain tuples until a slot is over; then numpy summarises them once.
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

MAX_SAMPLES: Final = 4096  # Maximum samples of one slot, ten times the fastest stream; more are dropped and counted
MAX_LEVELS: Final = 1024
"""Largest range of integers in one second for which a histogram is stored; at rest the range is a tenth of this."""

_EVEN: Final = 1.4999  # Counter steps within this ratio of each other count as one sample each
_OFF_BEAT: Final = 0.25
"""Largest deviation of a counter step from a multiple of the usual step, in usual steps: a loss skips whole steps."""
_MOST_OFF_BEAT: Final = 0.2
"""Share of irregular steps above which stamps do not show losses, because the sender sends only some samples."""
_LEAST_OF_A_PART: Final = 3
_FINEST: Final = 5  # Halvings of a second, down to 1/32 s; anything faster is vibration
_PINNED_SIGMAS: Final = 4.0
_PINNED_SAMPLES: Final = 5
_PINNED_DISTINCT: Final = 8
_MAX_TIME_S: Final = 1e12
_BACKWARD_SAMPLES: Final = 20  # Samples in a row from the past that show a clock set back; fewer are late samples
_BACKWARD_S: Final = 2.0
_PAUSE_S: Final = 3.0  # Longest silence without suspicion of a power-off
_MAX_DECIMALS: Final = 4


class Counts(msgspec.Struct, frozen=True):
    """Histogram of one second of integers. `table` (k, c): counts of the k integers from `lowest` (c,) on."""

    lowest: NDArray[np.int64]
    table: NDArray[np.int32]  # (k, c), k at most `MAX_LEVELS`


class Batch(msgspec.Struct, frozen=True):
    """Summary of one second of one stream; arrays are (c,) over the channels, in the stream's units.

    `white`: white-noise part of the variance, half the mean square of successive differences (von Neumann). `missing`:
    number of lost samples by the device's counter or clock, None if neither counts samples. `counts`: histogram of
    integers; None for floats, and for a range above `MAX_LEVELS`. `allan` (k, c): Allan variances at averaging times of
    1/2, 1/4 ... 1/32 s that contain three samples or more. `shared_variance` (6,): variance of an error common to all
    samples of an IMU, which no averaging reduces.
    """

    slot: int
    n: int
    mean: Floats
    variance: Floats
    white: Floats
    low: Floats
    high: Floats
    distinct: NDArray[np.int64]
    clipped: bool  # True if readings of a channel pile up at the end of its range
    largest_gap_s: float  # Longest gap between samples, or to an end of the slot
    missing: int | None
    temperature_degc: float | None
    counts: Counts | None = None
    allan: Floats = np.zeros((0, 0))
    shared_variance: Floats = np.zeros(6)


def summary(
    slot: int,
    times: Floats,
    rows: Floats,
    stamps: Floats | None = None,
    temperature_degc: float | None = None,
    *,
    circle: bool = False,
    steps: Floats | None = None,
    shared_variance: Floats | None = None,
) -> Batch:
    """Summarise rows (n, c), n >= 1, of one second. `circle`: unrolled angles. `steps` (c,): unit of integer rows."""
    n = len(rows)
    ordered = np.sort(rows, axis=0)
    distinct = 1 + (ordered[1:] != ordered[:-1]).sum(axis=0)
    # The sums of `mean` and `var`, computed once each.
    centre = np.add.reduce(rows, axis=0) / n
    off, successive = rows - centre, rows[1:] - rows[:-1]
    return Batch(
        slot=slot,
        n=n,
        mean=np.mod(centre, 360.0) if circle else centre,
        variance=np.add.reduce(off * off, axis=0) / max(n - 1, 1),
        white=np.add.reduce(successive * successive, axis=0) / max(n - 1, 1) / 2.0,
        low=ordered[0],
        high=ordered[-1],
        distinct=np.asarray(distinct, dtype=np.int64),
        clipped=_is_clipped(ordered, distinct),
        largest_gap_s=float(np.diff(times, prepend=slot, append=slot + 1.0).max()),
        missing=None if stamps is None else _missing(stamps),
        temperature_degc=temperature_degc,
        counts=None if steps is None else _counts(rows, steps),
        allan=_allan_within(off),
        shared_variance=np.zeros(6) if shared_variance is None else shared_variance,
    )


def _allan_within(off: Floats) -> Floats:
    """Return Allan variances (k, c) of one second's rows (n, c) at 1/2, 1/4 ... s that contain at least 3 rows."""
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
    """Divide n samples into k parts, k a power of two; return each part's first sample (k,) and size (k, 1)."""
    depth = min(max(int(math.log2(n / _LEAST_OF_A_PART)), 0), _FINEST)
    edges = np.arange((1 << depth) + 1) * n >> depth
    return edges[:-1], np.diff(edges)[:, None]


def _counts(rows: Floats, steps: Floats) -> Counts | None:
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
    """Unroll angles (n, 1), degrees, to within 180 degrees of the first finite one."""
    finite = rows[np.isfinite(rows[:, 0]), 0]
    if len(finite) == 0:
        return rows
    with np.errstate(invalid="ignore"):
        return np.asarray(finite[0] + np.mod(rows - finite[0] + 180.0, 360.0) - 180.0)


def _fresh(stamps: Floats, rows: Floats) -> NDArray[np.bool_]:
    """Return (n,) false for rows that repeat stamp and values of an earlier row: samples that arrive by two routes.

    An equal stamp alone is not enough: counters wrap, and some devices' clocks do not advance.
    """
    if (stamps[1:] > stamps[:-1]).all():
        return np.ones(len(rows), dtype=np.bool_)
    _, first = np.unique(np.column_stack((stamps, rows)), axis=0, return_index=True)
    return np.isin(np.arange(len(rows)), first)


def _missing(stamps: Floats) -> int | None:
    """Count lost samples from the steps of a counter, or of a clock in seconds; None if stamps do not count samples.

    The usual step is learned, because some devices count at an internal rate. A step down, as after a restart, is no
    loss. PX4's stamps do not count samples: it sends the newest sample (every 4 ms) whenever a message is due.
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


def _is_clipped(ordered: Floats, distinct: NDArray[np.int64]) -> bool:
    """Return true if a channel's lowest or highest value is by far its most frequent one: the end of its range.

    Noise rarely reaches its extremes, so many equal values there show the end of the range. Few distinct values prove
    nothing: the quantised stream of a sensor at rest has few. Of 50 integers, the lowest is sometimes the most frequent
    by chance, so its count must exceed the next by four standard deviations.
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


def decimal(low: Floats, high: Floats) -> Floats:
    """Return the unit of the last printed decimal (c,), such as 0.01, from lowest and highest readings (..., c)."""
    ends = np.vstack((low, high))
    found = np.full(ends.shape[1], 10.0**-_MAX_DECIMALS)
    for digits in range(_MAX_DECIMALS - 1, -1, -1):
        fits = np.abs(ends - np.round(ends, digits)).max(axis=0) < 1e-9
        found = np.where(fits, 10.0**-digits, found)
    return found


def few_distinct(distinct: Floats | NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return (c,) true for channels with at most 2 values in each second; `distinct` (m, c): number of values."""
    return np.asarray(distinct.max(axis=0) < 3)


class BatchSource:
    """Collects one stream into one-second batches. No sample value raises an exception; dropped samples are counted.

    Values beyond `limits` (c,) are dropped; the latest `keep` batches are stored. `circle`: the single channel is an
    angle in degrees. `steps` (c,): resolution of an integer stream, for which every batch has a histogram.
    """

    def __init__(
        self, limits: tuple[float, ...], keep: int, *, circle: bool = False, steps: Floats | None = None
    ) -> None:
        self.dropped: Counter[str] = Counter()
        self.batches: dict[int, Batch] = {}
        self.closed_through: int | None = None
        """Last closed second: no batch of that second or of an earlier one will follow."""
        self.last_s: float | None = None
        self.begun: int | None = None
        """First second of the stream after its last pause of more than `_PAUSE_S`."""
        self.lost = 0  # Samples lost since the beginning, by the device's counter or clock
        self.restarts = 0  # Number of times that the clock went back and everything was dropped
        self._limits, self._keep, self._circle, self.steps = np.asarray(limits), keep, circle, steps
        self.believed: Callable[[int, float | None], float | None] = lambda slot, degc: degc
        """Plausibility check of temperatures: receives second and degC, returns the temperature to use, or None."""
        self.on_second: Callable[[Batch, Floats, Floats], None] | None = None
        """Callback for every second: receives the batch, and times (n,) and rows (n, c) of its samples."""
        self._restart()

    def _restart(self) -> None:
        self._slot: int | None = None
        self._slot_end = -math.inf
        self._newest = -_MAX_TIME_S
        self._backward = 0
        self._heard_s = -math.inf
        self._skip_rest()

    def _skip_rest(self) -> None:
        self._partial = True
        self._last_stamp = math.nan
        self._clear()

    def _clear(self) -> None:
        self._times: list[float] = []
        self._rows: list[tuple[float, ...]] = []
        self._stamps: list[float | None] = []
        self._degc: list[float] = []
        self._shared_variance: tuple[float, ...] | None = None

    def forget(self) -> None:
        """Drop all batches and the current second, but not the counts of lost and dropped samples."""
        self.batches.clear()
        if self._slot is not None:
            self.closed_through = self._slot
        self._skip_rest()

    def add(
        self,
        t_s: float,
        row: tuple[float, ...],
        temperature_degc: float | None = None,
        stamp: float | None = None,
        shared_variance: tuple[float, ...] | None = None,
    ) -> bool:
        """Add one sample; return true if it completes a second, or shows that the clock was set back."""
        ended = False
        if not self._newest <= t_s < self._slot_end:
            if not self._newest <= t_s < _MAX_TIME_S:
                return self._from_the_past(t_s)
            ended = self._open(math.floor(t_s))
        self._newest = self.last_s = t_s
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
        self._restart()
        self._newest = self.last_s = t_s
        return True

    def _open(self, slot: int) -> bool:
        first = self._slot is None
        self._close()
        self._slot = slot
        self._slot_end = slot + 1.0
        # A stream begins in the middle of a second.
        self._partial = first
        self.closed_through = slot - 1
        return not first

    def close_before(self, t_s: float) -> bool:
        if self._slot is None or not self._slot_end <= t_s < _MAX_TIME_S:
            return False
        slot = math.floor(t_s)
        self._open(slot)
        # An older sample counts as late from now on.
        self._newest = max(self._newest, float(slot))
        return True

    def _close(self) -> None:
        if self._rows:
            if self._times[0] - self._heard_s > _PAUSE_S:
                self.begun = math.floor(self._times[0])
            self._heard_s = self._times[-1]
        if self._slot is not None and self._rows and not self._partial:
            self._summarise(self._slot)
        self._clear()

    def _summarise(self, slot: int) -> None:
        times, rows = np.array(self._times), np.array(self._rows, dtype=np.float64)
        stamps = None if None in self._stamps else np.array(self._stamps, dtype=np.float64)
        if self._circle:
            rows = unrolled(rows)
        # NaN compares false, so this drops it too.
        good = np.asarray((np.abs(rows) <= self._limits).all(axis=1))
        if not good.all():
            self.dropped["not a plausible number"] += int((~good).sum())
        if stamps is not None:
            fresh = _fresh(stamps, np.where(good[:, None], rows, 0.0))
            if (repeated := int((good & ~fresh).sum())) > 0:
                self.dropped["repeated"] += repeated
            good &= fresh
        times, rows = times[good], rows[good]
        if len(rows) == 0:
            return
        if stamps is not None:
            stamps = np.append(self._last_stamp, stamps[good])
            self._last_stamp = stamps[-1]
        batch = summary(
            slot,
            times,
            rows,
            stamps,
            self.believed(slot, sum(self._degc) / len(self._degc) if self._degc else None),
            circle=self._circle,
            steps=self.steps,
            shared_variance=None if self._shared_variance is None else np.array(self._shared_variance),
        )
        self.lost += batch.missing or 0
        self.batches[slot] = batch
        while len(self.batches) > self._keep:
            del self.batches[next(iter(self.batches))]
        if self.on_second is not None:
            self.on_second(batch, times, rows)
