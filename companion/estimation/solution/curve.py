"""Model of one sensor triad's bias over temperature, fitted to measurements of several power-ups.

The bias in power-up s at the temperature T is

    o_s + c1 d + c2 d^2 + c3 d^3,    d = (T - lag dT/dt - 35 degC) / 20 K.

Each power-up has an offset o_s of its own, scattered about a mean with the variance tau^2 (run to run). The cubic is
common to all. The die is as warm as its thermometer was `lag` seconds earlier, so heating and cooling differ. The fit
is generalised least squares over means of motionless seconds at one temperature. The prior of the coefficients is as
wide as catalogue slopes, so the model is uncertain at temperatures without data.

Each power-up's first mean is predicted from the other power-ups. The errors select the lag and the order (cubic or
mean), and scale tau until predicted and actual errors match. The change from a power-up's first mean to its last is
also predicted. The error of this change scales the uncertainty of changes, and reveals a thermometer outside the IMU.

The present rate dT/dt predicts the end of a warm-up. A board that warms towards its end as 1 - exp(-t / tau_s)
has tau_s dT/dt left to warm, at any air temperature. Earlier power-ups determine the time constant tau_s.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import msgspec
import numpy as np

from companion.config.sections import AllanModel
from companion.estimation.means.warming import Path, State
from companion.estimation.noise.allan import floor_variance
from companion.physics.frames import Array, Floats, Matrix, vector
from companion.physics.statistics import MAD_TO_SIGMA
from companion.physics.units import DEG_H, MG
from companion.samples import Triad, Vector

REFERENCE_DEGC: Final = 35.0
UNIT_K: Final = 20.0
LAGS_S: Final = (0.0, 10.0, 20.0, 30.0)
VALID_K: Final = 3.0
"""Distance beyond the measured temperatures up to which the model counts as valid, K (method.md section 3.3)."""
FEWEST: Final = 3
_CUBIC: Final = 3
_BETTER: Final = 0.9
"""A cubic replaces a constant mean if the cubic's mean square error is below this share of the mean's."""
_AT_LEAST: Final = 0.5
"""Least run-to-run variance, as a share of the mean square prediction error; overstated noise would hide more of it."""
_RANGE: Final = 18.0
"""Half the search range for the log of the run-to-run variance; the centre is the log of squared bias change per K."""
_HALVINGS: Final = 25
_SURELY: Final = 2.0  # Threshold in sigmas above which an error is not chance
_LITTLE: Final = 1e-6
"""Least in-run variance over the squared bias change per kelvin; least predicted variance over the noise variance."""
_PRIOR_K: Final = np.array([UNIT_K, UNIT_K / 2.0, UNIT_K / 4.0])
"""Prior sigmas of the coefficients c1, c2 and c3, each divided by a sensor's usual bias change per kelvin."""
_SLOWED_K_S: Final = 0.25 / 60.0  # Least decrease of the rate that determines the end of a warm-up
_TAU_SIGMA: Final = 0.05
"""Least relative sigma of a board's thermal time constant, because one constant does not fully describe a board."""
_WARM_AFTER: Final = 5.0  # Time constants after which a board is warm
_IN_RUN_MEAN_S: Final = 30.0
_SHORTEST_GAP_S: Final = 180.0
_END_LESS_MEAN: Final = (-1.0 / 6.0, -4.0 / 6.0, 5.0 / 6.0)
"""Simpson weights for a window's start, middle and end; the weighted sum is the end value minus the window's mean."""
CATALOGUE_SCATTER: Final[dict[Triad, float]] = {"gyro": 70.0 * DEG_H, "accel": 2.0 * MG}
"""Run-to-run scatter of biases, one sigma, as in an ADIS16405 (method.md section 1.3)."""
CATALOGUE_PER_K: Final[dict[Triad, float]] = {"gyro": 54.0 * DEG_H, "accel": 0.2 * MG}
"""Bias change per kelvin of a BMI088, the worse sensor model in method.md section 2.1."""


