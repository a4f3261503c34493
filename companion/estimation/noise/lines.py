"""Robust means and lines through one-second means of a reading, and slopes with a sigma.

The robust mean is Huber's M-estimator plus one MM step. With c = 1.345 it has 95 % efficiency on clean data; its scale
is the median absolute deviation. It uses one-second means, never samples, because a median of quantised samples is
worse than their mean (method.md section 2.4). Sources: Huber, Annals of Mathematical Statistics 35 (1964) 73-101;
Yohai, Annals of Statistics 15 (1987) 642-656 (the step); Beaton and Tukey, Technometrics 16 (1974) 147-185 (weights).

If a slope is a warm-up, the line's end is the best estimate. A slope can also be chance, or the sensor's own wander
(section 2.4). An untested line costs more than it gains: its end has four times a mean's variance, and a wandering
bias returns. A slope must therefore exceed both the effect of white noise and that of the sensor's flicker and walk.

A slope that measures a turn (`fit_slope`) has three uncertainties (method.md section 2.6): white noise of the means,
slow wander, and coarse steps, which may hide a slope. The Allan deviation of the readings shows the slow wander.
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
"""Distance from the centre, in robust sigmas, from which `robust_mean` ignores a value. Simulation of 60 values: on
clean data, variance grows by 2.2 % (Huber's mean: 5 %); with a knock in 5 % of values, sigma by 4 % (Huber: 26 %)."""
STANDS_OUT: Final = 4.5  # Distance from Huber's mean, in robust sigmas, from which a value may be a knock
_MEAN_ABS_TO_SIGMA: Final = 1.2533
_EQUAL: Final = 1e-6
_ROUNDS: Final = 30
_CONVERGED: Final = 1e-4

RAMP_T: Final = 6.0
"""Threshold for the t statistic of a slope that counts as a ramp; higher in a short window. On sensors without a ramp,
a lower threshold costs more than it gains (method.md section 2.4)."""
RAMP_FLOORS: Final = 3.0
"""Threshold for a ramp, in sigmas of the slope that the sensor's flicker and walk cause. In one minute of an
ADIS16405's accelerometer, flicker alone makes 8 % of slopes exceed |t| = 5; their lines' ends add 12 % rms error."""
RAMP_BATCHES: Final = 8  # Least seconds for a line
_ONE_IN_100000: Final = 4.4172  # Two-sided normal quantile for one case in 100 000

FEWEST: Final = 3
_SPANS: Final = 5
_WALKS: Final = 2.5
"""Ratio of Allan variance to that of white noise, above which a walk is assumed; white noise exceeds it once in 40."""
_LINE_TAKES: Final = 1.6  # Allan variance of a random walk at T/5, before over after subtraction of a line


# --- robust


def _scale(residual: Floats) -> Floats:
    """Return a robust sigma (c,) of residuals (m, c): by their median size, or by the mean if that is only rounding."""
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
    """Return Huber's robust mean (c,) of m >= 1 values in each column of (m, c).

    `c`: robust sigmas beyond which a value has less weight. `least`: lower limit of the robust sigma. Scalars or (c,).
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
    """Return the mean (c,) of each column of (m, c): the plain mean if no value is an outlier, else a robust mean.

    The robust mean is one step from Huber's mean, with weights that reach zero at `BIWEIGHT_C` / `HUBER_C` times `c`
    robust sigmas. The arguments are those of `huber_mean`.
    """
    centre = huber_mean(values, c, least)
    residual = values - centre
    scale = np.maximum(_scale(residual), least)
    limit = scale * (np.asarray(c) * (BIWEIGHT_C / HUBER_C))
    # A column of equal values has scale zero: every weight is one.
    share = np.square(residual / np.where(limit > 0.0, limit, 1.0)) * (limit > 0.0)
    stands_out = (np.abs(residual) > STANDS_OUT * scale).any(axis=0)
    weight = np.where(stands_out, np.square(np.maximum(1.0 - share, 0.0)), 1.0)
    return np.asarray(centre + (weight * residual).sum(axis=0) / weight.sum(axis=0))


class RobustLine(msgspec.Struct, frozen=True):
    """Robust straight lines through c columns of m values; `end`: value at the window's end; each (c,).

    `end_leverage`: variance of `end` over the variance of one value, about 4 / m; a mean has 1 / m.
    """

    end: Floats
    slope: Floats
    t_statistic: Floats
    end_leverage: Floats


def huber_line(
    times_s: Floats, values: Floats, end_s: float, c: Floats | float = HUBER_C, least: Floats | float = 0.0
) -> RobustLine:
    """Fit Huber's robust line to each column of (m, c), m >= 3, and evaluate it at the window's end, never later.

    `c` and `least` are those of `huber_mean`.
    """
    count = values.shape[0]
    time = (times_s - times_s.mean())[:, None]
    # Start from the median slope of pairs half a window apart: a knock at the edge would tilt a least-squares line.
    # With pairs, a slope added to the values is added exactly to the line.
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
    # A perfect line has zero standard error: the constant prevents 0/0 and is below any measured value.
    error = np.sqrt(variance / spread) + 1e-100
    at_end = end_s - times_s.mean()
    return RobustLine(
        end=np.asarray(level + slope * at_end),
        slope=np.asarray(slope),
        t_statistic=np.asarray(slope / error),
        end_leverage=np.asarray(1.0 / total + np.square(at_end - centre) / spread),
    )


def is_ramp(line: RobustLine, count: int, wander: Floats) -> NDArray[np.bool_]:
    """Return (c,) true for slopes that are ramps; `wander`: variance of a slope that flicker and walk may cause."""
    chance = np.abs(line.t_statistic) > slope_limit(count)
    return np.asarray(chance & (np.abs(line.slope) > RAMP_FLOORS * np.sqrt(wander)))


def slope_limit(count: int) -> float:
    """Return the threshold for |t| of a slope through at least 3 values: `RAMP_T`, or more if `count` is small.

    Student's t with a probability of 1 in 100 000 is 9.9 for 10 values; from 21 values on, it is below 6. With 5, one
    window of 10 s in 1000 of an ADIS16405 at rest had a ramp by chance; its end was four times as far off as its mean.
    """
    return max(RAMP_T, student_quantile(_ONE_IN_100000, count - 2.0))


# --- slopes with a sigma


class Slope(msgspec.Struct, frozen=True):
    """Slopes of lines through c columns of values, with variance of the slope, and white noise about the line; (c,)."""

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
    """Fit the slope of each column of one-second means (m, c), at m >= `FEWEST` ascending seconds `slots`.

    `white`, `flicker`, `walk`: lower limits for N, B, K, scalars or (c,). `hidden`: largest rounding error, +/-.
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
        # An error within +/-A changes the slope by at most 3 A / T; its rms is A / (2 T) to A / T.
        + np.square(np.asarray(hidden) / length_s)
    )
    return Slope(slope, np.asarray(variance), noise)


