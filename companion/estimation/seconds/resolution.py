"""How coarse the readings of a pose sensor are, from the readings themselves."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.physics.frames import Floats

_MAX_DECIMALS: Final = 4


def decimal(low: Floats, high: Floats) -> Floats:
    """(c,) the last decimal that a stream prints, by the lowest and highest readings of any seconds, (..., c)."""
    low, high = np.atleast_2d(low), np.atleast_2d(high)
    found = np.full(low.shape[1], 10.0**-_MAX_DECIMALS)
    for digits in range(_MAX_DECIMALS - 1, -1, -1):
        off = np.maximum(np.abs(low - np.round(low, digits)), np.abs(high - np.round(high, digits)))
        fits = off.max(axis=0) < 1e-9
        if not fits.any():
            break
        found = np.where(fits, 10.0**-digits, found)
    return found


def few_distinct(distinct: Floats | NDArray[np.int64]) -> NDArray[np.bool_]:
    """(c,) whether no second shows more than two values, (m, c): then the noise does not spread the readings."""
    return np.asarray(distinct.max(axis=0) < 3)


def step(low: Floats, high: Floats, distinct: Floats) -> Floats:
    """(c,) distance of two neighbouring readings: that of a second which shows two, else the last decimal printed.

    Lowest and highest readings of m seconds, (m, c), and how many different ones each shows.
    """
    apart = np.where(distinct == 2, high - low, 0.0).max(axis=0)
    return np.asarray(np.maximum(apart, decimal(low, high)))
