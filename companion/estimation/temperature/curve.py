"""Curve of a bias over temperature, fitted to still seconds of many power-ups; it predicts the next power-up.

The bias of power-up s at the temperature T is

    o_s + c1 d + c2 d^2 + c3 d^3,    d = (T - lag dT/dt - 35 degC) / 20 K.

Each power-up has an offset o_s of its own, scattered about a mean with the variance tau^2 (run to run); the curve is
common to all. The die is as warm as its thermometer was `lag` before: that is why heating and cooling differ.

The fit is generalised least squares over means of still seconds at one temperature (`Node`). Within a power-up the
offset is free, between power-ups it scatters by tau. The coefficients have a prior as wide as the catalogue's parts
move, so the curve is uncertain at temperatures that were not seen.

Each power-up is predicted from the others at its first node. The errors choose the lag, choose between the curve and a
mean, and scale tau until the actual error matches the predicted one. The change from the first node to the last is
predicted as well: it scales the error of changes, and reveals a thermometer that is not in this IMU.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Final

import msgspec
import numpy as np

from companion.physics.frames import Array, Floats, Matrix
from companion.samples import Vector

REFERENCE_DEGC: Final = 35.0
UNIT_K: Final = 20.0
LAGS_S: Final = (0.0, 10.0, 20.0, 30.0)
VALID_K: Final = 3.0
"""Kelvins beyond the temperatures seen within which the curve is valid (method 3.3)."""
FEWEST: Final = 3
"""Least power-ups of a fit."""
_ORDER: Final = 3
"""Order of every curve. A lower order would claim the same sigma where little was seen as where much was."""
_BETTER: Final = 0.9
"""Largest mean square error of a curve, as a share of that of a mean, at which the curve is used."""
_AT_LEAST: Final = 0.5
"""Least scatter, as a share of the mean square error: the stated noise may be too large."""
_RANGE: Final = 18.0
"""Half the search range of the logarithm of the scatter's variance, about that of a kelvin."""
_HALVINGS: Final = 25
_SURELY: Final = 2.0
"""Sigmas beyond which an error is not chance."""
_LITTLE: Final = 1e-6
"""Lower bounds of variances, as shares of that of a kelvin and of that of the noise."""
_PRIOR_K: Final = np.array([UNIT_K, UNIT_K / 2.0, UNIT_K / 4.0])
"""Prior sigma of each coefficient, in kelvins of the slope of parts."""
State = tuple[float, float]
"""A temperature and how fast it rises, degC and K/s."""


class Node(msgspec.Struct, frozen=True):
    """Still seconds of one power-up at about one temperature; vehicle FRD, rad/s or m/s^2."""

    degc: float
    bias: Vector
    variance: float
    """Variance of the white noise, mean over the axes."""
    k_s: float = 0.0
    """Rate of the temperature, K/s."""


@dataclasses.dataclass(frozen=True, slots=True)
class PowerUpNodes:
    """Nodes of one power-up."""

    nodes: Sequence[Node]
    common_variance: float = 0.0
    """Variance of an error that all nodes share, perhaps with other power-ups; it lowers the weight."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Prediction of the next power-up's bias over temperature.

    Attributes:
        order: 0 a mean, 3 a cubic.
        lag_s: lag of the die behind its thermometer.
        coefficients: mean and coefficients of the terms, (1 + terms, 3).
        covariance: covariance of the coefficients, for an axis with the usual scatter.
        widening: factor on the covariance for each axis, (3,).
        of_changes: factor on the covariance for changes within a power-up, (3,).
        unexplained: share of the changes, in squares, that the curve does not explain and that is not chance.
        scatter: variance of one more power-up about the curve, wandering included, (3,).
        foretold: mean square error of the predictions of left-out power-ups, (rad/s)^2 or (m/s^2)^2.
        shares: weight of each power-up in the mean, (n,).
        freedom: degrees of freedom of the scatter.
        span_degc: lowest and highest temperature seen.
        per_kelvin: one sigma of the change per kelvin beyond that.
    """

    order: int
    lag_s: float
    coefficients: Matrix
    covariance: Matrix
    widening: Array
    of_changes: Array
    unexplained: float
    scatter: Array
    foretold: float
    shares: Array
    freedom: float
    span_degc: tuple[float, float]
    per_kelvin: float

    def beyond_k(self, degc: float) -> float:
        """Give the kelvins by which a temperature lies beyond the valid range."""
        return max(self.span_degc[0] - VALID_K - degc, degc - self.span_degc[1] - VALID_K, 0.0)

    def at(self, degc: float, k_s: float = 0.0) -> tuple[Array, Array]:
        """Predict the next power-up's bias at a temperature, and its variance, (3,) each; a line beyond the range."""
        x = _with_one(self._row(degc, k_s)[None])[0]
        steepest = self.per_kelvin
        if self.order:
            low, high = self.span_degc
            along = self._row(high) - self._row(low)
            steepest = max(steepest, float(np.abs(along @ self.coefficients[1:]).max()) / max(high - low, VALID_K))
        outside = (steepest * self.beyond_k(degc)) ** 2
        return x @ self.coefficients, self.scatter + float(x @ self.covariance @ x) * self.widening + outside

    def change(self, then: State, now: State) -> tuple[Array, Array]:
        """Predict the change of the bias within a power-up, and its variance, (3,) each; a mean has none.

        `then` and `now` are a temperature and its rate, degC and K/s.
        """
        return self.moves([(-1.0, then), (1.0, now)])

    def moves(self, weighted: Iterable[tuple[float, State]]) -> tuple[Array, Array]:
        """Predict a weighted sum of several states, and its variance, (3,) each; the weights add up to zero."""
        x, outside_k = np.zeros(self.order), 0.0
        for weight, (degc, k_s) in weighted:
            side = 1.0 if degc > self.span_degc[1] else -1.0
            x, outside_k = x + weight * self._row(degc, k_s), outside_k + weight * side * self.beyond_k(degc)
        variance = float(x @ self.covariance[1:, 1:] @ x) * self.of_changes + (self.per_kelvin * outside_k) ** 2
        return x @ self.coefficients[1:], variance

    def _row(self, degc: float, k_s: float = 0.0) -> Array:
        die_degc = degc - self.lag_s * k_s
        edge_degc = min(max(die_degc, self.span_degc[0] - VALID_K), self.span_degc[1] + VALID_K)
        d = (edge_degc - REFERENCE_DEGC) / UNIT_K
        straight_on = np.array([1.0, 2.0 * d, 3.0 * d * d]) * (die_degc - edge_degc) / UNIT_K
        return np.asarray(_terms(np.array([edge_degc]))[0] + straight_on)[: self.order]