def plain_slope(times: NDArray[np.int64], values: Floats) -> float:
    time = times - np.add.reduce(times) / len(times)
    return float(time @ values / (time @ time))


def _wandering(slots: NDArray[np.int64], left: Floats, white: Floats) -> tuple[Floats, Floats]:
    """Estimate flicker B, or instead random walk K, (c,), from the residuals' Allan deviation at 1/5 of the window.

    The estimate is enlarged if it has few averages. No sigma includes a walk too small to show in one window: K = 0.1 N
    per s doubles the error of a minute's slope, but the walk's Allan variance is half that of the white noise.
    """
    span = int(slots[-1] - slots[0] + 1) // _SPANS
    if span < 2:
        return np.zeros(left.shape[1]), np.zeros(left.shape[1])
    variance, freedom = allan_variance(slots, left, span)
    explained, widened = np.square(white) / span, student_ratio(freedom)
    walks = variance > _WALKS * explained
    # Use the whole excess, significant or not: a line absorbs the slowest wander, so the residuals show too little.
    flicker = np.sqrt(np.maximum(variance - explained, 0.0)) / FLOOR_OF_FLICKER * widened
    walk = np.sqrt(3.0 * _LINE_TAKES * variance / span) * widened
    return np.where(walks, 0.0, flicker), np.where(walks, walk, 0.0)


def hidden_by_steps(step: float, variance: float, *, enough: bool = True) -> float:
    """Return the largest error (+/-) of a mean of readings rounded to `step` (0: floats); `variance`: of the readings.

    It is (q / pi) exp(-2 pi^2 sigma^2 / q^2) for step q (method.md section 2.5), at most half a step. If values are too
    few (not `enough`), it is half a step.
    """
    if step <= 0.0 or not enough:
        return max(step, 0.0) / 2.0
    noise = max(variance / step**2 - 1.0 / 12.0, 0.0)
    return step * min(0.5, math.exp(-2.0 * math.pi**2 * noise) / math.pi)
