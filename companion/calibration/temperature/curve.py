"""From still seconds of many power-ups to the bias of the next one, by temperature.

The bias of power-up s at the temperature T is

    o_s + c1 d + c2 d^2 + c3 d^3 + k dT/dt,    d = (T - 35 degC) / 20 K,

with an offset o_s of its own, scattered about a mean with the variance tau^2 (run to run), and one curve for all; k is
the lag of the die behind its thermometer, by which heating and cooling differ. Generalised least squares over the
means of still seconds at one temperature (`Node`): within a power-up its offset is free, between power-ups it is tau.
The coefficients have a prior as wide as the catalogue's parts move, so that a curve that has seen little is uncertain
where it has seen nothing.

Each power-up in turn is foretold by the others, at its first node: that decides how many terms there are, and tau is
such that those errors are as large as is said.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np

from companion.calibration.noise.allan import AllanModel
from companion.physics.frames import Array, Floats, Matrix
from companion.samples import Vector

REFERENCE_DEGC: Final = 35.0
UNIT_K: Final = 20.0
UNIT_K_S: Final = 1.0 / 60.0
"""Of the terms: 20 K, and a kelvin a minute."""
_LAG_K: Final = 0.5
"""The die is behind its thermometer by this at a kelvin a minute; one sigma."""
_ORDERS: Final = (0, 1, 2, 3)
FEWEST: Final = 3
"""Power-ups."""
_BETTER: Final = 0.9
"""Of the mean square of what is foretold: a term more must be worth it."""
_STEPS: Final = 40


class Node(msgspec.Struct, frozen=True, array_like=True):
    """The mean of still seconds of one power-up at about one temperature; vehicle FRD, rad/s or m/s^2."""

    degc: float
    k_s: float
    """How fast it rose meanwhile."""
    seconds: float
    bias: Vector
    group: int = 0
    """Nodes of one group have an offset in common: a power-up, or a stand where only changes were seen."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Sums:
    """Of every power-up, axis 0, for the largest model: what least squares need of its nodes."""

    weight: Floats
    mean: Floats
    """Weighted mean of the terms, (n, 4)."""
    bias: Floats
    """Weighted mean, (n, 3)."""
    normal: Floats
    """About the means, (n, 4, 4)."""
    right: Floats
    """(n, 4, 3)."""
    first: Floats
    """Terms of the first node, (n, 4)."""
    first_bias: Floats
    first_variance: Floats


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """What the next power-up's bias will be.

    Attributes:
        terms: of the model: 0 a mean, 1 a line and so on; from 1 on with the lag.
        coefficients: mean, then those of the terms, (1 + terms, 3).
        covariance: of these for an axis of the usual scatter, (1 + terms, 1 + terms).
        scatter: variance of one more power-up about the curve, what it wanders by itself included, (3,).
        error: mean square of what was foretold of power-ups left out, over all axes, rad^2/s^2 or m^2/s^4.
        power_ups: how many it is made of.
        span_degc: lowest and highest temperature seen.
    """

    terms: int
    coefficients: Matrix
    covariance: Matrix
    widening: Array
    scatter: Array
    error: float
    power_ups: int
    span_degc: tuple[float, float]

    def at(self, degc: float, k_s: float = 0.0) -> tuple[Array, Array]:
        """Bias of the next power-up at a temperature and its variance, (3,) each."""
        x = _with_one(_terms(np.array([degc]), np.array([k_s]))[:, _of_order(self.terms)])[0]
        return x @ self.coefficients, self.scatter + float(x @ self.covariance @ x) * self.widening

    def change(self, degc: float, then_degc: float) -> tuple[Array, Array]:
        """By how much the bias at `then_degc` is more than that at `degc`, in one power-up, and its variance."""
        x = np.diff(_terms(np.array([degc, then_degc]), np.zeros(2)), axis=0)[:, _of_order(self.terms)][0]
        return x @ self.coefficients[1:], float(x @ self.covariance[1:, 1:] @ x) * self.widening


def fit(power_ups: Sequence[Sequence[Node]], noise: AllanModel, per_kelvin: float) -> Curve | None:
    """The curve of one triad of one IMU; None of fewer than three power-ups.

    Args:
        power_ups: the nodes of each, in the order in which they were measured.
        noise: of the triad.
        per_kelvin: one sigma of how much parts move, rad/s or m/s^2 a kelvin.
    """
    if len(power_ups) < FEWEST:
        return None
    sums = _summed(power_ups, noise)
    span = [node.degc for nodes in power_ups for node in nodes]
    best: Curve | None = None
    for order in _ORDERS:
        found = _fitted(sums, order, noise, per_kelvin, (min(span), max(span)))
        if best is None or found.error < _BETTER * best.error:
            best = found
    return best


