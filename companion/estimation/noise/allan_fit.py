"""White noise, flicker and random walk of a sensor out of its own recordings at rest.

Generalised least squares on the overlapping Allan variance at averaging times of 1, 2, 4, ... s. The variance at t is
N^2 / t + (2 ln 2 / pi) B^2 + K^2 t / 3 for averages over whole seconds, linear in N^2, B^2 and K^2; and how its
estimates scatter, and with each other, follows from the same three figures: the differences behind them are Gaussian
with a known generalised covariance (method 2.2), and the covariance of two squares is twice the square of the
covariance (Isserlis). So the weights are exact for the noise that is found, correlations between averaging times
included, and the figures come with honest standard errors. None of the three may be negative.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.estimation.noise.allan import FLOOR_OF_FLICKER, allan_variance
from companion.physics.frames import Floats, vector
from companion.physics.statistics import chi_square_sigmas

Slots = NDArray[np.int64]

KNOWN_SIGMAS: Final = 2.0
"""N^2, B^2 or K^2 over its standard error from which the recording tells it: within 25 % of N, B or K."""
UPPER_SIGMAS: Final = 1.645
"""Of the upper limit of a figure that is not told: one-sided 95 %."""
LEAST_SLOTS: Final = 8
"""Shorter stretches have no two averages beside one another that say anything beyond white noise."""
_LONGEST_SHARE: Final = 3
"""The longest average is a third of the stretch: beyond, one difference is all there is."""
_LAGS_OF_SHORTER: Final = 8
_REACH: Final = 16
EXCESS_SIGMAS: Final = 4.0
EXCESS_RATIO: Final = 1.2
"""Noise of another kind is named when an Allan variance is so far above the model, in sigmas and by this factor."""
_ROUNDS: Final = 30
_CONVERGED: Final = 1e-3
_UPPER_ROUNDS: Final = 40
_UNBOUNDED: Final = 1e6
_PAIRS: Final = tuple(itertools.combinations_with_replacement(range(3), 2))


class Curve(msgspec.Struct, frozen=True):
    """Allan variances (k, c) at averaging times (k,) of one stretch of so many seconds, of which a share is no hole."""

    length: int
    spans: tuple[int, ...]
    variance: Floats
    filled: float


class AxisFit(msgspec.Struct, frozen=True):
    """What the recordings say of one axis; figures in its unit (times sqrt(s), 1, over sqrt(s))."""

    figures: tuple[float, float, float]
    """N, B, K; the best that are not negative."""
    sigmas: tuple[float, float, float]
    """Standard errors of the squares N^2, B^2, K^2."""
    upper: tuple[float, float, float]
    """One-sided 95 % limits of N, B, K; infinite where the recordings are too short for one."""
    known: tuple[bool, bool, bool]
    """Which of them the recordings tell."""
    excess: tuple[int, float] | None = None
    """Where the noise is of another kind: the averaging time, s, at which the Allan deviation sticks out most of what
    the figures allow for by chance, and by which factor."""


def curve(slots: Slots, values: Floats) -> Curve | None:
    """The Allan variances of one stretch, from the means (m, c) of ascending seconds; None where it is too short."""
    if len(slots) < LEAST_SLOTS:
        return None
    length = int(slots[-1] - slots[0]) + 1
    spans, rows = [], []
    span = 1
    while span <= max(1, length // _LONGEST_SHARE):
        variance, freedom = allan_variance(slots, values, span)
        if freedom > 0.0:
            spans.append(span)
            rows.append(variance)
        span *= 2
    return Curve(length, tuple(spans), np.array(rows), len(slots) / length) if spans else None


def fit_axis(curves: Sequence[Curve], column: int) -> AxisFit:
    """N, B and K of one column over all stretches, each of which had its own noise of the same kind.

    Raises:
        ValueError: no curve, or a column that never changes.
    """
    # In units of the scatter from second to second, so that no square is small.
    weights = np.array([each.length for each in curves], dtype=np.float64)
    first = np.array([each.variance[0, column] for each in curves])
    unit2 = float((weights * first).sum() / weights.sum()) if curves else 0.0
    if not unit2 > 0.0:
        raise ValueError("nothing to fit: no stretch, or readings that never change")
    parts = [_Part(each, each.variance[:, column] / unit2) for each in curves]
    theta = np.array([1.0, 0.05, 1e-4])
    for _ in range(_ROUNDS):
        before = theta
        # White noise is in every sensor; and no figure at all would weigh everything infinitely.
        theta = np.maximum(not_negative(*_normal_equations(parts, theta)), [1e-9, 0.0, 0.0])
        if bool(np.all(np.abs(theta - before) <= _CONVERGED * (np.abs(before) + 1e-9))):
            break
    information, _ = _normal_equations(parts, theta)
    sigmas = np.sqrt(np.diag(np.linalg.inv(information)))
    upper = np.array([_upper(parts, theta, which, float(sigmas[which])) for which in range(3)])
    n, b, k = (theta > KNOWN_SIGMAS * sigmas).tolist()
    return AxisFit(
        figures=vector(np.sqrt(theta * unit2)),
        sigmas=vector(sigmas * unit2),
        upper=vector(np.sqrt(upper * unit2)),
        known=(n, b, k),
        excess=_excess(parts, theta),
    )


class _Part:
    """One stretch in the fit of one column."""

    def __init__(self, found: Curve, variance: Floats) -> None:
        spans = np.array(found.spans, dtype=np.float64)
        self.spans = found.spans
        self.variance = variance
        # Of an average with holes only what is there averages white noise away; one second has none.
        counts = np.where(spans > 1.0, found.filled * spans, 1.0)
        self.design = np.stack([1.0 / counts, np.full(len(spans), FLOOR_OF_FLICKER**2), spans / 3.0], axis=1)
        self._scatter = _scatter(found.length, found.spans) / found.filled

    def covariance(self, theta: Floats) -> Floats:
        """(k, k) of the variances, were the noise that of `theta`."""
        products = np.array([theta[p] * theta[q] for p, q in _PAIRS])
        return np.asarray(np.tensordot(products, self._scatter, axes=1))


def _normal_equations(parts: Sequence[_Part], theta: Floats) -> tuple[Floats, Floats]:
    """Information and right side of the generalised least squares, weighted as `theta` says."""
    information, right = np.zeros((3, 3)), np.zeros(3)
    for part in parts:
        weighted = np.linalg.solve(part.covariance(theta), np.column_stack([part.design, part.variance]))
        both = part.design.T @ weighted
        information += both[:, :3]
        right += both[:, 3]
    # One stretch with two averaging times tells no three figures: what it leaves open is worth a hair's breadth of
    # information, so that its standard error comes out large and not as an error.
    return information + np.diag(1e-12 * np.maximum(np.diag(information), 1.0)), right


def not_negative(information: Floats, right: Floats) -> Floats:
    """The least squares solution (n,) among those without a negative figure: the best of all that may be it."""
    many = len(right)
    best, least = np.zeros(many), 0.0
    for size in range(many, 0, -1):
        for chosen in itertools.combinations(range(many), size):
            index = list(chosen)
            some = np.linalg.solve(information[np.ix_(index, index)], right[index])
            theta = np.zeros(many)
            theta[index] = some
            loss = float(theta @ information @ theta - 2.0 * right @ theta)
            if bool((some >= 0.0).all()) and loss < least:
                best, least = theta, loss
    return best


def _upper(parts: Sequence[_Part], theta: Floats, which: int, sigma: float) -> float:
    """What a square may be at most: where an estimate as low as this one is a matter of 5 %.

    The estimate of a large figure scatters more, so the limit is looked for with the scatter that it would have itself.
    """
    limit = theta[which] + UPPER_SIGMAS * sigma
    for _ in range(_UPPER_ROUNDS):
        there = theta.copy()
        there[which] = limit
        information, _ = _normal_equations(parts, there)
        wider = float(theta[which] + UPPER_SIGMAS * math.sqrt(np.linalg.inv(information)[which, which]))
        if wider > _UNBOUNDED:
            return math.inf
        if wider <= limit * (1.0 + _CONVERGED):
            return max(float(limit), wider)
        limit = wider
    return math.inf


def _excess(parts: Sequence[_Part], theta: Floats) -> tuple[int, float] | None:
    """The averaging time at which the stretches together lie farthest above the model, if by more than chance does."""
    found: dict[int, list[float]] = {}
    for part in parts:
        model, sigma = part.design @ theta, np.sqrt(np.diag(part.covariance(theta)))
        for row, span in enumerate(part.spans):
            weight = 1.0 / sigma[row] ** 2
            total = found.setdefault(span, [0.0, 0.0, 0.0])
            total[0] += weight
            total[1] += weight * part.variance[row]
            total[2] += weight * model[row]
    worst: tuple[int, float] | None = None
    for span, (weight, measured, expected) in found.items():
        # sum(w v) has the variance sum(w); a sum of squares is chi-square.
        above = chi_square_sigmas(measured / expected, 2.0 * expected**2 / weight)
        if above > EXCESS_SIGMAS and measured > EXCESS_RATIO * expected:
            ratio = math.sqrt(measured / expected)
            if worst is None or ratio > worst[1]:
                worst = (span, ratio)
    return worst


@functools.lru_cache(maxsize=256)
def _scatter(length: int, spans: tuple[int, ...]) -> Floats:
    """(6, k, k): covariance of the Allan variances of one stretch by products of N^2, B^2, K^2 (in `_PAIRS`' order).

    A difference of neighbouring averages over a seconds is [X(t + 2a) - 2 X(t + a) + X(t)] / a with X the integral of
    the signal, whose generalised covariance is minus the second antiderivative of the signal's.
    """
    count = len(spans)
    found = np.zeros((len(_PAIRS), count, count))
    for row, column in itertools.combinations_with_replacement(range(count), 2):
        a, b = spans[row], spans[column]
        many_a, many_b = length - 2 * a + 1, length - 2 * b + 1
        # Beyond some lengths of the longer difference nothing is left (flicker: 1 / lag^2); and along the lags nothing
        # changes faster than the shorter one.
        stride = max(1, min(a, b) // _LAGS_OF_SHORTER)
        reach = _REACH * (a + b)
        lags = np.arange(-min(many_b - 1, reach), min(many_a - 1, reach) + 1, stride)
        weight = stride * (np.minimum(many_a - 1, many_b - 1 + lags) - np.maximum(lags, 0) + 1.0)
        shared = _shared(a, b, lags)
        for index, (p, q) in enumerate(_PAIRS):
            total = float((weight * shared[p] * shared[q]).sum()) / (2.0 * many_a * many_b)
            found[index, row, column] = found[index, column, row] = total if p == q else 2.0 * total
    return found


def _shared(a: int, b: int, lags: Slots) -> Floats:
    """(3, m): covariance of two differences, of a and b seconds, begun so many seconds apart; for N, B, K of one."""
    result = np.zeros((3, len(lags)))
    for i, j in itertools.product(range(3), repeat=2):
        factor = -float((1, -2, 1)[i] * (1, -2, 1)[j]) / (a * b)
        apart = np.abs(lags + i * a - j * b).astype(np.float64)
        square = np.square(apart)
        result[0] += factor * apart / 2.0
        result[1] -= factor * square * (np.log(np.maximum(apart, 1.0)) - 1.5) / (2.0 * math.pi)
        result[2] -= factor * square * apart / 12.0
    # Exactly zero where they have no second in common; rounding must not add up over the many lags.
    apart_for_good = (lags >= 2 * b) | (lags <= -2 * a)
    result[0, apart_for_good] = result[2, apart_for_good] = 0.0
    return result
