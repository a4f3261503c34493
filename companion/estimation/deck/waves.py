"""Noise of waves: autoregressive model, whitening of a series by that model, and comparison with the gradienter.

Waves are narrow in frequency and average out far faster than white noise. The noise of a line through waves is only the
error of predicting each value from earlier ones. The model is fitted by Burg's method (Kay, Modern Spectral Estimation,
1988, section 7.3). A Kalman filter whitens the series; it allows for gaps and the gyros' random walk of angle.

The comparison of accelerometer and gradienter uses the gradienter's law and the lag of its fluid. Both sensors measure
the same specific force, including surge. To first order they differ by the accelerometers' bias and the gradienter's
zero. A wrong lag adds a difference proportional to the slope of the tilt, so the lag's error is one more unknown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import msgspec
import numpy as np

from companion.estimation.means.pose import GradienterModel
from companion.physics.frames import Array, Floats, Matrix
from companion.physics.gradienter import readings_from_up

MOST_TERMS: Final = 12
_LEAST_LEFT: Final = 1e-6
"""Least share of the variance that a prediction leaves; less, as for a pure sine, is beyond numerical precision."""
_DOUBLINGS: Final = 24


class Waves(NamedTuple):
    """Autoregressive model of waves: x[k] = sum over i of terms[i] x[k - 1 - i] + noise of variance `variance`."""

    terms: Floats
    variance: float


def fit_waves(series: list[Floats]) -> Waves:
    """Fit one model to several zero-mean series of one spectrum; Akaike's corrected criterion selects the order."""
    forward, backward = [s.copy() for s in series], [s.copy() for s in series]
    points = sum(len(s) for s in series)
    variance = sum(float(s @ s) for s in series) / max(points, 1)
    terms, whole = np.zeros(0), variance
    best = Waves(terms, variance)
    if variance <= 0.0:
        return best
    least = points * math.log(variance)
    for order in range(1, min(MOST_TERMS, points // 4) + 1):
        ahead, behind = [f[1:] for f in forward], [b[:-1] for b in backward]
        above = 2.0 * sum(float(f @ b) for f, b in zip(ahead, behind, strict=True))
        below = sum(float(f @ f) + float(b @ b) for f, b in zip(ahead, behind, strict=True))
        if below <= 0.0:
            break
        k = above / below
        if variance * (1.0 - k * k) < _LEAST_LEFT * whole:
            break
        forward = [f - k * b for f, b in zip(ahead, behind, strict=True)]
        backward = [b - k * f for f, b in zip(ahead, behind, strict=True)]
        terms = np.append(terms - k * terms[::-1], k)
        variance *= 1.0 - k * k
        penalty = 2.0 * order * points / max(points - order - 1, 1)
        if variance > 0.0 and points * math.log(variance) + penalty < least:
            least, best = points * math.log(variance) + penalty, Waves(terms, variance)
    return best


def whitened(columns: Floats, waves: Waves, wander: tuple[float, float] = (0.0, 0.0)) -> Floats:
    """Whiten n rows of readings and regressors (n, c) to unit variance; a row with NaN is a gap.

    `wander`: variances of the steps from row to row of two random walks, which are zero at the last row. The first is a
    walk of angle, caused by the gyros' white noise. The second is a walk of rate, caused by the wander of the gyros'
    bias; the sum of these rates adds to the angle. The bias is estimated at the last row.
    """
    order = max(len(waves.terms), 1)
    angle, rate, size = order, order + 1, order + 2
    move = np.zeros((size, size))
    move[0, : len(waves.terms)] = waves.terms
    move[1:order, : order - 1] = np.eye(order - 1)
    move[angle, angle] = move[angle, rate] = move[rate, rate] = 1.0
    kick = np.zeros((size, size))
    kick[0, 0] = waves.variance
    covariance = np.zeros((size, size))
    covariance[:order, :order] = _stationary(move[:order, :order], kick[:order, :order])
    kick[angle, angle], kick[rate, rate] = wander
    state = np.zeros((size, columns.shape[1]))
    found = np.full_like(columns, math.nan)
    turned = np.ascontiguousarray(move.T)
    gaps = np.asarray(np.isnan(columns).any(axis=1)).tolist()
    # Backwards: the wander is zero at the end.
    for row in range(len(columns) - 1, -1, -1):
        if not gaps[row]:
            spread = covariance[:, 0] + covariance[:, angle]
            variance = float(spread[0] + spread[angle])
            off = columns[row] - state[0] - state[angle]
            found[row] = off / math.sqrt(variance)
            gain = (spread / variance)[:, None]
            state += gain * off
            covariance -= gain * spread
        state = move @ state
        covariance = move @ covariance @ turned
        # Covariances of narrow-band waves are near the numerical limit: an asymmetry would grow.
        covariance = (covariance + covariance.T) / 2.0 + kick
    return found


def _stationary(move: Matrix, kick: Matrix) -> Matrix:
    covariance, power = kick.copy(), move.copy()
    for _ in range(_DOUBLINGS):
        covariance = covariance + power @ covariance @ power.T
        power = power @ power
    return covariance


class Level(msgspec.Struct, frozen=True):
    """Comparison of gradienter and accelerometer over one second; x and y (2,), degrees, in the gradienter's axes."""

    reading: Floats
    difference: Floats
    """Gradienter reading minus its prediction from the accelerometer."""
    slope: Floats  # Slope of the predicted reading, deg/s


class Fluid:
    """Model of the gradienter's lag: predicts the gradienter's reading from the specific force at one IMU."""

    def __init__(self, model: GradienterModel) -> None:
        self._law, self._turn, self.lag_s = model.law, model.vehicle_from_sensor, model.lag_s
        self._last: tuple[float, float, float] | None = None
        self._shown = (0.0, 0.0)

    def follow(self, times_s: Floats, forces_m_s2: Floats) -> Floats:
        """Predict lagged readings (n, 2), deg, from specific forces (n, 3), vehicle FRD; exact for linear changes."""
        felt = readings_from_up(self._law, forces_m_s2 @ self._turn)
        if self.lag_s <= 0.0:
            return felt
        found = np.empty_like(felt)
        lag_s = self.lag_s
        if self._last is None:
            self._last = float(times_s[0]), float(felt[0, 0]), float(felt[0, 1])
            self._shown = self._last[1], self._last[2]
        then, x_before, y_before = self._last
        x_shown, y_shown = self._shown
        for row, (now, (x, y)) in enumerate(zip(times_s.tolist(), felt.tolist(), strict=True)):
            span = now - then
            if span > 0.0:
                keep, behind = math.exp(-span / lag_s), lag_s / span
                x_late, y_late = (x - x_before) * behind, (y - y_before) * behind
                x_shown = x - x_late + (x_shown - x_before + x_late) * keep
                y_shown = y - y_late + (y_shown - y_before + y_late) * keep
            found[row] = x_shown, y_shown
            then, x_before, y_before = now, x, y
        self._last, self._shown = (then, x_before, y_before), (x_shown, y_shown)
        return found


def level(times_s: Floats, shown_deg: Floats, tilt_times_s: Floats, tilts_deg: Floats) -> Level | None:
    """Compare predicted (n, 2) and actual (m, 2) gradienter readings of a second; None if times do not overlap."""
    inside = (tilt_times_s >= times_s[0]) & (tilt_times_s <= times_s[-1])
    if not inside.any():
        return None
    at, tilts = tilt_times_s[inside], tilts_deg[inside]
    would = np.column_stack([np.interp(at, times_s, shown_deg[:, axis]) for axis in range(2)])
    return Level(
        tilts.mean(axis=0),
        (tilts - would).mean(axis=0),
        (shown_deg[-1] - shown_deg[0]) / max(float(times_s[-1] - times_s[0]), 1e-6),
    )


def compare(levels: Sequence[Level]) -> tuple[Array, Matrix]:
    """Return the mean (2,), deg, of gradienter reading minus prediction from accelerometers, and its covariance (2, 2).

    The waves that remain in the differences determine the weights.
    """
    difference = np.array([one.difference for one in levels])
    slope = np.array([one.slope for one in levels])
    one, nothing = np.ones(len(levels)), np.zeros(len(levels))
    waves: Waves = fit_waves([column - column.mean() for column in difference.T])
    for _ in range(2):
        rows = np.vstack(
            [
                whitened(np.column_stack([one, nothing, -slope[:, 0], difference[:, 0]]), waves),
                whitened(np.column_stack([nothing, one, -slope[:, 1], difference[:, 1]]), waves),
            ]
        )
        regressors = rows[:, :3]
        # The lag has a prior sigma of 1 s, so that it stays out of readings without motion.
        information = regressors.T @ regressors + np.diag([0.0, 0.0, 1.0])
        covariance = np.linalg.inv(information)
        x, y, lag = covariance @ (regressors.T @ rows[:, 3])
        left = difference - np.array([x, y]) + slope * lag
        waves = fit_waves([column - column.mean() for column in left.T])
    spent = 3 + len(waves.terms)
    widened = len(rows) / max(len(rows) - spent, len(rows) / 4.0)
    return np.array([x, y]), np.asarray(covariance[:2, :2] * widened)
