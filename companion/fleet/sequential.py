"""Statistics of values measured at each power-up (biases, noise): scatter, and tests for a change of mean or scatter.

A Kalman filter predicts each value from earlier ones: a slowly changing mean (the level) plus a cubic in temperature.
The residuals in sigmas are summed in two-sided CUSUM tests (Page, Biometrika 41 (1954) 100-115) for a changed level.
For doubled scatter, a likelihood-ratio CUSUM tests each value's distance from the median of the three before it. One
value counts at most `CLIP` sigmas, so that one knock raises no alarm.

With these limits tests/judgement_study.py finds less than one false alarm per hundred aircraft and month. The columns
of an IMU are gyro x y z, then accelerometer x y z, vehicle FRD, SI units.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.estimation.noise.lines import HUBER_C
from companion.physics.frames import Floats
from companion.physics.statistics import MAD_TO_SIGMA

LEAST_POWER_UPS: Final = 8
LEAST_PARTS: Final = 4
WANDER_LAG: Final = 30
"""Number of power-ups between two biases whose difference measures the bias's random walk over power-ups."""
_POWER_UPS_PER_TEMPERATURE_TERM: Final = 24
_OUTLIER_SIGMAS: Final = 3.0
_GROUPS: Final = (slice(0, 3), slice(3, 5), slice(5, 6))
"""Columns that share one scatter: gyros; accelerometers x and y, which include the tilt sensor's error; accel z."""
CLIP: Final = 3.0
LEAST_SHIFT: Final = 0.5
"""Constant subtracted in each step of the CUSUM sums, in sigmas: half of the change that they detect fastest."""
LEVEL_LIMIT: Final = 17.0
SCATTER_LIMIT: Final = 20.0
_FURTHER: Final = 6.0
"""Largest excess of the scatter test's sum over its alarm limit, so that the sum falls soon after the scatter."""
_TWICE: Final = (0.375, np.log(2.0))
"""Log-likelihood ratio of doubled to usual scatter: factor of z^2 (z: residual in sigmas), subtracted constant."""
OWN_WEIGHT: Final = 8.0
"""Weight of the initial scatter, in power-ups of the IMU: the scatters of one model's IMUs differ by a quarter."""
_HELD_SIGMAS: Final = 2.5
_MEAN_SQUARE_OF_HELD: Final = 0.9775  # mean square of a standard normal number clipped to `_HELD_SIGMAS`
_VARIANCE_OF_MEDIAN_OF_3: Final = 0.449  # variance of the median of three standard normal numbers
_STEP_K: Final = 15.0
_AT_DEGC: Final = 20.0
_INITIAL_VARIANCES: Final = np.square(
    [100.0, 50.0, 10.0, 2.0]
)  # squared multiples of the usual scatter: level, three coefficients over temperature
_NEW_LEVEL: Final = 1e4
_BASE_POWER_UPS: Final = 20


def scatter_of_part(biases: Floats, temperature_degc: Floats) -> Floats:
    """Estimate the scatter of each of c columns of values at n power-ups, (n, c), at temperatures (n,); NaN: unknown.

    First row of the result, (2, c): turn-on sigma at one temperature, errors of the calibrations included; ageing or
    one sudden change hardly alters it. Second row: sigma of the lasting change per power-up. Both come from the median
    size of differences between power-ups, corrected for temperature.
    """
    return np.array([_column(column, temperature_degc) for column in biases.T]).T


def scatter_of_model(parts: Sequence[Floats]) -> Floats | None:
    """Return the median scatter of IMUs of one model, (2, 6), rows as in `scatter_of_part`; None: too few IMUs."""
    telling = [part for part in parts if np.isfinite(part[0]).any()]
    if len(telling) < LEAST_PARTS:
        return None
    figures, middle = np.array(telling), np.empty((2, 6))
    for group in _GROUPS:
        middle[:, group] = [[middle_of(each)] for each in np.moveaxis(figures[:, :, group], 1, 0)]
    return middle


def middle_of(values: Floats) -> float:
    there = values[np.isfinite(values)]
    return float(np.median(there)) if len(there) else np.nan


