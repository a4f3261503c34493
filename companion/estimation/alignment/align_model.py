"""Model of all poses for `align`, and the least-squares fit that every alignment uses.

A *stand* in the code is the time without motion that was measured in one pose. The fit estimates the gradienter's zero,
and for every IMU its misalignment, accelerometer scale, shear and bias, and gyro bias. It also estimates gravity and
the Earth's rate within the uncertainty of the place, the plane of the ground, and the attitude C_k in each pose k.

Here u = C_k (0, 0, -1) is up in the vehicle's axes, and g is gravity. W is the Earth's rate in the ground frame, which
is NED, or NED turned about the vertical if north is unknown.

    gradienter     reading = law(M^T u) + zero                          M: vehicle from sensor
    accelerometer  f = (I + S) exp(-[m x]) g u + b                      S: scale on the diagonal, shear beside it
    gyro           w = C_k W + b_w
    compass        heading of C_k
    turn           (1 + s) times the turn of C_k since the last pose, about the vehicle's z      s: a gyro's scale
    spot           down of the vehicle, in the ground frame, is the normal n of the ground: C_k^T z = n + placement

The last line is the level reversal (method.md section 3.4): the ground's true tilt is the same in the ground frame,
however the aircraft is turned on it. "Level" means parallel to the plane of the ground at the marked place. An attitude
error eps gives C = exp(-[eps x]) C_0, with C_0 the first guess.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Final, Literal

import numpy as np

from companion.estimation.means.windows import ImuWindow
from companion.physics.frames import Array, Floats, Matrix, rotations, symmetric
from companion.physics.gradienter import Law, readings_from_up
from companion.physics.units import DEG, MG

LEVEL: Final = np.array([0.0, 0.0, -1.0])
Group = Literal["gradienter", "accelerometer", "gyro", "compass", "turn", "spot", "zero", "prior", "nothing"]
ResidualLabel = tuple[Group, int, str]
"""Group of a residual, number of its pose (from 1; 0: none), and name of its IMU (empty: none)."""

_ANYHOW_RAD: Final = 1.0
"""Sigma that limits each step of an unknown without a prior (damping); it keeps the equations solvable."""
PRIOR_BIAS_M_S2: Final = 100.0 * MG
PRIOR_SCALE: Final = 0.03
PRIOR_SHEAR: Final = 0.01
"""Prior sigma of an uncalibrated IMU's shear. ICM-42688-P: cross axis 1 %, scale 0.5 %; a mounted chip is worse."""
_MAX_ROUNDS: Final = 30
_CONVERGED: Final = 1e-5
_STEP: Final = 1e-5
"""Step of the numerical derivatives; like the limit of convergence, a multiple of each unknown's prior sigma."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class LeastSquares:
    """Result of `fit`: values of the unknowns, and their covariance from the sigmas of readings and priors.

    The covariance of an unknown that is not estimated is zero. `redundancy`: share of the variance of each reading or
    prior that remains in its residual after the fit.
    """

    values: Array
    covariance: Matrix
    residual: Array  # Residuals over their sigmas: of the readings, then of the prior of each estimated unknown
    redundancy: Array


def fit(
    residuals: Callable[[Floats], Floats], start: Array, sigma: Array, damped: Sequence[int] | slice = ()
) -> LeastSquares:
    """Estimate unknowns by Gauss-Newton with priors.

    Args:
        residuals: maps m sets of unknowns (m, size) to measured minus predicted, over sigma, (m, readings).
        start: first guess (size,), also the mean of the priors.
        sigma: sigma (size,) of each prior; 0: the unknown is known and not estimated.
        damped: indices of unknowns without a prior; for these, `sigma` limits the step.

    Raises:
        ValueError: the iteration does not converge.
        numpy.linalg.LinAlgError: the equations cannot be solved.
    """
    sought = np.flatnonzero(sigma)
    scale = sigma[sought]
    steps = np.zeros((len(sought) + 1, len(start)))
    steps[range(1, len(steps)), sought] = _STEP * scale
    has_prior = np.ones(len(start), dtype=np.bool_)
    has_prior[damped if isinstance(damped, slice) else list(damped)] = False
    at, converged = start.copy(), False
    for _ in range(_MAX_ROUNDS + 1):
        found = residuals(at + steps)
        residual = np.concatenate([found[0], (has_prior * (start - at))[sought] / scale])
        scaled = np.vstack([(found[0] - found[1:]).T / _STEP, np.eye(len(sought))])
        if not np.isfinite(scaled).all():
            break
        if converged:
            inverse = np.linalg.inv(scaled.T @ scaled)
            covariance = np.zeros((len(start), len(start)))
            covariance[np.ix_(sought, sought)] = inverse * np.outer(scale, scale)
            return LeastSquares(at, covariance, residual, 1.0 - np.einsum("ij,ij->i", scaled @ inverse, scaled))
        step = np.linalg.lstsq(scaled, residual, rcond=None)[0]
        at[sought] += step * scale
        converged = bool(np.abs(step).max() < _CONVERGED)
    raise ValueError("no solution was found")


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class PoseMeans:
    """Means over the time without motion in one pose.

    `tilt_deg`: gradienter readings minus the configured offset; None if out of range or without a gradienter.
    `counted`: true if the gyros measured the turn since the previous pose (`seconds.counting`). `heading_rad` is then
    the previous pose's heading plus this turn, not wrapped. `heading_sigma_rad` is then the sigma of this turn, without
    the error of the gyros' scale (`Priors.turn_scale`).
    """

    imus: tuple[ImuWindow, ...]
    tilt_deg: tuple[float, float] | None
    tilt_sigma_deg: tuple[float, float]
    heading_rad: float  # Heading from a north common to all poses, which may differ from true north
    heading_sigma_rad: float
    on_spot: bool  # True at the marked place on which the aircraft is turned
    counted: bool = False


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Gravity and the Earth's rotation rate at the place of an alignment, with their uncertainty."""

    gravity_m_s2: float
    gravity_sigma_m_s2: float
    rate_rad_s: Array
    """Earth's rotation rate (3,) in the ground frame; headings count from the x axis of that frame."""
    rate_covariance: Matrix


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Priors:
    """Prior sigma of each unknown of an alignment; 0: known and not estimated (method.md section 3.4, joint MAP).

    `placement_deg`: tilt error, each axis, of every return to the marked place. `turn_scale`: gyro scale of turns.
    """

    offset_deg: float = 1.0
    placement_deg: float = 0.02
    scale: float = 0.005
    shear: float = 0.002
    misalignment_deg: float = 1.0
    accel_bias_m_s2: float = 30.0 * MG
    gyro_bias_rad_s: float = 5.0 * DEG
    turn_scale: float = 0.01