class PowerUpNodes(NamedTuple):
    """Means of motionless seconds in one power-up, n rows, in vehicle axes (FRD), rad/s or m/s^2.

    `states` (n, 2): temperature in degC and its rate in K/s. `variance` (n,): of the white noise, averaged over axes.
    """

    states: Floats
    bias: Floats
    variance: Floats
    common_variance: float = 0.0
    """Variance of an error common to all rows of this power-up; it lowers the weight of the power-up in the fit."""


class Warm(msgspec.Struct, frozen=True, kw_only=True):
    """Predicted bias change from a window's end until the board is warm, in vehicle axes (FRD), rad/s or m/s^2."""

    degc: float
    change: Vector
    variance: Vector


class WindowDrift(msgspec.Struct, frozen=True, kw_only=True):
    """Predicted bias change of one triad within a window, in vehicle axes (FRD), rad/s or m/s^2; slopes are per second.

    `shift` is the bias at the window's end minus its mean over the window. `warm` is None if the temperature at the end
    of the warm-up is unknown, or beyond the measured temperatures.
    """

    shift: Vector
    shift_variance: Vector
    slope: Vector
    slope_variance: Vector
    warm: Warm | None = None


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Model of the next power-up's bias over temperature, in vehicle axes (FRD), rad/s or m/s^2.

    `order` is 0 for a constant mean, 3 for a cubic. `covariance` is the coefficients' for an axis with usual scatter.
    Factors on it: `widening` (3,) by axis, `of_changes` (3,) for bias changes within a power-up. `unexplained` is the
    share of these squared changes that neither model nor chance explains. `scatter` (3,) is the variance of the next
    power-up's bias about the model, including the wander within that power-up.
    """

    order: int
    lag_s: float
    coefficients: Matrix
    covariance: Matrix
    widening: Array
    of_changes: Array
    unexplained: float
    scatter: Array
    mean_square_error: float
    shares: Array
    freedom: float
    span_degc: tuple[float, float]
    per_kelvin: float  # One sigma of the change per kelvin beyond the temperatures seen

    def beyond_k(self, degc: float) -> float:
        return max(self.span_degc[0] - VALID_K - degc, degc - self.span_degc[1] - VALID_K, 0.0)

    def at(self, degc: float, k_s: float = 0.0) -> tuple[Array, Array]:
        """Predict the next power-up's bias (3,) at a temperature, and its variance (3,); extrapolate linearly."""
        x, (low, high) = self._row(degc, k_s), self.span_degc
        moved = float(np.abs((self._row(high) - self._row(low)) @ self.coefficients).max())
        outside = (max(self.per_kelvin, moved / max(high - low, VALID_K)) * self.beyond_k(degc)) ** 2
        return x @ self.coefficients, self.scatter + float(x @ self.covariance @ x) * self.widening + outside

    def change(self, then: State, now: State) -> tuple[Array, Array]:
        """Predict the bias change (3,) between two temperatures (with rates) of a power-up, and its variance (3,)."""
        return self.moves([(-1.0, then), (1.0, now)])

    def moves(self, weighted: Iterable[tuple[float, State]]) -> tuple[Array, Array]:
        """Predict a weighted sum (3,) of biases at several temperatures, and its variance (3,); weights sum to zero."""
        x, outside_k = np.zeros(self.order + 1), 0.0
        for weight, (degc, k_s) in weighted:
            side = 1.0 if degc > self.span_degc[1] else -1.0
            x, outside_k = x + weight * self._row(degc, k_s), outside_k + weight * side * self.beyond_k(degc)
        x[0] = 0.0
        variance = float(x @ self.covariance @ x) * self.of_changes + (self.per_kelvin * outside_k) ** 2
        return x @ self.coefficients, variance

    def along(self, path: Path, tau_s: tuple[float, float] | None, model: AllanModel) -> WindowDrift:
        """Predict the bias change within a window; `tau_s`: time constant of the board and one sigma; None: unknown."""
        start, (middle_degc, k_s), end = path.states
        shift, shift_variance = self.moves(zip(_END_LESS_MEAN, path.states, strict=True))
        slope, slope_variance = self.change(start, end)
        by_end = np.square(self._per_k(end[0])) * path.variance
        # A line changes by half of its range from its middle to its end.
        of_rate = (2.0 / path.span_s) ** 2
        warm = None
        if tau_s is not None and self.beyond_k(degc := middle_degc + tau_s[0] * k_s) == 0.0:
            change, variance = self.change(end, (degc, 0.0))
            of_degc = (tau_s[1] * k_s) ** 2 + tau_s[0] ** 2 * path.variance * of_rate
            wander = in_run_variance(model, _WARM_AFTER * tau_s[0])
            variance = variance + wander + np.square(self._per_k(degc)) * of_degc
            warm = Warm(degc=degc, change=vector(change), variance=vector(variance))
        return WindowDrift(
            shift=vector(shift),
            shift_variance=vector(shift_variance + by_end),
            slope=vector(slope / path.span_s),
            slope_variance=vector(slope_variance / path.span_s**2 + by_end * of_rate),
            warm=warm,
        )

    def _per_k(self, degc: float) -> Array:
        return self.change((degc - 0.5, 0.0), (degc + 0.5, 0.0))[0]

    def _row(self, degc: float, k_s: float = 0.0) -> Array:
        """Return the polynomial's terms (1 + order,) at a temperature and its rate; linear outside the valid range."""
        die_degc = degc - self.lag_s * k_s
        edge_degc = min(max(die_degc, self.span_degc[0] - VALID_K), self.span_degc[1] + VALID_K)
        d, power = (edge_degc - REFERENCE_DEGC) / UNIT_K, np.arange(self.order + 1)
        straight_on = power * d ** np.maximum(power - 1, 0) * (die_degc - edge_degc) / UNIT_K
        return np.asarray(d**power + straight_on)


