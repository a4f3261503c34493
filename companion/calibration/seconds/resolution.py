"""How coarse the readings of a pose sensor are, from the readings themselves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.calibration.seconds.batch import Batch
from companion.physics.frames import Floats

_MAX_DECIMALS: Final = 4


def decimal(low: Floats, high: Floats) -> Floats:
    """(c,) the last decimal that a stream prints, by the lowest and highest readings of any seconds, (..., c)."""
    low, high = np.atleast_2d(low), np.atleast_2d(high)
    found = np.full(low.shape[1], 10.0**-_MAX_DECIMALS)
    for digits in range(_MAX_DECIMALS - 1, -1, -1):
        off = np.maximum(np.abs(low - np.round(low, digits)), np.abs(high - np.round(high, digits)))
        found = np.where(off.max(axis=0) < 1e-9, 10.0**-digits, found)
    return found


def few_distinct(batches: Sequence[Batch]) -> NDArray[np.bool_]:
    """(c,) whether no second shows more than two values: then the noise does not spread the readings."""
    return np.asarray(np.max([batch.distinct for batch in batches], axis=0) < 3)


def step(batches: Sequence[Batch]) -> Floats:
    """(c,) distance of two neighbouring readings: that of a second which shows two, else the last decimal printed."""
    low = np.array([batch.low for batch in batches])
    high = np.array([batch.high for batch in batches])
    pairs = np.array([batch.distinct for batch in batches]) == 2
    apart = np.where(pairs, high - low, 0.0).max(axis=0)
    return np.asarray(np.maximum(apart, decimal(low, high)))
