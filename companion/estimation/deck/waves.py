"""Noise that comes in waves: its autoregressive model, and how a series is whitened by it.

What waves do to a reading is no white noise: it is narrow in frequency, and over some waves it averages out far faster
than one over the root of time. A line through it is judged by what is left when everything that the past foretells is
taken away. Burg's method as in Kay, Modern Spectral Estimation, 1988, section 7.3; whitening by a Kalman filter, which
takes gaps and the gyros' random walk of angle in its stride.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from companion.physics.frames import Floats, Matrix

MOST_TERMS: Final = 12
_LEAST_LEFT: Final = 1e-6
"""Of the variance: what foretells itself better than that is a line of the spectrum, and numbers do not bear it."""
_DOUBLINGS: Final = 24


class Waves(NamedTuple):
    """x[k] = sum(terms[i] x[k - 1 - i]) + noise of that variance."""

    terms: Floats
    variance: float


def fit_waves(series: list[Floats]) -> Waves:
    """The model of one or more series of one spectrum (means taken off), its order by Akaike's corrected criterion."""
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


class Wander(NamedTuple):
    """What is not stationary, from one row to the next; both are zero at the last row."""

    angle: float = 0.0
    """Variance of the step of a random walk: the gyros' white noise."""
    rate: float = 0.0
    """Variance of the step of a random walk whose sum this is: their bias, which is asked for as it is at last."""


def whitened(columns: Floats, waves: Waves, wander: Wander = Wander()) -> Floats:  # noqa: B008 - it never changes
    """Columns (n, c) as series of unit white noise, were they made of such waves and of what has wandered.

    Readings and regressors alike; a row of NaN is a gap.
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
    kick[angle, angle], kick[rate, rate] = wander.angle, wander.rate
    state = np.zeros((size, columns.shape[1]))
    found = np.full_like(columns, math.nan)
    turned = np.ascontiguousarray(move.T)
    gaps = np.asarray(np.isnan(columns).any(axis=1)).tolist()
    # Backwards: what has wandered is nothing at the end.
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
        # Narrow waves have covariances that numbers hardly bear: what is not symmetric grows without end.
        covariance = (covariance + covariance.T) / 2.0 + kick
    return found


def _stationary(move: Matrix, kick: Matrix) -> Matrix:
    """The covariance that stays as it is (Lyapunov's equation, by doubling)."""
    covariance, power = kick.copy(), move.copy()
    for _ in range(_DOUBLINGS):
        covariance = covariance + power @ covariance @ power.T
        power = power @ power
    return covariance