def settling(power_ups: Iterable[Sequence[State]]) -> tuple[float, float] | None:
    """Estimate a board's thermal time constant and one sigma, s, from three or more earlier warm-ups; else None.

    From its fastest warming to its last state, a board warms by the time constant times the decrease of the rate.
    """
    found = []
    for states in power_ups:
        steepest, last = max(states, key=lambda state: state[1]), states[-1]
        slowed = steepest[1] - last[1]
        if slowed > _SLOWED_K_S and last[0] > steepest[0]:
            found.append((last[0] - steepest[0]) / slowed)
    if len(found) < FEWEST:
        return None
    tau = float(np.median(found))
    scatter = MAD_TO_SIGMA * float(np.median(np.abs(np.subtract(found, tau))))
    return tau, math.hypot(scatter, _TAU_SIGMA * tau)


def in_run_variance(model: AllanModel, gap_s: float = 0.0) -> float:
    """Return the variance of a bias' wander within a power-up over `gap_s`, but at least over three minutes."""
    return float(floor_variance(model.flicker, model.walk, _IN_RUN_MEAN_S, 2.0 * max(gap_s, _SHORTEST_GAP_S)))


def fit(
    power_ups: Sequence[PowerUpNodes],
    in_run_variance: float,
    per_kelvin: float,
    *,
    may_be_mean: bool = True,
) -> Curve | None:
    """Fit the bias over temperature of one triad of one IMU; return None for fewer than three power-ups.

    Args:
        power_ups: in order of measurement, at least one row each.
        in_run_variance: variance of the bias' wander within a power-up, (rad/s)^2 or (m/s^2)^2.
        per_kelvin: one sigma of a sensor's bias change per kelvin, rad/s or m/s^2.
        may_be_mean: return a mean if it predicts equally well; a mean predicts no change within a power-up.
    """
    if len(power_ups) < FEWEST:
        return None
    degc, k_s = np.concatenate([one.states for one in power_ups]).T
    span = float(degc.min()), float(degc.max())
    in_run_variance = max(in_run_variance, _LITTLE * per_kelvin**2)
    mean = _Fit(power_ups, 0, 0.0, in_run_variance, per_kelvin).curve(span) if may_be_mean else None
    if mean is not None and span[0] == span[1]:
        return mean
    lags_s = LAGS_S if k_s.any() else LAGS_S[:1]
    curves = (_Fit(power_ups, _CUBIC, lag_s, in_run_variance, per_kelvin).curve(span) for lag_s in lags_s)
    curve = min(curves, key=lambda one: one.mean_square_error)
    return curve if mean is None or curve.mean_square_error < _BETTER * mean.mean_square_error else mean