def fit(
    power_ups: Sequence[PowerUpNodes],
    in_run_variance: float,
    per_kelvin: float,
    *,
    may_be_mean: bool = True,
) -> Curve | None:
    """Fit the curve of one triad of one IMU; None: fewer than three power-ups.

    Args:
        power_ups: at least one node each, in the order in which they were measured.
        in_run_variance: by which a bias wanders within a power-up, (rad/s)^2 or (m/s^2)^2.
        per_kelvin: one sigma of how much parts move, rad/s or m/s^2 a kelvin.
        may_be_mean: whether to return a mean where it predicts as well; a mean has no change within a power-up.
    """
    if len(power_ups) < FEWEST:
        return None
    seen = [node.degc for one in power_ups for node in one.nodes]
    span = min(seen), max(seen)
    in_run_variance = max(in_run_variance, _LITTLE * per_kelvin**2)

    def of(order: int, lag_s: float = 0.0) -> Curve:
        sums = _Sums.of(power_ups, lag_s, in_run_variance)
        return _Fit(sums, order, in_run_variance, per_kelvin).curve(span)

    mean = of(0) if may_be_mean else None
    if mean is not None and span[0] == span[1]:
        return mean
    rates = any(node.k_s for one in power_ups for node in one.nodes)
    curves = (of(_ORDER, lag_s) for lag_s in (LAGS_S if rates else LAGS_S[:1]))
    curve = min(curves, key=lambda one: one.foretold)
    return curve if mean is None or curve.foretold < _BETTER * mean.foretold else mean


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Sums:
    """Sums of least squares for each power-up, axis 0, for the largest order."""

    lag_s: float
    variance: Floats
    """Variance of the weighted mean, (n,)."""
    common: Floats
    """Variance of the common error, (n,)."""
    mean: Floats
    """Weighted mean of the terms, (n, 3)."""
    bias: Floats
    """Weighted mean of the biases, (n, 3)."""
    normal: Floats
    """Normal matrix about the means, (n, 3, 3)."""
    right: Floats
    """Right-hand side about the means, (n, 3, 3)."""
    first: Floats
    """Terms of the first node, (n, 3)."""
    first_bias: Floats
    first_variance: Floats
    change: Floats
    """Terms of the last node less those of the first, (n, 3)."""
    change_bias: Floats
    change_variance: Floats

    @classmethod
    def of(cls, power_ups: Sequence[PowerUpNodes], lag_s: float, in_run_variance: float) -> _Sums:
        rows = []
        for one in power_ups:
            terms = _terms(np.array([node.degc - lag_s * node.k_s for node in one.nodes]))
            bias = np.array([node.bias for node in one.nodes])
            variance = np.array([node.variance for node in one.nodes]) + in_run_variance
            share = 1.0 / variance
            total = float(share.sum())
            mean, mean_bias = share @ terms / total, share @ bias / total
            about = (terms - mean) * share[:, None]
            rows.append((
                1.0 / total, one.common_variance, mean, mean_bias,
                about.T @ (terms - mean), about.T @ (bias - mean_bias), terms[0], bias[0], variance[0],
                terms[-1] - terms[0], bias[-1] - bias[0], variance[-1] + variance[0],
            ))  # fmt: skip
        return cls(lag_s, *(np.array(each) for each in zip(*rows, strict=True)))


