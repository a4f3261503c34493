"""How fast a reading turns: a line through its seconds, with a sigma that holds for real sensors.

A line's slope is uncertain by the white noise of the seconds, by slow wander, which the readings' own Allan deviation
shows, and by coarse steps, which may hide a slope altogether (method section 12).
"""

from __future__ import annotations

import math
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.calibration.noise.allan import (
    FLOOR_OF_FLICKER,
    allan_variance,
    slope_variance,
    student_ratio,
    white_noise,
)
from companion.physics.frames import Floats

FEWEST: Final = 3
"""Seconds: two always lie on a line."""
_SPANS: Final = 5
_OF_STEPS: Final = math.sqrt(3.0)
"""One sigma of a slope over T by an error that is at most A either way: its largest is 3 A / T."""


class Slope(msgspec.Struct, frozen=True):
    """Lines through (m, c) values; each (c,)."""

    per_s: Floats
    variance: Floats
    white: Floats
    """N of the values about the line, unit * sqrt(s)."""


def fit_slope(
    slots: NDArray[np.int64],
    values: Floats,
    *,
    white: Floats | float = 0.0,
    flicker: Floats | float = 0.0,
    walk: Floats | float = 0.0,
    hidden: Floats | float = 0.0,
) -> Slope:
    """The slope of every column of one mean a second.

    Args:
        slots: (m,) seconds, ascending, m >= `FEWEST`.
        values: (m, c).
        white: the least white noise N, (c,) or one for all; likewise the rest.
        flicker: the least flicker B.
        walk: rate random walk K.
        hidden: by how much coarse steps may hide what is between them, either way.
    """
    length_s = float(slots[-1] - slots[0] + 1)
    time = slots - slots.mean()
    spread = float(np.square(time).sum())
    centred = values - values.mean(axis=0)
    slope = time @ centred / spread
    left = centred - np.outer(time, slope)
    noise = np.maximum(white_noise(slots, left), white)
    wander = np.maximum(wandering(slots, left, noise), flicker)
    variance = (
        np.square(noise) / spread
        + slope_variance(wander, np.asarray(walk), length_s)
        + np.square(_OF_STEPS * np.asarray(hidden) / length_s)
    )
    return Slope(slope, np.asarray(variance), noise)


def plain_slope(times: NDArray[np.int64], values: Floats) -> float:
    """Least squares of (m,) values, m >= 2."""
    time = times - times.mean()
    return float(time @ values / (time @ time))


def wandering(slots: NDArray[np.int64], values: Floats, white: Floats) -> Floats:
    """B of every column as far as the Allan deviation at T/5 shows more than white noise; widened for few spans."""
    span = int(slots[-1] - slots[0] + 1) // _SPANS
    if span < 2:
        return np.zeros(values.shape[1])
    variance, freedom = allan_variance(slots, values, span)
    explained = np.square(white) / span
    # All of it, significant or not: a line takes the slowest wander with it, and what is left shows too little.
    return np.asarray(np.sqrt(np.maximum(variance - explained, 0.0)) / FLOOR_OF_FLICKER * student_ratio(freedom))


def hidden_by_steps(step: float, variance: float, *, dithered: bool = True) -> float:
    """By how much the mean of readings rounded to `step` may be off, either way: their noise spreads it or not.

    (q / pi) exp(-2 pi^2 sigma^2 / q^2), the first harmonic (method section 2.5); at most half a step.

    Args:
        step: q; 0 for floats.
        variance: of the readings, rounding and all.
        dithered: False where the readings show too few values to tell their noise.
    """
    if step <= 0.0:
        return 0.0
    noise = max(variance / step**2 - 1.0 / 12.0, 0.0) if dithered else 0.0
    return step * min(0.5, math.exp(-2.0 * math.pi**2 * noise) / math.pi) if dithered else step / 2.0