class _Fit:
    """Least-squares fit for one polynomial order and one thermometer lag; arrays have one row per power-up."""

    def __init__(
        self, power_ups: Sequence[PowerUpNodes], order: int, lag_s: float, in_run_variance: float, per_kelvin: float
    ) -> None:
        self._order, self._lag_s, self._in_run, self._per_kelvin = order, lag_s, in_run_variance, per_kelvin
        self._base = np.diag([0.0, *(1.0 / np.square(per_kelvin * _PRIOR_K[:order]))])
        rows = []
        for one in power_ups:
            degc = one.states[:, 0] - lag_s * one.states[:, 1]
            terms = ((degc - REFERENCE_DEGC) / UNIT_K)[:, None] ** np.arange(order + 1)
            bias, variance = one.bias, one.variance + in_run_variance
            share = 1.0 / variance
            mean, mean_bias = share @ terms / share.sum(), share @ bias / share.sum()
            about = (terms - mean) * share[:, None]
            rows.append((
                1.0 / share.sum() + one.common_variance, np.outer(mean, mean), np.outer(mean, mean_bias),
                about.T @ (terms - mean), about.T @ (bias - mean_bias), terms[0], bias[0], variance[0],
                terms[-1] - terms[0], bias[-1] - bias[0], variance[-1] + variance[0],
            ))  # fmt: skip
        (
            self._variance, self._between, self._between_right, self._within, self._within_right,
            self._first, self._first_bias, self._first_variance,
            self._change, self._change_bias, self._change_variance,
        ) = (np.array(each) for each in zip(*rows, strict=True))  # fmt: skip

    def curve(self, span_degc: tuple[float, float]) -> Curve:
        """Fit with that run-to-run variance at which the errors for left-out power-ups are as large as predicted."""
        scatter = self._scatter()
        error, variance = self._left_out(scatter)
        shares, normal, right = self._equations(scatter)
        covariance = np.linalg.inv(self._base + normal.sum(axis=0))
        squares = np.mean(np.square(error), axis=0)
        # Three axes together determine the scatter better, but one may scatter more than the others.
        freedom = 3.0 * max(len(shares) - 1.0 - (self._order > 0), 1.0)
        student = freedom / (freedom - 2.0)
        widening = np.maximum(_over(error, variance), 1.0) * student
        predicted, of_changes = self._by_others(scatter, self._change)
        missed, noise = np.square(self._change_bias - predicted), self._change_variance[:, None]
        surely = float((missed - np.square(_SURELY) * (of_changes[:, None] + noise)).sum())
        changed = float(np.square(self._change_bias).sum()) + float(noise.sum())
        by_chance = (1.0 + _SURELY * math.sqrt(2.0 / len(noise))) * noise
        more = (missed - by_chance).sum(axis=0) / max(float(of_changes.sum()), _LITTLE * float(noise.sum()))
        return Curve(
            order=self._order,
            lag_s=self._lag_s,
            coefficients=covariance @ right.sum(axis=0),
            covariance=covariance,
            widening=widening,
            of_changes=np.maximum(more, 1.0) * student,
            unexplained=max(surely, 0.0) / changed,
            scatter=np.maximum((scatter + self._in_run) * widening, _AT_LEAST * np.maximum(squares, squares.mean())),
            mean_square_error=float(squares.mean()),
            shares=shares / shares.sum(),
            freedom=freedom,
            span_degc=span_degc,
            per_kelvin=self._per_kelvin,
        )

    def _scatter(self) -> float:
        unit = math.log(self._per_kelvin**2)
        low, high = unit - _RANGE, unit + _RANGE
        for _ in range(_HALVINGS):
            middle = (low + high) / 2.0
            if float(_over(*self._left_out(math.exp(middle))).mean()) > 1.0:
                low = middle
            else:
                high = middle
        return math.exp(high)

    def _equations(self, scatter: float) -> tuple[Floats, Floats, Floats]:
        weight = 1.0 / (scatter + self._variance)
        by = weight[:, None, None]
        return weight, self._within + by * self._between, self._within_right + by * self._between_right

    def _left_out(self, scatter: float) -> tuple[Floats, Floats]:
        """Return each power-up's first mean minus its prediction from the others, (n, 3), and the variance, (n,)."""
        predicted, variance = self._by_others(scatter, self._first)
        return self._first_bias - predicted, variance + self._first_variance + scatter

    def _by_others(self, scatter: float, rows: Floats) -> tuple[Floats, Floats]:
        """Return each power-up's bias, predicted from all others, (n, 3), and the predictions' variance (n,)."""
        _, normal, right = self._equations(scatter)
        others = np.concatenate([rows[:, :, None], right.sum(axis=0) - right], axis=2)
        solved = rows[:, None, :] @ np.linalg.solve(self._base + normal.sum(axis=0) - normal, others)
        return solved[:, 0, 1:], solved[:, 0, 0]


