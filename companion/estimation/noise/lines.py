"""Means and lines through the seconds of a reading: robust ones that one knock does not move, and slopes with a sigma.

Huber's M-estimator over batch means, and one step beyond it: c = 1.345 keeps 95 % of the efficiency on clean data; the
scale is the median absolute deviation. Works on batch means, never on samples: a median of quantised samples is worse
than the mean (method 2.4). Sources: Huber, Annals of Mathematical Statistics 35 (1964) 73-101; the step, Yohai, Annals
of Statistics 15 (1987) 642-656, with the weights of Beaton and Tukey, Technometrics 16 (1974) 147-185.

A line's slope may be a warm-up, whose end counts, or chance and the part's own wander (method 2.4). An untested
line costs more than it saves: its end has four times the variance of a mean, and a part that wanders comes back. So a
slope must exceed what white noise makes and what the flicker and walk of the part make.

The slope of a turn (`fit_slope`) has three uncertainties (method 2.6): the white noise of the seconds; slow wander,
known from the Allan deviation of the readings; coarse steps, which may hide a slope.
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
from companion.physics.statistics import MAD_TO_SIGMA, student_quantile

HUBER_C: Final = 1.345
BIWEIGHT_C: Final = 6.0
"""Scales beyond which a value does not count at all in `robust_mean`. Simulated, 60 values: clean data lose
2.2 % of variance (with Huber's mean alone 5 %). A knock in 5 % of the values costs 4 % of sigma instead of 26 %."""
_MEAN_ABS_TO_SIGMA: Final = 1.2533
_EQUAL: Final = 1e-6
_ROUNDS: Final = 30
_CONVERGED: Final = 1e-4

RAMP_T: Final = 5.0
"""|t| of a slope that counts as one, more in a short window. On sensors without a ramp a lower one costs more than it
saves (2.4)."""
RAMP_FLOORS: Final = 3.0
"""Standard deviations of the slope that the part's own flicker and walk make. In a minute of an ADIS16405's
accelerometers 8 % of the slopes exceed |t| = 5 by flicker alone, and taking their ends costs 12 % of the rms error."""
RAMP_BATCHES: Final = 8  # Fewer seconds make no line
_ONE_IN_10000: Final = 3.8906  # Sigmas that a normal number exceeds with this probability, on either side

FEWEST: Final = 3
_SPANS: Final = 5
_WALKS: Final = 2.5
"""Allan variance over that of white noise from which the readings walk; white noise exceeds it once in forty."""
_LINE_TAKES: Final = 1.6  # Allan variance of a random walk at T/5 over what is left once a line is subtracted


# --- robust


def _scale(residual: Floats) -> Floats:
    """Robust sigma of every column; where most values are equal but for rounding, the mean deviation has to do."""
    size = np.abs(residual)
    mad = MAD_TO_SIGMA * np.median(size, axis=0)
    mean = _MEAN_ABS_TO_SIGMA * size.mean(axis=0)
    return np.asarray(np.where(mad > _EQUAL * mean, mad, mean))


def _weights(residual: Floats, scale: Floats, c: Floats | float) -> Floats:
    limit = c * scale
    size = np.abs(residual)
    # A column of equal values has scale zero: every weight is one.
    return np.asarray(limit / np.where(size > limit, size, np.where(limit > 0.0, limit, 1.0)) + (limit == 0.0))


def huber_mean(values: Floats, c: Floats | float = HUBER_C, least: Floats | float = 0.0) -> Floats:
    """Huber's location of every column of (m, c), m >= 1: (c,) in the unit of the values.

    Beyond `c` scales a value counts less; the scale is at least `least`. Each is one for all columns, or (c,).
    """
    centre = np.median(values, axis=0)
    scale = np.maximum(_scale(values - centre), least)
    scale = np.where(scale > 0.0, scale, 1.0)
    for _ in range(_ROUNDS):
        residual = values - centre
        weight = _weights(residual, scale, c)
        step = (weight * residual).sum(axis=0) / weight.sum(axis=0)
        centre = centre + step
        if bool(np.all(np.abs(step) <= _CONVERGED * scale)):
            break
    return np.asarray(centre)


def robust_mean(values: Floats, c: Floats | float = HUBER_C, least: Floats | float = 0.0) -> Floats:
    """One step from Huber's mean with weights that fall to zero: nearer to the plain mean, further from a knock.

    Arguments and result are those of `huber_mean`; the weights reach zero at `BIWEIGHT_C` / `HUBER_C` times `c`.
    """
    centre = huber_mean(values, c, least)
    residual = values - centre
    limit = np.maximum(_scale(residual), least) * (np.asarray(c) * (BIWEIGHT_C / HUBER_C))
    # A column of equal values has scale zero: every weight is one.
    share = np.square(residual / np.where(limit > 0.0, limit, 1.0)) * (limit > 0.0)
    weight = np.square(np.maximum(1.0 - share, 0.0))
    return np.asarray(centre + (weight * residual).sum(axis=0) / weight.sum(axis=0))


class RobustLine(msgspec.Struct, frozen=True):
    """A robust straight line through every column, (c,) each; slope per second.

    `end_leverage`: variance of `end` over the variance of one value, about 4/m, against 1/m for a mean.
    """

    end: Floats
    slope: Floats
    t_statistic: Floats
    end_leverage: Floats


def huber_line(
    times_s: Floats, values: Floats, end_s: float, c: Floats | float = HUBER_C, least: Floats | float = 0.0
) -> RobustLine:
    """Huber's line through every column of (m, c), m >= 3, evaluated at the window's end and not a second later.

    `c` and `least` as for `huber_mean`.
    """
    count = values.shape[0]
    time = (times_s - times_s.mean())[:, None]
    # Starts from the median slope of pairs half a window apart, not from least squares, which a knock at the edge
    # would tilt; and from pairs, because then a slope that is added to the values is added to the line.
    half = count // 2
    slope = np.median((values[-half:] - values[:half]) / (times_s[-half:] - times_s[:half])[:, None], axis=0)
    level = np.median(values - slope * time, axis=0)
    scale = np.maximum(_scale(values - level - slope * time), least)
    for _ in range(_ROUNDS):
        residual = values - level - slope * time
        weight = _weights(residual, scale, c)
        total = weight.sum(axis=0)
        centre = (weight * time).sum(axis=0) / total
        spread = (weight * np.square(time - centre)).sum(axis=0)
        turn = (weight * (time - centre) * residual).sum(axis=0) / spread
        shift = (weight * residual).sum(axis=0) / total - turn * centre
        slope = slope + turn
        level = level + shift
        if bool(np.all(np.abs(shift) + np.abs(turn) * time[-1] <= _CONVERGED * scale)):
            break
    residual = values - level - slope * time
    variance = (weight * np.square(residual)).sum(axis=0) / max(count - 2, 1)
    # A perfect line has no standard error; this keeps 0/0 out and is below anything that is measured.
    error = np.sqrt(variance / spread) + 1e-100
    at_end = end_s - times_s.mean()
    return RobustLine(
        end=np.asarray(level + slope * at_end),
        slope=np.asarray(slope),
        t_statistic=np.asarray(slope / error),
        end_leverage=np.asarray(1.0 / total + np.square(at_end - centre) / spread),
    )


def is_ramp(line: RobustLine, count: int, wander: Floats) -> NDArray[np.bool_]:
    """(c,) which columns' slopes, of `count` values, are ramps; `wander`: variance of a slope by the part's own."""
    chance = np.abs(line.t_statistic) > slope_limit(count)
    return np.asarray(chance & (np.abs(line.slope) > RAMP_FLOORS * np.sqrt(wander)))


def slope_limit(count: int) -> float:
    """Give the |t| that the slope through `count` values, at least 3, must exceed: `RAMP_T`, more for few.

    Of windows of 10 values 0.36 % show |t| > 5 by chance, and the end of such a line is far off. Student's t that
    chance exceeds once in 10 000 is 7.2 there; from 20 values on it is below 5.
    """
    return max(RAMP_T, student_quantile(_ONE_IN_10000, count - 2.0))


# --- slopes with a sigma


class Slope(msgspec.Struct, frozen=True):
    """Straight lines fitted to c columns of m values: slope, variance, white noise about the line; each (c,)."""

    per_s: Floats
    variance: Floats
    white: Floats  # N of the values about the line, unit * sqrt(s)


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
    flickers, walks = _wandering(slots, left, noise)
    variance = (
        np.square(noise) / spread
        + slope_variance(np.maximum(flickers, flicker), np.maximum(walks, walk), length_s)
        # An error of at most A either way turns a line by at most 3 A / T, and by A / (2 T) to A / T (rms).
        + np.square(np.asarray(hidden) / length_s)
    )
    return Slope(slope, np.asarray(variance), noise)


def plain_slope(times: NDArray[np.int64], values: Floats) -> float:
    time = times - np.add.reduce(times) / len(times)
    return float(time @ values / (time @ time))


def _wandering(slots: NDArray[np.int64], left: Floats, white: Floats) -> tuple[Floats, Floats]:
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