class _Fit:
    """Fit of one order."""

    def __init__(self, sums: _Sums, order: int, in_run_variance: float, per_kelvin: float) -> None:
        some = slice(order)
        self._sums, self._order, self._in_run, self._per_kelvin = sums, order, in_run_variance, per_kelvin
        self._first, between = _with_one(sums.first[:, some]), _with_one(sums.mean[:, some])
        self._change = np.concatenate([np.zeros((len(sums.change), 1)), sums.change[:, some]], axis=1)
        self._squares = between[:, :, None] * between[:, None, :]
        self._products = between[:, :, None] * sums.bias[:, None, :]
        self._within, self._within_right = np.zeros_like(self._squares), np.zeros_like(self._products)
        self._within[:, 1:, 1:] = sums.normal[:, some][:, :, some]
        self._within_right[:, 1:] = sums.right[:, some]
        self._base = np.diag([0.0, *(1.0 / np.square(per_kelvin * _PRIOR_K[some]))])

    def curve(self, span_degc: tuple[float, float]) -> Curve:
        """Fit with the scatter at which the actual error of left-out power-ups matches the predicted one."""
        scatter = self._scatter()
        error, variance = self._foretold(scatter)
        shares, normal, right = self._equations(scatter)
        covariance = np.linalg.inv(self._base + normal.sum(axis=0))
        squares = np.mean(np.square(error), axis=0)
        # Three axes know the scatter better than one, but one may scatter more than the others.
        freedom = 3.0 * max(len(shares) - 1.0 - (self._order > 0), 1.0)
        student = freedom / (freedom - 2.0)
        widening = np.maximum(_over(error, variance), 1.0) * student
        said, of_changes = self._by_others(scatter, self._change)
        missed, noise = np.square(self._sums.change_bias - said), self._sums.change_variance[:, None]
        surely = float((missed - np.square(_SURELY) * (of_changes[:, None] + noise)).sum())
        changed = float(np.square(self._sums.change_bias).sum()) + float(noise.sum())
        by_chance = (1.0 + _SURELY * math.sqrt(2.0 / len(noise))) * noise
        more = (missed - by_chance).sum(axis=0) / max(float(of_changes.sum()), _LITTLE * float(noise.sum()))
        return Curve(
            order=self._order,
            lag_s=self._sums.lag_s,
            coefficients=covariance @ right.sum(axis=0),
            covariance=covariance,
            widening=widening,
            of_changes=np.maximum(more, 1.0) * student,
            unexplained=max(surely, 0.0) / changed,
            scatter=np.maximum((scatter + self._in_run) * widening, _AT_LEAST * np.maximum(squares, squares.mean())),
            foretold=float(squares.mean()),
            shares=shares / shares.sum(),
            freedom=freedom,
            span_degc=span_degc,
            per_kelvin=self._per_kelvin,
        )

    def _scatter(self) -> float:
        """Find the scatter with which the actual mean square of the prediction errors is the predicted one."""
        unit = math.log(self._per_kelvin**2)
        low, high = unit - _RANGE, unit + _RANGE
        for _ in range(_HALVINGS):
            middle = (low + high) / 2.0
            error, variance = self._foretold(math.exp(middle))
            if float(_over(error, variance).mean()) > 1.0:
                low = middle
            else:
                high = middle
        return math.exp(high)

    def _equations(self, scatter: float) -> tuple[Floats, Floats, Floats]:
        """Give the weights of the power-ups' means, and the normal equations of each."""
        u = 1.0 / (scatter + self._sums.variance + self._sums.common)
        return (
            u,
            self._within + u[:, None, None] * self._squares,
            self._within_right + u[:, None, None] * self._products,
        )

    def _foretold(self, scatter: float) -> tuple[Floats, Floats]:
        """Give each first node less its prediction by the other power-ups, (n, 3), and the variance of that, (n,)."""
        said, variance = self._by_others(scatter, self._first)
        return self._sums.first_bias - said, variance + self._sums.first_variance + scatter

    def _by_others(self, scatter: float, rows: Floats) -> tuple[Floats, Floats]:
        """Predict each power-up's row of terms from the other power-ups, (n, 3), and its variance, (n,)."""
        _, normal, right = self._equations(scatter)
        others = np.concatenate([rows[:, :, None], right.sum(axis=0) - right], axis=2)
        solved = rows[:, None, :] @ np.linalg.solve(self._base + normal.sum(axis=0) - normal, others)
        return solved[:, 0, 1:], solved[:, 0, 0]


def _over(error: Floats, variance: Floats) -> Floats:
    """Give the actual over the predicted mean square error of each axis, (3,)."""
    return np.asarray((error * error / variance[:, None]).sum(axis=0) / len(error))


def _terms(degc: Floats) -> Floats:
    """Give line, square and cube, (n, 3)."""
    d = (degc - REFERENCE_DEGC) / UNIT_K
    return np.stack([d, d**2, d**3], axis=1)


def _with_one(terms: Floats) -> Floats:
    return np.concatenate([np.ones((len(terms), 1)), terms], axis=1)