def _over(error: Floats, variance: Floats) -> Floats:
    """Return the ratio of the actual to the predicted mean square error for each axis, (3,)."""
    return np.asarray((error * error / variance[:, None]).sum(axis=0) / len(error))


# --- in firmwares

ZERO: Vector = (0.0, 0.0, 0.0)


class Polynomial(msgspec.Struct, frozen=True, kw_only=True):
    """Bias over temperature as a polynomial, in the form that autopilot firmwares use, in an IMU's own axes.

    The bias is c0 + c1 d + c2 d^2 + c3 d^3; d is the temperature, limited to the span, minus the reference temperature.
    """

    coefficients: tuple[Vector, Vector, Vector, Vector] = (ZERO, ZERO, ZERO, ZERO)
    """Coefficients c0 to c3 of three axes each, in rad/s or m/s^2 per kelvin to the power of 0 to 3."""
    reference_degc: float = REFERENCE_DEGC
    low_degc: float = -math.inf
    high_degc: float = math.inf

    def at(self, degc: float) -> Array:
        d = min(max(degc, self.low_degc), self.high_degc) - self.reference_degc
        c0, c1, c2, c3 = np.array(self.coefficients)
        value: Array = c0 + (c1 + (c2 + c3 * d) * d) * d
        return value

    def zero_at(self, degc: float) -> Polynomial:
        """Return the polynomial shifted by a constant, so that the bias is zero at this temperature."""
        c0, first, second, third = self.coefficients
        constant = vector(np.subtract(c0, self.at(degc)))
        return msgspec.structs.replace(self, coefficients=(constant, first, second, third))


NOTHING: Final = Polynomial()


def of_curve(curve: Curve, orientation: Matrix, scale: Vector = (1.0, 1.0, 1.0)) -> Polynomial:
    """Convert a curve to a firmware's polynomial over the measured temperatures, zero at the reference temperature.

    The thermometer's lag is left out, because no firmware supports one.

    Args:
        curve: in vehicle axes.
        orientation: rotation from the IMU's axes to the vehicle's, 3x3.
        scale: factor by which the firmware multiplies the IMU's output after the temperature correction.
    """
    low, high = curve.span_degc
    terms = np.zeros((4, 3))
    found = curve.coefficients[1:]
    terms[1 : 1 + len(found)] = found @ orientation / scale / UNIT_K ** np.arange(1.0, 1.0 + len(found))[:, None]
    _, first, second, third = map(vector, terms)
    return Polynomial(coefficients=(ZERO, first, second, third), low_degc=low, high_degc=high)
