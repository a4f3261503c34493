"""Prediction, with its uncertainty, of the time until a warm-up no longer matters.

The temperature of a board that was switched on approaches its end as

    y(t) = e - a exp(-t / tau) - sum_i b_i exp(-t / c_i),

where the sum is the quicker warming of the chip within the board, with fixed time constants c_i. For each tau of a
grid, e, a and b are a linear least-squares problem with a Gaussian posterior; the misfit and the prior weight the grid.
The prior of tau comes from the board's earlier warm-ups, or covers all boards. The times at which y comes within a
limit of its end then have a distribution, whose central 90 % are returned.

A heater's control holds the board at its target: with one, y has to come within the limit of the target.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import takewhile
from typing import Final, NamedTuple

import numpy as np

from companion.estimation.noise.allan import WARM_UP_K
from companion.physics.frames import Array
from companion.samples import Vector

_FEWEST: Final = 6  # Least number of temperatures from which an end is predicted
_TAU_S: Final = (268.0, 201.0)  # Time constant of any board and one sigma; two in its logarithm are 1 to 20 min
_GRID: Final = np.linspace(-2.5, 2.5, 201)  # Logarithm of tau, in sigmas of its prior
_CHIP_S: Final = np.array([12.0, 25.0, 50.0])  # Time constants of a chip within its board
_CHIP_K: Final = WARM_UP_K / 8.0  # One sigma of the chip's own warming with each of these time constants
_RISE_K: Final = (0.5 * WARM_UP_K, 0.75 * WARM_UP_K)  # Prior mean and sigma of the rise
_HEATED_K: Final = (2.0 * WARM_UP_K, 2.0 * WARM_UP_K)  # At full power of a heater, which never reaches its end
_SIGMA_K: Final = 0.016  # Least sigma of a mean temperature, of a thermometer with 0.05 K; a larger misfit replaces it
_SURELY: Final = 3.0  # Threshold in sigmas above which a change is not chance
_NODES: Final = np.array([-2.8569700, -1.3556262, 0.0, 1.3556262, 2.8569700])  # Gauss-Hermite, for a normal density
_WEIGHTS: Final = np.array([0.0112574, 0.2220759, 0.5333333, 0.2220759, 0.0112574])
_DISTANCES_K: Final[list[float]] = np.geomspace(0.05, 20.0, 60).tolist()
Drift = Callable[[float, float], tuple[Vector, Vector] | None]


class UntilSteady(NamedTuple):
    """90 % interval of the time from the last temperature until steady, s; `k_s`: present rate, K/s."""

    low_s: float
    high_s: float
    k_s: float

    @property
    def figure_s(self) -> tuple[float, float] | None:
        """Middle and half-width of the interval, s; None: too wide for a figure within a factor of 1.5."""
        middle_s, half_s = (self.high_s + self.low_s) / 2.0, (self.high_s - self.low_s) / 2.0
        return (middle_s, half_s) if half_s <= middle_s / 3.0 else None

    def later(self, seconds: float) -> UntilSteady:
        return UntilSteady(max(self.low_s - seconds, 0.0), max(self.high_s - seconds, 0.0), self.k_s)


def until_steady(
    times_s: Array,
    degc: Array,
    limit: Callable[[float], float],
    *,
    tau_s: tuple[float, float] | None = None,
    target: float | None = None,
) -> UntilSteady | None:
    """Predict when a warm-up comes within a limit of its end; None: it more likely has, or too short a history.

    Args:
        times_s: increasing times of the temperatures.
        degc: temperatures, means of ten seconds.
        limit: maps the predicted end to the largest distance from it that does not matter, K.
        tau_s: time constant of this board and one sigma, s, from earlier warm-ups; None: unknown.
        target: temperature at which a heater holds the board; None: no heater.
    """
    if len(times_s) < _FEWEST:
        return None
    since, origin, side = times_s - times_s[0], float(degc[-1]), 1.0 if degc[-1] >= degc[0] else -1.0
    usual_s, sigma_s = tau_s or _TAU_S
    tau = usual_s * np.exp(sigma_s / usual_s * _GRID)
    rise, sigma_k, share = _fit(since, side * (degc - origin), tau, _RISE_K if target is None else _HEATED_K)
    if (rise / sigma_k)[share.argmax()] < _SURELY:
        return None
    # Distance from the end at the last temperature, for each tau and node.
    left_k = np.exp(-since[-1] / tau)[:, None] * (rise[:, None] + sigma_k[:, None] * _NODES)
    share = share[:, None] * _WEIGHTS
    needed_k = left_k if target is None else np.minimum(left_k, side * (target - origin))
    within_k = left_k - needed_k + limit(origin + side * float((share * needed_k).sum()))
    seconds = np.log(np.maximum(left_k / within_k, 1.0)) * tau[:, None]
    k_s = side * float((share * left_k / tau[:, None]).sum())
    order = np.argsort(seconds, axis=None)
    shares = np.searchsorted(np.cumsum(share.ravel()[order]), (0.05, 0.5, 0.95))
    low_s, middle_s, high_s = seconds.ravel()[order[shares]].tolist()
    return UntilSteady(low_s, high_s, k_s) if middle_s > 0.0 else None


def lasting_k(drift: Drift, end_degc: float, allowed: float, otherwise_k: float) -> float:
    """Return the distance from the end of a warm-up, K, from which the bias moves by no more than `allowed`.

    `drift` predicts the bias change between two temperatures, and its variance; if it returns None: `otherwise_k`.
    """

    def lasts(kelvin: float) -> bool:
        found = drift(end_degc - kelvin, end_degc)
        return found is not None and all(m**2 + variance <= allowed**2 for m, variance in zip(*found, strict=True))

    return max(takewhile(lasts, _DISTANCES_K), default=_DISTANCES_K[0]) if drift(end_degc, end_degc) else otherwise_k


def _fit(since: Array, y: Array, tau: Array, rise_k: tuple[float, float]) -> tuple[Array, Array, Array]:
    """Return, for each tau (grid,), the rise `a` at `since` 0, its sigma, K, and the posterior weight of tau."""
    slow = np.exp(-since / tau[:, None])
    chip = np.broadcast_to(np.exp(-since[:, None] / _CHIP_S), (*slow.shape, len(_CHIP_S)))
    design = np.concatenate((np.ones_like(slow)[..., None], -slow[..., None], -chip), axis=-1)
    usual = np.array([0.0, rise_k[0], *np.zeros(len(_CHIP_S))])
    prior = np.diag([1e-12, 1.0 / rise_k[1] ** 2, *np.full(len(_CHIP_S), 1.0 / _CHIP_K**2)])
    normal, right = np.swapaxes(design, 1, 2) @ design, np.swapaxes(design, 1, 2) @ y

    def solve(variance: float) -> tuple[Array, Array, Array]:
        covariance = np.linalg.inv(normal / variance + prior)
        mean = (covariance @ (right / variance + prior @ usual)[..., None])[..., 0]
        return mean, covariance, np.square(y - (design @ mean[..., None])[..., 0]).sum(axis=1)

    variance = max(_SIGMA_K**2, float(solve(_SIGMA_K**2)[2].min()) / max(len(y) - 2, 1))
    mean, covariance, misfit = solve(variance)
    logs = np.linalg.slogdet(covariance)[1] - misfit / variance - np.square(_GRID)
    logs -= np.square(mean - usual) @ prior.diagonal()
    weight = np.exp((logs - logs.max()) / 2.0)
    return mean[:, 1], np.sqrt(covariance[:, 1, 1]), weight / weight.sum()
