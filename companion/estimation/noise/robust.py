"""Means and lines that one knock does not move: Huber's M-estimator over batch means, and one step beyond it.

c = 1.345 keeps 95 % of the efficiency on clean data; the scale is the median absolute deviation. Works on batch
means, never on samples: a median of quantised samples is worse than the mean (method 2.4).
Sources: Huber, Annals of Mathematical Statistics 35 (1964) 73-101; the step, Yohai, Annals of Statistics 15 (1987)
642-656, with the weights of Beaton and Tukey, Technometrics 16 (1974) 147-185.

A line's slope may be a warm-up, whose end counts, or chance and the part's own wander (method 2.4). An untested
line costs more than it saves: its end has four times the variance of a mean, and a part that wanders comes back. So a
slope must exceed what white noise makes and what the flicker and walk of the part make.
"""

from __future__ import annotations

from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.physics.frames import Floats
from companion.physics.statistics import MAD_TO_SIGMA, student_quantile

HUBER_C: Final = 1.345
BIWEIGHT_C: Final = 6.0
"""Scales beyond which a value does not count at all in `robust_mean`. Simulated, 60 values: 2.2 % of variance is lost
on clean data (Huber's mean alone 5 %), and a knock in 5 % of them costs 4 % of sigma instead of 26 %."""
_MEAN_ABS_TO_SIGMA: Final = 1.2533
_EQUAL: Final = 1e-6
_ROUNDS: Final = 30
_CONVERGED: Final = 1e-4
"""Share of the scatter of one value: 0.1 % of the standard error of a mean of a hundred."""


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
    """A robust straight line through every column, (c,) each: its end, slope per second, and that over its error."""

    end: Floats
    slope: Floats
    t_statistic: Floats
    end_leverage: Floats
    """Variance of `end` over the variance of one value: about 4/m, against 1/m for a mean."""


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


RAMP_T: Final = 5.0
"""|t| of a slope that counts as one, more in a short window. On sensors without a ramp a lower one costs more than it
saves (2.4)."""
RAMP_FLOORS: Final = 3.0
"""Standard deviations of the slope that the part's own flicker and walk make. In a minute of an ADIS16405's
accelerometers 8 % of the slopes exceed |t| = 5 by flicker alone, and taking their ends costs 12 % of the rms error."""
RAMP_BATCHES: Final = 8
"""Fewer seconds make no line."""
_ONE_IN_10000: Final = 3.8906
"""Sigmas that a normal number exceeds with this probability, on either side."""


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