def _column(bias: Floats, temperature_degc: Floats) -> tuple[float, float]:
    there = np.isfinite(bias)
    value, degc = bias[there], temperature_degc[there]
    if len(value) < LEAST_POWER_UPS:
        return np.nan, np.nan
    known = np.isfinite(degc)
    warmer = np.where(known, degc - (degc[known].mean() if known.any() else 0.0), 0.0) / _STEP_K
    # Polynomial over temperature: a line for few power-ups, up to a cubic for many.
    laws = warmer[:, None] ** np.arange(1, 2 + min(len(value) // _POWER_UPS_PER_TEMPERATURE_TERM, 2))
    step, by = np.diff(value), np.diff(laws, axis=0)
    weight = np.ones(len(step))
    for _ in range(3):
        terms = np.linalg.lstsq(by * weight[:, None], step * weight, rcond=None)[0]
        scale = _sigma(step - by @ terms)
        weight = (np.abs(step - by @ terms) <= _OUTLIER_SIGMAS * scale).astype(np.float64)
    turn_on = scale / np.sqrt(2.0)
    if len(value) < 3 * WANDER_LAG:
        return turn_on, np.nan
    level = value - laws @ terms
    far = _sigma(level[WANDER_LAG:] - level[:-WANDER_LAG])
    return turn_on, np.sqrt(max(far**2 - scale**2, 0.0) / (WANDER_LAG - 1))


def _sigma(steps: Floats) -> float:
    return MAD_TO_SIGMA * float(np.median(np.abs(steps)))


class Alarm(NamedTuple):
    """Change of one column's mean (level) or scatter, detected at power-up `at`; it began at power-up `since`.

    `until`: power-up at which the scatter was usual again. If it never was, or if the level changed, `until` is the
    number of all power-ups. `size`: change of the level, or scatter since `since`, in multiples of the usual scatter.
    """

    column: int
    kind: Literal["level", "scatter"]
    since: int
    at: int
    until: int
    size: float


class Columns(NamedTuple):
    """Input of the tests: values at n power-ups in order, in c columns that are tested independently; NaN: unknown.

    The first three arrays and `relevel` are (n, c), the others (c,). All but `temperature_degc`, `relevel`, `first` and
    `unit` are multiples of the usual scatter; `unit` is this scatter.
    """

    values: Floats  # (n, c) multiples of the usual scatter; NaN: not measured
    variance: Floats
    """Excess of each value's variance over the usual variance, (n, c), in squared multiples of the usual scatter."""
    temperature_degc: Floats
    wander: Floats
    """One-sigma change of a column's mean from one power-up to the next, (c,), as a multiple of the usual scatter."""
    relevel: NDArray[np.bool_]
    """True, (n, c), at the first power-up after the tilt sensor's zero was measured anew: a column's mean may jump."""
    first: NDArray[np.int_]
    """Number of first power-ups that define the usual mean and scatter of each column, (c,), at least 3."""
    most_own: Floats  # (c,) largest scatter of a column accepted as usual, as a multiple of the usual scatter
    least: Floats  # (c,) least change of level, or scatter, that raises an alarm
    unit: Floats


def watch(columns: Columns) -> list[Alarm]:  # noqa: PLR0915
    values, variance, temperature_degc, wander, relevel, first, most_own, least, _ = columns
    n, c = values.shape
    there = np.isfinite(values)
    unknown = ~np.isfinite(temperature_degc)
    warmer = (np.where(unknown, _AT_DEGC, temperature_degc) - _AT_DEGC) / _STEP_K
    unknown &= ~unknown.all(axis=0)
    laws = warmer[:, :, None] ** np.arange(4)
    every = np.arange(c)
    # A value that was not measured repeats the one before; the filter does not count it.
    held = np.maximum.accumulate(np.where(there, np.arange(n)[:, None], there.argmax(axis=0)), axis=0)
    y, laws = np.nan_to_num(values[held, every] - values[held[0], every]), laws[held, every]
    x, p = np.zeros((c, 4)), np.tile(np.diag(_INITIAL_VARIANCES), (c, 1, 1))
    own, count = np.full(c, OWN_WEIGHT), np.full(c, OWN_WEIGHT)
    up, down, wide = np.zeros((3, c))
    up_0, down_0, wide_0 = np.zeros((3, c), dtype=int)
    latest = np.zeros((3, c), dtype=int)
    seen = np.zeros(c, dtype=int)
    is_open: dict[int, Alarm] = {}
    alarms: list[Alarm] = []
    for k in range(n):
        h, here = laws[k], there[k] & (k >= first)
        for column in np.flatnonzero(first == k).tolist():
            tell = there[:k, column] & ~unknown[:k, column]
            x[column], p[column], squares = _begin(y[:k, column], laws[:k, column], tell)
            own[column] += squares
            count[column] += max(tell.sum() - 4, 0)
            p[column] *= np.clip(own[column] / count[column], 1.0, most_own[column] ** 2)
            p[column, 0, 0] += _NEW_LEVEL * relevel[:k, column].any()
            latest[:, column], seen[column] = range(k - 3, k), there[:k, column].sum()
        p[:, 0, 0] += wander**2
        p[relevel[k], 0, 0] += _NEW_LEVEL
        seen[relevel[k]] = 0
        usual = np.clip(own / count, 1.0, most_own**2)
        ph = (p * h[:, None, :]).sum(axis=2)
        of_filter = (ph * h).sum(axis=1)
        # A value of unknown temperature may belong to any temperature, so its variance is larger.
        law = np.square(x[:, 1:]) + p[:, range(1, 4), range(1, 4)]
        more = variance[k] + unknown[k] * law.sum(axis=1)
        total = of_filter + usual + more
        off = np.where(here, y[k] - (x * h).sum(axis=1), 0.0)
        z = off / np.sqrt(total)
        gain = ph * (here / total)[:, None]
        # Once the level is known, follow slowly: the residual may be a fault.
        most = np.where(of_filter < usual, HUBER_C, CLIP)
        x += gain * (np.clip(z, -most, most) * np.sqrt(total))[:, None]
        p -= gain[:, :, None] * ph[:, None, :]

        # Distance from the median of the three values before: a change of level makes only two of them large.
        before = y[latest, every] - (laws[latest, every, 1:] * x[:, 1:]).sum(axis=2)
        middle = before.sum(axis=0) - before.max(axis=0) - before.min(axis=0)
        apart = h[:, 1:] - laws[latest, every, 1:].mean(axis=0)
        of_law = ((p[:, 1:, 1:] * apart[:, None, :]).sum(axis=2) * apart).sum(axis=1)
        about = usual * (1.0 + _VARIANCE_OF_MEDIAN_OF_3) + more + of_law
        d2 = np.square(y[k] - (h[:, 1:] * x[:, 1:]).sum(axis=1) - middle) / about
        tells = here & (seen >= 3)
        wide = np.where(tells, np.maximum(wide + _TWICE[0] * np.minimum(d2, CLIP**2) - _TWICE[1], 0.0), wide)
        wide = np.minimum(wide, SCATTER_LIMIT + _FURTHER)
        wide_0 = np.where(wide == 0.0, k + 1, wide_0)

        z = np.clip(z, -CLIP, CLIP)
        up = np.where(here, np.maximum(up + z - LEAST_SHIFT, 0.0), up)
        down = np.where(here, np.maximum(down - z - LEAST_SHIFT, 0.0), down)
        up_0, down_0 = np.where(up == 0.0, k + 1, up_0), np.where(down == 0.0, k + 1, down_0)

        # Learn the column's own scatter, except during a suspected change or while the level is uncertain.
        learns = here & (wide < SCATTER_LIMIT / 4.0) & (of_filter < usual)
        own = own + np.where(learns, usual * np.minimum(np.square(z), _HELD_SIGMAS**2) / _MEAN_SQUARE_OF_HELD, 0.0)
        count = count + learns
        latest = np.where(here, np.stack([latest[1], latest[2], np.full(c, k)]), latest)
        seen = seen + here

        for column in np.flatnonzero((up > LEVEL_LIMIT) | (down > LEVEL_LIMIT)).tolist():
            rose = up[column] > LEVEL_LIMIT
            since = int((up_0 if rose else down_0)[column])
            level = _at_one_temperature(y, laws, x, column)
            moved = np.median(level[since : k + 1]) - np.median(level[max(since - _BASE_POWER_UPS, 0) : since])
            if not abs(moved) >= least[column]:
                continue
            alarms.append(Alarm(column, "level", since, k, n, float(moved)))
            up[column] = down[column] = 0.0
            p[column, 0, 0] += _NEW_LEVEL
        for column in np.flatnonzero(wide > SCATTER_LIMIT).tolist():
            if column not in is_open:
                since = int(wide_0[column])
                size = _scatter(_at_one_temperature(y, laws, x, column)[since : k + 1])
                if size >= least[column]:
                    is_open[column] = Alarm(column, "scatter", since, k, n, size)
        for column in [column for column in is_open if wide[column] == 0.0]:
            alarms.append(is_open.pop(column)._replace(until=k))
    for column, alarm in is_open.items():
        size = _scatter(_at_one_temperature(y, laws, x, column)[alarm.since :])
        alarms.append(alarm._replace(size=size))
    return sorted(alarms, key=lambda alarm: (alarm.at, alarm.column))


def _begin(y: Floats, laws: Floats, there: NDArray[np.bool_]) -> tuple[Floats, Floats, float]:
    """Fit a cubic in temperature to one column's first power-ups; return coefficients, covariance, sum of squares.

    Huber weights reduce the effect of calibrations during which the aircraft was knocked.
    """
    weight: Floats = there.astype(np.float64)
    for _ in range(8):
        inverse = np.linalg.inv((laws * weight[:, None]).T @ laws + np.diag(1.0 / _INITIAL_VARIANCES))
        x = inverse @ (laws * weight[:, None]).T @ y
        off = np.abs(y - laws @ x)
        scale = max(MAD_TO_SIGMA * float(np.median(off)), 1.0)
        weight = np.asarray(there * np.minimum(HUBER_C * scale / np.maximum(off, 1e-9), 1.0), dtype=np.float64)
    return x, np.asarray(inverse, dtype=np.float64), float((weight * np.square(off)).sum())


def _scatter(level: Floats) -> float:
    return float(MAD_TO_SIGMA * np.median(np.abs(np.diff(level))) / np.sqrt(2.0)) if len(level) > 1 else 0.0


def _at_one_temperature(y: Floats, laws: Floats, x: Floats, column: int) -> Floats:
    """Convert the values of one column, (n,), to a common temperature by the fitted polynomial `x`."""
    return np.asarray(y[:, column] - laws[:, column, 1:] @ x[column, 1:])
