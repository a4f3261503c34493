"""Slope of a line through the seconds of a reading, with a sigma that holds for real sensors.

The slope is uncertain by the white noise of the seconds, by slow wander, which the readings' own Allan deviation shows,
and by coarse steps, which may hide a slope (method 2.6).
"""

from __future__ import annotations

import math
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.estimation.noise.allan import (
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
_WALKS: Final = 2.5
"""Allan variance over that of white noise from which the readings walk; white noise exceeds it once in forty."""
_LINE_TAKES: Final = 1.6
"""Allan variance of a random walk at T/5 over what is left once a line is subtracted."""


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
    """Fit the slope of every column of one mean a second, (m, c) at m >= `FEWEST` ascending slots.

    White noise N, flicker B and walk K are lower limits, (c,) or one for all; `hidden`: rounding error, either way.
    """
    length_s = float(slots[-1] - slots[0] + 1)
    time = slots - np.add.reduce(slots) / len(slots)
    spread = float(np.add.reduce(time * time))
    centred = values - np.add.reduce(values) / len(values)
    slope = time @ centred / spread
    left = centred - time[:, None] * slope
    noise = np.maximum(white_noise(slots, left), white)
    flickers, walks = wandering(slots, left, noise)
    variance = (
        np.square(noise) / spread
        + slope_variance(np.maximum(flickers, flicker), np.maximum(walks, walk), length_s)
        # An error of at most A either way turns a line by at most 3 A / T, and by A / (2 T) to A / T (rms).
        + np.square(np.asarray(hidden) / length_s)
    )
    return Slope(slope, np.asarray(variance), noise)


def plain_slope(times: NDArray[np.int64], values: Floats) -> float:
    """Least squares of (m,) values, m >= 2."""
    time = times - np.add.reduce(times) / len(times)
    return float(time @ values / (time @ time))


def wandering(slots: NDArray[np.int64], left: Floats, white: Floats) -> tuple[Floats, Floats]:
    """Estimate B or K of every column of the residuals, by the excess of the Allan deviation at T/5 over white noise.

    Widened for few spans. A walk that does not show in one window is in no sigma: 0.1 N a root second
    doubles the error of a minute's slope, and its Allan variance is half of the white noise's.
    """
    span = int(slots[-1] - slots[0] + 1) // _SPANS
    if span < 2:
        return np.zeros(left.shape[1]), np.zeros(left.shape[1])
    variance, freedom = allan_variance(slots, left, span)
    explained, widened = np.square(white) / span, student_ratio(freedom)
    walks = variance > _WALKS * explained
    # All of it, significant or not: a line takes the slowest wander with it, and what is left shows too little.
    flicker = np.sqrt(np.maximum(variance - explained, 0.0)) / FLOOR_OF_FLICKER * widened
    walk = np.sqrt(3.0 * _LINE_TAKES * variance / span) * widened
    return np.where(walks, 0.0, flicker), np.where(walks, walk, 0.0)


def hidden_by_steps(step: float, variance: float, *, enough: bool = True) -> float:
    """Bound the error, either way, of the mean of readings rounded to `step` (0 for floats), by their variance.

    (q / pi) exp(-2 pi^2 sigma^2 / q^2) (method 2.5), at most half a step; that if too few values show (not `enough`).
    """
    if step <= 0.0 or not enough:
        return max(step, 0.0) / 2.0
    noise = max(variance / step**2 - 1.0 / 12.0, 0.0)
    return step * min(0.5, math.exp(-2.0 * math.pi**2 * noise) / math.pi)
