"""What one source said in one second, and what has to be found out for that from its readings."""

from __future__ import annotations

import math
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.calibration.noise.robust import median
from companion.physics.frames import Floats

MAX_LEVELS: Final = 1024
"""Integers between the lowest and the highest of one second that are counted one by one; at rest it is a tenth."""

_EVEN: Final = 1.4999
"""Steps of a counter that are all within so much of each other are one step each, whatever the usual one is."""
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
    first_s: float
    last_s: float
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
    """By the device's sequence counter or clock; None where it has neither."""
    temperature_degc: float | None
    counts: Counts | None = None
    """Of a stream of integers; None for floats, and for a second that spans more than `MAX_LEVELS`."""


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
        first_s=float(times[0]),
        last_s=float(times[-1]),
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
    )


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


def missing_of(stamps: Floats) -> int:
    """Samples that a counter says were lost; a clock in seconds counts in its own steps just as well.

    The step is learned (some devices count at an internal rate), and going down, as after a restart, is nobody's loss.
    """
    steps = stamps[1:] - stamps[:-1]
    steps = steps[steps > 0]
    if len(steps) == 0 or steps.max() < _EVEN * steps.min():
        return 0
    usual = float(median(steps))
    return int(np.maximum(np.rint(steps / usual) - 1.0, 0.0).sum())


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
