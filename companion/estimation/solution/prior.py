"""Prediction of today's bias, with a sigma, from earlier calibrations (method.md section 3.3).

A MEMS bias scatters from run to run (an ADIS16405's by 70 deg/h and 2 mg, method.md section 1.3). The prediction for
today is the mean of the earlier power-ups, or their cubic over temperature (`curve`). The sigma is that of *one more*
power-up: the scatter, widened by Student's t for few points, and the error of the mean.

With three power-ups, the prediction is a gate for the readings (`joint`); with five, it can also count in the estimate.
Within one power-up, only temperature and drift change the bias. Another calibration in the same power-up is therefore
the best gate, but takes no part in the estimate.

An accelerometer's bias depends on the up vector u: f = (I + S) (I - [m x]) g u + b. Scale and shear S and misalignment
m (`align_model`) times 1 g look like a bias in one pose. A calibration finds this *effective* bias at u; at u' it is
larger by g (S - [m x]) (u' - u). A multi-pose alignment measures S and m; otherwise their priors apply (method.md
section 2.3: 0.5 % of scale make 5 mg).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Final, Literal

import msgspec
import numpy as np

from companion.config.sections import AllanModel
from companion.estimation.alignment.align_model import Priors
from companion.estimation.records.align_record import Determined, ImuAlignmentRecord
from companion.estimation.records.history import WEIGHS_FROM, Point, believed
from companion.estimation.records.record import Effective
from companion.estimation.solution.curve import CATALOGUE_PER_K, Curve, PowerUpNodes, WindowDrift, fit, in_run_variance
from companion.messages import message
from companion.physics.frames import Array, Floats, Matrix, skew, symmetric, vector
from companion.physics.statistics import student_quantile
from companion.physics.units import DEG, MG, G
from companion.samples import Triad, Vector

LEVEL: Final = np.array([0.0, 0.0, -1.0])
WORTH_SAYING_M_S2: Final = 1.0 * MG
"""Least effect of the attitude on an accelerometer bias for a warning; a wheel on a stone has a smaller effect."""
_SIGMAS: Final = 2.0
_PRIORS: Final = Priors()
GATE_SIGMAS: Final = 4.0
TEMPERATURE_SIGMA_K: Final = 10.0
"""Assumed temperature change between two calibrations of one power-up if there is no thermometer."""
_KNOWN: Final = 0.5
"""Largest sigma of a curve's slope, as a share of the catalogue's slope, at which the curve is used."""
_UNEXPLAINED: Final = 0.1
"""Largest share of the bias changes within power-ups that a usable curve leaves unexplained. With the IMU's own
thermometer it is 0.05 or less (except in one of some hundred simulated aircraft), with another one 0.1 to over 1."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class PoseEffect:
    """Scale, shear and misalignment of one IMU's accelerometers as matrices (3, 3): mean and one sigma per element."""

    mean: Matrix
    sigma: Matrix
    misalignment_mean: Matrix
    misalignment_sigma: Matrix
    source: Literal["assumed", "alignment"]

    def change(self, gravity_m_s2: float, at: Array, then: Array) -> tuple[Array, Array]:
        """Return the bias at up vector `at` minus that at `then`, and one sigma of the difference; (3,) each, m/s^2."""
        by = gravity_m_s2 * (at - then)
        variance = (np.square(self.sigma) + np.square(self.misalignment_sigma)) @ np.square(by)
        return (self.mean + self.misalignment_mean) @ by, np.sqrt(variance)

    def _variance(self, gravity_m_s2: float, by: Array) -> Array:
        """Return the variance (3,) that a change `by` of the up vector adds to the bias, without that of misalignment.

        The mean effect is known but not subtracted from the offsets to write, so its square is included.
        """
        return np.asarray((np.square(self.mean) + np.square(self.sigma)) @ np.square(gravity_m_s2 * by))

    def effective(self, gravity_m_s2: float, up: Array, sigma_use_m_s2: Array) -> Effective:
        """Make the record of sigma at other attitudes; `up` and `sigma_use_m_s2` (3,) belong to the calibration."""
        here = np.square(sigma_use_m_s2)
        scale = np.sqrt(np.diag(np.square(self.mean) + np.square(self.sigma)))
        return Effective(
            scale_from=self.source,
            scale_sigma_m_s2=vector(gravity_m_s2 * scale),
            level_sigma_m_s2=vector(np.sqrt(here + self._variance(gravity_m_s2, LEVEL - up))),
            sensor_sigma_m_s2=vector(np.sqrt(here + self._variance(gravity_m_s2, up))),
        )

    def warning(self, name: str, gravity_m_s2: float, up: Array, sigma_use_m_s2: Array) -> str | None:
        """Return a warning if the aircraft was tilted so far that its bias differs when level; otherwise None."""
        moves = np.sqrt(self._variance(gravity_m_s2, LEVEL - up))
        if not (moves > np.maximum(WORTH_SAYING_M_S2, _SIGMAS * sigma_use_m_s2)).any():
            return None
        return message("calibrated_tilted", imu=name, error=f"{moves.max() / MG:.1f}")