MISALIGNMENT, PART_SCALE, PART_SHEAR, ACCEL_BIAS, GYRO_BIAS = range(5)
"""Indices of an IMU's five groups of unknowns. A group has three values: x, y, z, or xy, xz, yz for the shear."""


class Model:
    """Model of an alignment: computes the residuals of all poses from the unknowns.

    The unknowns, in SI units: zero of the gradienter (2), tilt of the ground at the marked place (2), gravity (1),
    Earth's rate (3), gyro scale of turns (1), attitude error of each pose (3), five groups (3) of each IMU.
    """

    offset, spot, gravity, rate, turn = slice(0, 2), slice(2, 4), slice(4, 5), slice(5, 8), slice(8, 9)

    def __init__(
        self,
        mounting: tuple[Law, Matrix],
        stands: Sequence[PoseMeans],
        ground: Ground,
        priors: Priors,
        attitudes: Sequence[Matrix],
    ) -> None:
        self._law, self._vehicle_from_sensor = mounting
        self.names = names = [imu.name for imu in stands[0].imus]
        self._stands, self._first_guess = stands, np.array(attitudes)
        self._first_imu = self.turn.stop + 3 * len(stands)
        numbers = range(len(stands))
        self._tilted = [k for k in numbers if stands[k].tilt_deg is not None]
        self._on_spot = [k for k in numbers if stands[k].on_spot]
        self._turned = [k for k in numbers if stands[k].counted]
        self._headed = [k for k in numbers if not stands[k].counted]
        self._accel = np.array([[imu.accel_m_s2 for imu in stand.imus] for stand in stands])
        self._gyro = np.array([[imu.gyro_rad_s for imu in stand.imus] for stand in stands])
        self._tilt_deg = np.array([stands[k].tilt_deg for k in self._tilted]).reshape(-1, 2)
        self._heading = np.array([stand.heading_rad for stand in stands])

        angle, bias = priors.misalignment_deg * DEG, (priors.accel_bias_m_s2, priors.gyro_bias_rad_s)
        self.sigma = np.full(self._first_imu + 15 * len(names), _ANYHOW_RAD)
        """Prior sigma of every unknown; 0: not estimated."""
        self.sigma[self.offset] = priors.offset_deg * DEG if self._tilted else 0.0
        self.sigma[self.spot] = _ANYHOW_RAD if self._on_spot else 0.0
        self.sigma[self.gravity] = ground.gravity_sigma_m_s2
        self.sigma[self.rate] = np.sqrt(np.diag(ground.rate_covariance))
        self.sigma[self.turn] = priors.turn_scale
        self.sigma[self._first_imu :] = np.tile(np.repeat([angle, priors.scale, priors.shear, *bias], 3), len(names))
        self.start = np.zeros(len(self.sigma))
        self.start[self.gravity], self.start[self.rate] = ground.gravity_m_s2, ground.rate_rad_s
        if self._on_spot:
            self.start[self.spot] = self._first_guess[self._on_spot, 2, :2].mean(axis=0)
        self.damped = [*range(2, 4), *range(self.turn.stop, self._first_imu)]
        """Indices of the unknowns without a prior."""

        self.labels: list[ResidualLabel] = []  # Labels of the residuals, in their order, and of the priors
        sigmas: list[float] = []

        def add(group: Group, k: int, sigma: Iterable[float], name: str = "") -> None:
            for each in sigma:
                self.labels.append((group, k + 1, name))
                sigmas.append(each)

        for k in self._tilted:
            add("gradienter", k, np.array(stands[k].tilt_sigma_deg) * DEG)
        imus = [(k, imu) for k in numbers for imu in stands[k].imus]
        for k, imu in imus:
            add("accelerometer", k, imu.accel_sigma_use_m_s2, imu.name)
        for k, imu in imus:
            add("gyro", k, imu.gyro_sigma_use_rad_s, imu.name)
        for k in self._headed:
            add("compass", k, [stands[k].heading_sigma_rad])
        for k in self._turned:
            add("turn", k, [stands[k].heading_sigma_rad])
        for k in self._on_spot:
            add("spot", k, [priors.placement_deg * DEG] * 2)
        for part in np.flatnonzero(self.sigma).tolist():
            group: Group = "zero" if part < self.offset.stop else "nothing" if part in self.damped else "prior"
            add(group, -1, [self.sigma[part]])
        self.row_sigma = np.array(sigmas)  # Sigma of every row of `labels`, SI units

    def imu(self, imu: int, part: int) -> slice:
        start = self._first_imu + 15 * imu + 3 * part
        return slice(start, start + 3)

    def attitudes(self, at: Floats) -> Floats:
        """Return the rotation from the ground frame to the vehicle's axes in every pose, (..., poses, 3, 3)."""
        errors = at[..., self.turn.stop : self._first_imu]
        return np.asarray(rotations(-errors.reshape(*at.shape[:-1], -1, 3)) @ self._first_guess)

    def reading(self, at: Floats, up: Floats) -> Floats:
        """Predict accelerometer readings (..., poses, imus, 3). `up` (..., poses, 3): unit vector, vehicle's axes."""
        imus = self._imus(at)
        turned = rotations(-imus[..., MISALIGNMENT, :])
        matrices = response(imus[..., PART_SCALE, :], imus[..., PART_SHEAR, :]) @ turned
        felt = np.einsum("...iab,...kb->...kia", matrices, up) * at[..., self.gravity, None, None]
        return np.asarray(felt + imus[..., None, :, ACCEL_BIAS, :])

    def residuals(self, at: Floats) -> Floats:
        """Return measured minus predicted, over sigma, (m, readings), for m sets of unknowns (m, size)."""
        attitudes = self.attitudes(at)
        up, forward = -attitudes[..., 2], attitudes[..., 0, :]
        sensed = readings_from_up(self._law, up[:, self._tilted] @ self._vehicle_from_sensor)
        tilt = np.remainder(self._tilt_deg - sensed + 180.0, 360.0) - 180.0
        gyro = (attitudes @ at[:, None, self.rate, None])[..., 0]
        compass = self._heading - np.arctan2(forward[..., 1], forward[..., 0])
        turned = attitudes[:, self._turned] @ np.swapaxes(attitudes[:, [k - 1 for k in self._turned]], -1, -2)
        counted = np.array([self._heading[k] - self._heading[k - 1] for k in self._turned])
        by_gyros = np.arctan2(turned[..., 0, 1] - turned[..., 1, 0], turned[..., 0, 0] + turned[..., 1, 1])
        parts = [
            tilt * DEG - at[:, None, self.offset],
            self._accel - self.reading(at, up),
            self._gyro - gyro[..., None, :] - self._imus(at)[:, None, :, GYRO_BIAS],
            _wrapped(compass[:, self._headed]),
            _wrapped(counted * (1.0 - at[:, self.turn]) - by_gyros),
            at[:, None, self.spot] - attitudes[:, self._on_spot, 2, :2],
        ]
        found = np.concatenate([part.reshape(len(at), -1) for part in parts], axis=1)
        return np.asarray(found / self.row_sigma[: found.shape[1]])

    def _imus(self, at: Floats) -> Floats:
        return at[..., self._first_imu :].reshape(*at.shape[:-1], -1, 5, 3)


def response(scale: Floats, shear: Floats) -> Floats:
    """Return the matrix I + S (..., 3, 3): scale x, y, z on the diagonal of S, shear xy, xz, yz off the diagonal."""
    return np.asarray((1.0 + scale)[..., None] * np.eye(3) + symmetric(shear))


def _wrapped(angle_rad: Floats) -> Floats:
    return np.asarray(np.remainder(angle_rad + math.pi, 2.0 * math.pi) - math.pi)