def _fitted(sums: _Sums, order: int, noise: AllanModel, per_kelvin: float, span_degc: tuple[float, float]) -> Curve:
    some = _of_order(order)
    prior = _prior(per_kelvin)[some]
    count = len(sums.weight)
    first = _with_one(sums.first[:, some])
    between = _with_one(sums.mean[:, some])
    squares = between[:, :, None] * between[:, None, :]
    products = between[:, :, None] * sums.bias[:, None, :]
    within = np.zeros_like(squares)
    within[:, 1:, 1:] = sums.normal[:, some][:, :, some]
    within_right = np.zeros_like(products)
    within_right[:, 1:] = sums.right[:, some]
    base = np.diag([0.0, *(1.0 / np.square(prior))])

    def normal(tau2: float) -> tuple[Floats, Floats]:
        u = 1.0 / (tau2 + 1.0 / sums.weight)
        return within + u[:, None, None] * squares, within_right + u[:, None, None] * products

    def foretold(tau2: float) -> tuple[Floats, Floats]:
        """Errors (n, 3) and their variance (n,)."""
        a, r = normal(tau2)
        inverse = np.linalg.inv(base + a.sum(axis=0) - a)
        solved = inverse @ (r.sum(axis=0) - r)
        error = sums.first_bias - np.einsum("ij,ijk->ik", first, solved)
        return error, tau2 + sums.first_variance + np.einsum("ij,ijk,ik->i", first, inverse, first)

    low, high = math.log(1e-6 * per_kelvin**2), math.log(1e6 * per_kelvin**2)
    for _ in range(_STEPS):
        middle = (low + high) / 2.0
        error, variance = foretold(math.exp(middle))
        if float(np.mean(np.square(error) / variance[:, None])) > 1.0:
            low = middle
        else:
            high = middle
    tau2 = math.exp(high)
    error, variance = foretold(tau2)
    a, r = normal(tau2)
    covariance = np.linalg.inv(base + a.sum(axis=0))
    # Three axes know the scatter better than one, but one may scatter more than the others.
    freedom = 3.0 * (count - 1.0)
    student = freedom / (freedom - 2.0)
    widening = np.maximum(np.mean(np.square(error) / variance[:, None], axis=0), 1.0) * student
    return Curve(
        terms=order,
        coefficients=covariance @ r.sum(axis=0),
        covariance=covariance,
        widening=widening,
        scatter=tau2 * widening + noise.flicker**2,
        error=float(np.mean(np.square(error))),
        power_ups=count,
        span_degc=span_degc,
    )


def _summed(power_ups: Sequence[Sequence[Node]], noise: AllanModel) -> _Sums:
    found = [_summed_one(nodes, noise) for nodes in power_ups]
    return _Sums(*(np.array(each) for each in zip(*found, strict=True)))


def _summed_one(nodes: Sequence[Node], noise: AllanModel) -> tuple[float | Floats, ...]:
    terms = _terms(np.array([node.degc for node in nodes]), np.array([node.k_s for node in nodes]))
    bias = np.array([node.bias for node in nodes])
    seconds = np.array([node.seconds for node in nodes])
    variance = noise.white**2 / seconds + noise.flicker**2
    weight = 1.0 / variance
    total = float(weight.sum())
    mean, mean_bias = weight @ terms / total, weight @ bias / total
    about = (terms - mean) * weight[:, None]
    return (
        total,
        mean,
        mean_bias,
        about.T @ (terms - mean),
        about.T @ (bias - mean_bias),
        terms[0],
        bias[0],
        variance[0],
    )


def _terms(degc: Floats, k_s: Floats) -> Floats:
    """Lag, line, square, cubic; (n, 4)."""
    d = (degc - REFERENCE_DEGC) / UNIT_K
    return np.stack([k_s / UNIT_K_S, d, d**2, d**3], axis=1)


def _of_order(order: int) -> slice:
    return slice(0, 1 + order if order else 0)


def _prior(per_kelvin: float) -> Floats:
    """One sigma of each coefficient."""
    return per_kelvin * np.array([_LAG_K, UNIT_K, UNIT_K / 2.0, UNIT_K / 4.0])


def _with_one(terms: Floats) -> Floats:
    return np.concatenate([np.ones((len(terms), 1)), terms], axis=1)