def pose_effect(aligned: ImuAlignmentRecord | None) -> PoseEffect:
    def known(found: Determined | None, unit: float, assumed: float) -> tuple[Array, Array]:
        if found is None:
            return np.zeros(3), np.full(3, assumed)
        known = np.array(found.known)
        return np.where(known, found.value, 0.0) * unit, np.where(known, np.array(found.sigma) * unit, assumed)

    scale, scale_sigma = known(aligned.accel_scale if aligned else None, 1.0, _PRIORS.scale)
    shear, shear_sigma = known(aligned.accel_shear if aligned else None, 1.0, _PRIORS.shear)
    turn, turn_sigma = known(aligned.misalignment_deg if aligned else None, DEG, _PRIORS.misalignment_deg * DEG)
    return PoseEffect(
        mean=np.diag(scale) + symmetric(shear),
        sigma=np.diag(scale_sigma) + symmetric(shear_sigma),
        misalignment_mean=-skew(turn),
        misalignment_sigma=symmetric(turn_sigma[::-1]),
        source="alignment" if aligned is not None and any(aligned.accel_scale.known) else "assumed",
    )


class Prediction(msgspec.Struct, frozen=True, kw_only=True):
    """Prediction of one triad's bias today, without autopilot offsets, in vehicle axes (FRD), rad/s or m/s^2.

    `variance` is that of today's bias about `value`, without the error of the gradienter's zero. `limit` is the gate in
    sigmas: 4; more, at the probability of 4, if few points determine the scatter. `same_zero` is the share of points
    measured with today's gradienter zero. The error of this zero is in prediction and measurement alike.
    `other_zero_rad` is one sigma of the error from other zeros.
    """

    value: Vector
    variance: Vector
    limit: float
    power_ups: int
    weighs: bool
    by_temperature: bool = False
    same_zero: float = 0.0
    other_zero_rad: float = 0.0


class ExpectedImu(msgspec.Struct, frozen=True, kw_only=True):
    """Predicted biases of one IMU: from `earlier` power-ups, and from this power-up (`today`)."""

    name: str
    earlier: dict[Triad, Prediction | None] = {}
    today: dict[Triad, Prediction | None] = {}
    along: dict[Triad, WindowDrift | None] = {}  # Prediction by the curve for a window in which the temperature changed
    effect: PoseEffect | None = None


class Expectation(msgspec.Struct, frozen=True, kw_only=True):
    """Predicted biases of all IMUs for one calibration."""

    imus: tuple[ExpectedImu, ...] = ()
    zero_is_known: bool = False
    """True if the sigma of the gradienter's zero was measured or configured; False if it is a cautious guess."""


_ASSUMED: Final = pose_effect(None)


def expect(
    points: Sequence[Point], triad: Triad, now: Point, effect: PoseEffect, model: AllanModel
) -> Prediction | None:
    """Predict today's bias, at attitude and temperature in `now`, from earlier power-ups; None: fewer than three."""
    groups = [
        group for group in believed(points, triad) if not any(point.power_up.is_same(now.power_up) for point in group)
    ]
    # If a temperature is missing, all points count as measured at the same one.
    known = None if now.temperature_degc is None else _states(groups)
    nodes, poses = [], []
    for group, states in zip(groups, known or [np.zeros((len(group), 2)) for group in groups], strict=True):
        bias, pose, white = _here(group, triad, now.up, effect)
        zero = group[-1].zero_sigma_rad * G if triad == "accel" else 0.0
        nodes.append(PowerUpNodes(states, bias, white, float(np.square(pose).mean()) + zero**2))
        poses.append(pose.mean(axis=0))
    curve = fit(nodes, in_run_variance(model), CATALOGUE_PER_K[triad])
    if curve is None:
        return None
    degc, k_s = (now.temperature_degc, now.k_s) if known and now.temperature_degc is not None else (0.0, 0.0)
    value, variance = curve.at(degc, k_s)
    # An error common to all power-ups, from the same attitude or place, does not average out.
    shared = [point.measured(triad).sigma_shared for group in groups for point in group]
    together = np.square(curve.shares @ np.array(poses)) + np.max(np.square(shared), axis=0)
    same, other = _zeros([group[-1] for group in groups], curve.shares, now.zero) if triad == "accel" else (0.0, 0.0)
    return Prediction(
        value=vector(value),
        variance=vector(variance + together),
        limit=student_quantile(GATE_SIGMAS, curve.freedom),
        power_ups=len(groups),
        weighs=len(groups) >= WEIGHS_FROM and curve.beyond_k(degc) == 0.0,
        by_temperature=curve.order > 0,
        same_zero=same,
        other_zero_rad=other,
    )


def expect_today(
    last: Point, triad: Triad, now: Point, effect: PoseEffect, model: AllanModel, curve: Curve | None = None
) -> Prediction | None:
    """Predict today's bias from the `last` calibration of this power-up; None: that one did not measure this triad.

    The `curve` predicts the bias change with temperature; without one, the catalogue's slope widens the sigma.
    """
    found = last.of(triad)
    if found is None:
        return None
    (bias,), (pose,), _ = _here([last], triad, now.up, effect)
    then_degc, now_degc = last.temperature_degc, now.temperature_degc
    kelvin = TEMPERATURE_SIGMA_K if then_degc is None or now_degc is None else now_degc - then_degc
    change, of_change = np.zeros(3), np.full(3, (CATALOGUE_PER_K[triad] * kelvin) ** 2)
    if curve is not None and then_degc is not None and now_degc is not None:
        change, of_change = curve.change((then_degc, last.k_s), (now_degc, now.k_s))
    variance = np.square([found.sigma_use, found.sigma_shared, pose]).sum(axis=0) + of_change
    same = triad == "accel" and last.zero == now.zero
    return Prediction(
        value=vector(bias + change),
        variance=vector(variance + in_run_variance(model, abs(now.unix_s - last.unix_s))),
        limit=GATE_SIGMAS,
        power_ups=1,
        weighs=False,
        same_zero=1.0 if same else 0.0,
        other_zero_rad=last.zero_sigma_rad if triad == "accel" and not same else 0.0,
    )


def curve_of(points: Sequence[Point], triad: Triad, model: AllanModel) -> Curve | None:
    """Fit the bias over temperature within a power-up; None: too few points, or the bias ignores the temperature.

    An accelerometer's variance grows with the change of attitude since the first point of the power-up.
    """
    groups = believed(points, triad)
    known = _states(groups)
    if len(groups) < WEIGHS_FROM or known is None:
        return None
    nodes = []
    for group, states in zip(groups, known, strict=True):
        bias, pose, white = _here(group, triad, group[0].up, _ASSUMED)
        nodes.append(PowerUpNodes(states, bias, white + np.square(pose).mean(axis=1)))
    curve = fit(nodes, in_run_variance(model), CATALOGUE_PER_K[triad], may_be_mean=False)
    assert curve is not None
    low, high = curve.span_degc
    _, of_kelvin = curve.change((low, 0.0), (low + 1.0, 0.0))
    is_known = high > low and of_kelvin.max() < (_KNOWN * CATALOGUE_PER_K[triad]) ** 2
    return curve if is_known and curve.unexplained < _UNEXPLAINED else None


def _states(groups: Sequence[Sequence[Point]]) -> list[Floats] | None:
    """Return temperature and rate of every point, one array (n, 2) per power-up; None: a temperature is unknown."""
    if any(point.temperature_degc is None for group in groups for point in group):
        return None
    return [np.array([(point.temperature_degc, point.k_s) for point in group], dtype=np.float64) for group in groups]


def _here(points: Sequence[Point], triad: Triad, up: Vector, effect: PoseEffect) -> tuple[Floats, Floats, Floats]:
    """Convert biases to the attitude `up`; also return the conversion's sigma, (n, 3), and the noise variance, (n,)."""
    found = [point.measured(triad) for point in points]
    bias, pose = np.array([one.bias for one in found]), np.zeros((len(points), 3))
    if triad == "accel":
        for k, point in enumerate(points):
            change, pose[k] = effect.change(G, np.array(up), np.array(point.up))
            bias[k] += change
    return bias, pose, np.square([one.sigma_stat for one in found]).mean(axis=1)


def _zeros(points: Sequence[Point], share: Floats, today: str | None) -> tuple[float, float]:
    shares = dict.fromkeys((point.zero for point in points), 0.0)
    for point, part in zip(points, share.tolist(), strict=True):
        shares[point.zero] += part
    sigmas = {point.zero: point.zero_sigma_rad for point in points}
    same = shares.pop(today, 0.0)
    return same, math.hypot(*(part * sigmas[zero] for zero, part in shares.items()), 0.0)
