"""The model behind `align`: the predicted reading of every sensor in every stand, and its derivatives.

A *stand* is one still window. Estimated for all stands together: the gradienter's zero; for every IMU its
misalignment against the base, accelerometer scale, shear and bias, and gyro bias; gravity and the Earth's rate
within the uncertainty of the place; the plane of the spot; and the attitude in each stand.

With u = C_k (0, 0, -1) (up in the vehicle), g, and the Earth's rate W in the ground frame (NED, or, without a north,
turned about the vertical):

    gradienter     reading = law(M^T u) + zero                          M: vehicle from sensor
    accelerometer  f = (I + S) exp(-[m x]) g u + b                      S: scale on the diagonal, shear beside it
    gyro           w = C_k W + b_w
    compass        heading of C_k
    turn           of C_k since the stand before, about the vehicle's z axis, (1 + s) times      s: a gyro's scale
    spot           down of the vehicle, seen from the ground, is the normal of the spot: C_k^T z = n + placement

The last line is the level reversal (method 3.4): the spot's true tilt is the same in the ground's frame, however the
aircraft is turned on it. "Level" is parallel to the plane on which it is turned. All derivatives are analytic; an
attitude error eps is C = (I - [eps x]) C_0.
"""

from __future__ import annotations

import dataclasses
import enum
import math
from collections.abc import Sequence
from typing import Final, Literal

import numpy as np

from companion.physics.frames import Array, Matrix, rotations, skew, symmetric, symmetric_by
from companion.physics.gradienter import Law, readings_from_up, up_jacobian
from companion.physics.units import DEG, MG

DOWN: Final = np.array([0.0, 0.0, 1.0])
Group = Literal["gradienter", "accelerometer", "gyro", "compass", "turn", "spot", "zero", "prior", "nothing"]

_AXES: Final = skew(np.eye(3))
_ANYHOW_RAD: Final = 1.0
"""Weak prior, about the first guess, of unknowns that only the readings determine: keeps the equations solvable."""
PRIOR_BIAS_M_S2: Final = 100.0 * MG
PRIOR_SCALE: Final = 0.03
PRIOR_SHEAR: Final = 0.01
"""One sigma of an uncalibrated part (ICM-42688-P: 0.5 %, cross axis 1 %; mounted parts are worse)."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class ImuStand:
    """Means of one IMU in one stand, vehicle FRD, with one sigma per axis (`sigma_use`); shapes (3,)."""

    name: str
    accel_m_s2: Array
    accel_sigma_m_s2: Array
    gyro_rad_s: Array
    gyro_sigma_rad_s: Array


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Stand:
    """Means of one still window."""

    imus: tuple[ImuStand, ...]
    tilt_deg: tuple[float, float] | None
    """The gradienter's readings less the configured offset; None out of its range, or without one."""
    tilt_sigma_deg: tuple[float, float]
    heading_rad: float
    """Heading from a north common to all stands, which need not be the true one."""
    heading_sigma_rad: float
    on_spot: bool
    """On the one spot on which the aircraft is turned."""
    counted: bool = False
    """The heading is that of the stand before plus the turn that the gyros counted since (`seconds.counting`), not
    wrapped; its sigma is that of this turn, without the gyros' scale (`Priors.turn_scale`)."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Gravity and the Earth's rate at the place, with their uncertainty."""

    gravity_m_s2: float
    gravity_sigma_m_s2: float
    rate_rad_s: Array
    """Shape (3,), in the frame from whose x axis headings count."""
    rate_covariance: Matrix


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Priors:
    """One sigma of each unknown before any reading; 0: known and not estimated (method 3.4, joint MAP covariance)."""

    offset_deg: float = 1.0
    placement_deg: float = 0.02
    """Tilt error of each placement on the spot, each axis."""
    scale: float = 0.005
    shear: float = 0.002
    misalignment_deg: float = 1.0
    accel_bias_m_s2: float = 30.0 * MG
    gyro_bias_rad_s: float = 5.0 * DEG
    turn_scale: float = 0.01
    """Scale error of the gyros that count turns, common to all of them."""


@dataclasses.dataclass(frozen=True, slots=True)
class Row:
    """Label of a residual: its group, stand (from 1; 0: none) and IMU, if any."""

    group: Group
    stand: int = 0
    name: str = ""


class Part(enum.IntEnum):
    """Unknowns of an IMU, three figures each: x, y, z, and of the shear xy, xz, yz."""

    MISALIGNMENT = 0
    SCALE = 1
    SHEAR = 2
    ACCEL_BIAS = 3
    GYRO_BIAS = 4


@dataclasses.dataclass(slots=True, eq=False)
class Unknowns:
    """All unknowns at their present values."""

    values: Array
    """(size,) in SI units, in the order of `Model`; attitude errors are zero."""
    attitudes: list[Matrix]
    """C_k, body from ground."""

    @property
    def gravity_m_s2(self) -> float:
        """Strength of gravity."""
        return float(self.values[Model.gravity.start])

    @property
    def imus(self) -> Array:
        """(imus, parts, 3)."""
        return self.values[Model.turn.stop + 3 * len(self.attitudes) :].reshape(-1, len(Part), 3)


class Model:
    """Residuals and their derivatives, each divided by its sigma."""

    offset, spot, gravity, rate, turn = slice(0, 2), slice(2, 4), slice(4, 5), slice(5, 8), slice(8, 9)

    def __init__(
        self, law: Law, vehicle_from_sensor: Matrix, stands: Sequence[Stand], ground: Ground, priors: Priors
    ) -> None:
        self._law, self._mounting = law, vehicle_from_sensor
        self.stands, self.ground, self.priors = stands, ground, priors
        self.names = [imu.name for imu in stands[0].imus]
        count = len(self.names)
        self._poses = self.turn.stop
        self._first_imu = self._poses + 3 * len(stands)
        self.size = self._first_imu + 15 * count
        sigma = np.full(self.size, _ANYHOW_RAD)
        sigma[self.offset] = priors.offset_deg * DEG if any(stand.tilt_deg is not None for stand in stands) else 0.0
        if not any(stand.on_spot for stand in stands):
            sigma[self.spot] = 0.0
        sigma[self.gravity] = ground.gravity_sigma_m_s2
        sigma[self.rate] = np.sqrt(np.diag(ground.rate_covariance))
        sigma[self.turn] = priors.turn_scale
        self.damped = 3 * len(stands) + (2 if sigma[2] > 0.0 else 0)
        """Number of unknowns that only the readings determine."""
        angle, bias = priors.misalignment_deg * DEG, (priors.accel_bias_m_s2, priors.gyro_bias_rad_s)
        each = [angle, priors.scale, priors.shear, *bias]
        sigma[self._first_imu :] = np.tile(np.repeat(each, 3), count)
        self.sigma = sigma
        """Sigma of every unknown before any reading; 0: not estimated."""
        self._known = np.zeros(self.size)
        self._known[self.gravity], self._known[self.rate] = ground.gravity_m_s2, ground.rate_rad_s

    def pose(self, stand: int) -> slice:
        """Place of the attitude error of a stand, counted from 0."""
        return slice(self._poses + 3 * stand, self._poses + 3 * stand + 3)

    def imu(self, imu: int, part: Part) -> slice:
        """Place of one part of an IMU, counted from 0."""
        start = self._first_imu + 15 * imu + 3 * part
        return slice(start, start + 3)

    def begin(self, attitudes: list[Matrix]) -> Unknowns:
        """Return the first guess that attitudes alone give."""
        spots = [a.T @ DOWN for a, stand in zip(attitudes, self.stands, strict=True) if stand.on_spot]
        at = Unknowns(self._known.copy(), list(attitudes))
        at.values[self.spot] = np.mean(spots, axis=0)[:2] if spots else 0.0
        return at

    def step(self, at: Unknowns, by: Array) -> None:
        """Change all unknowns by one step."""
        at.values = at.values + by
        at.values[self._poses : self._first_imu] = 0.0
        for k in range(len(self.stands)):
            at.attitudes[k] = rotations(-by[self.pose(k)]) @ at.attitudes[k]

    def linearise(self, at: Unknowns) -> Rows:
        """Return all residuals at these values.

        Raises:
            ValueError: the readings cannot belong together.
        """
        rows = Rows(self.size)
        for k, stand in enumerate(self.stands):
            attitude = at.attitudes[k]
            up = -attitude @ DOWN
            self._gradienter(rows, at, k, up)
            for i, imu in enumerate(stand.imus):
                self._accelerometer(rows, at, (k, i), imu, up)
                self._gyro(rows, at, (k, i), imu)
            if stand.counted:
                self._turn(rows, at, k)
            else:
                self._heading(rows, at, k)
            if stand.on_spot:
                placement = np.full(2, self.priors.placement_deg * DEG)
                by = rows.add(Row("spot", k + 1), at.values[self.spot] - (attitude.T @ DOWN)[:2], placement)
                by[:, self.pose(k)] = (attitude.T @ -skew(DOWN))[:2]
                by[:, self.spot] = -np.eye(2)
        off = at.values - self._known
        off[self.spot] = 0.0  # the readings alone tell it
        for part in np.flatnonzero(self.sigma > 0.0):
            weak = self.spot.start <= part < self.spot.stop or self._poses <= part < self._first_imu
            group: Group = "zero" if part < self.offset.stop else "nothing" if weak else "prior"
            rows.add(Row(group), -off[[part]], self.sigma[[part]])[0, part] = 1.0
        return rows

    def _heading(self, rows: Rows, at: Unknowns, k: int) -> None:
        stand, attitude = self.stands[k], at.attitudes[k]
        forward = attitude.T[:, 0]
        turn = attitude.T @ -skew(np.array([1.0, 0.0, 0.0]))
        across = forward[0] ** 2 + forward[1] ** 2
        off = math.remainder(stand.heading_rad - math.atan2(forward[1], forward[0]), 2.0 * math.pi)
        by = rows.add(Row("compass", k + 1), np.array([off]), np.array([stand.heading_sigma_rad]))
        by[:, self.pose(k)] = (forward[0] * turn[1] - forward[1] * turn[0]) / max(across, 1e-6)

    def _turn(self, rows: Rows, at: Unknowns, k: int) -> None:
        counted = self.stands[k].heading_rad - self.stands[k - 1].heading_rad
        turned = at.attitudes[k] @ at.attitudes[k - 1].T
        sine, cosine = turned[0, 1] - turned[1, 0], turned[0, 0] + turned[1, 1]
        off = math.remainder(
            counted * (1.0 - float(at.values[self.turn.start])) - math.atan2(sine, cosine), 2.0 * math.pi
        )
        by = rows.add(Row("turn", k + 1), np.array([off]), np.array([self.stands[k].heading_sigma_rad]))
        for stand, changes in ((k, -_AXES @ turned), (k - 1, turned @ _AXES)):
            across = cosine * (changes[:, 0, 1] - changes[:, 1, 0]) - sine * (changes[:, 0, 0] + changes[:, 1, 1])
            by[:, self.pose(stand)] = across / max(sine**2 + cosine**2, 1e-6)
        by[:, self.turn] = counted

    def _gradienter(self, rows: Rows, at: Unknowns, k: int, up: Array) -> None:
        stand = self.stands[k]
        if stand.tilt_deg is None:
            return
        x_deg, y_deg = readings_from_up(self._law, self._mounting.T @ up).tolist()
        read = np.array([math.remainder(a - b, 360.0) for a, b in zip(stand.tilt_deg, (x_deg, y_deg), strict=True)])
        # On the sphere of directions the readings' Jacobian is the left inverse of that of the direction.
        by_up = np.linalg.pinv(up_jacobian(self._law, x_deg, y_deg)) @ self._mounting.T
        sigma = np.array(stand.tilt_sigma_deg) * DEG
        by = rows.add(Row("gradienter", k + 1), read * DEG - at.values[self.offset], sigma)
        by[:, self.offset] = np.eye(2)
        by[:, self.pose(k)] = by_up @ skew(up)

    def _accelerometer(self, rows: Rows, at: Unknowns, where: tuple[int, int], imu: ImuStand, up: Array) -> None:
        k, i = where
        read = imu.accel_m_s2 - self.reading(at, i, up)
        by = rows.add(Row("accelerometer", k + 1, imu.name), read, imu.accel_sigma_m_s2)
        by += self.reading_by(at, i, up)
        by[:, self.pose(k)] = at.gravity_m_s2 * _response(at, i) @ skew(up)

    def reading(self, at: Unknowns, imu: int, up: Array) -> Array:
        """Predict the reading of an IMU's accelerometers, counted from 0, with `up` up in the vehicle; (3,)."""
        return np.asarray(_response(at, imu) @ up * at.gravity_m_s2 + at.imus[imu, Part.ACCEL_BIAS])

    def reading_by(self, at: Unknowns, imu: int, up: Array) -> Matrix:
        """Return the derivative of `reading` by all unknowns but the attitude, (3, size)."""
        misalignment, gravity = at.imus[imu, Part.MISALIGNMENT], at.gravity_m_s2
        stretch, aligned = _stretch(at, imu), rotations(-misalignment) @ up
        by = np.zeros((3, self.size))
        by[:, self.imu(imu, Part.MISALIGNMENT)] = gravity * stretch @ skew(aligned) @ _jacobian(-misalignment)
        by[:, self.imu(imu, Part.SCALE)] = gravity * np.diag(aligned)
        by[:, self.imu(imu, Part.SHEAR)] = gravity * symmetric_by(aligned)
        by[:, self.imu(imu, Part.ACCEL_BIAS)] = np.eye(3)
        by[:, self.gravity] = (stretch @ aligned)[:, None]
        return by

    def _gyro(self, rows: Rows, at: Unknowns, where: tuple[int, int], imu: ImuStand) -> None:
        k, i = where
        rate = at.attitudes[k] @ at.values[self.rate]
        read = imu.gyro_rad_s - rate - at.imus[i, Part.GYRO_BIAS]
        by = rows.add(Row("gyro", k + 1, imu.name), read, imu.gyro_sigma_rad_s)
        by[:, self.pose(k)] = skew(rate)
        by[:, self.rate] = at.attitudes[k]
        by[:, self.imu(i, Part.GYRO_BIAS)] = np.eye(3)


class Rows:
    """Residuals and their derivatives by all unknowns."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._parts: list[tuple[Array, Matrix, Array]] = []
        self.labels: list[Row] = []

    def add(self, row: Row, residual: Array, sigma: Array) -> Matrix:
        """Add rows; returns their derivatives, to be filled in."""
        derivative = np.zeros((len(residual), self._size))
        self.labels += [row] * len(residual)
        self._parts.append((residual, derivative, sigma))
        return derivative

    def stacked(self) -> tuple[Array, Matrix, Array]:
        """Residuals (n,) and derivatives (n, size), both over sigma, and the sigmas (n,)."""
        residual, derivative, sigma = (np.concatenate(part) for part in zip(*self._parts, strict=True))
        return residual / sigma, derivative / sigma[:, None], sigma


def response(scale: Array, shear: Array) -> Matrix:
    """Return I + S, (3, 3), of scale x y z and shear xy, xz, yz."""
    return np.diag(1.0 + scale) + symmetric(shear)


def _stretch(at: Unknowns, imu: int) -> Matrix:
    return response(at.imus[imu, Part.SCALE], at.imus[imu, Part.SHEAR])


def _response(at: Unknowns, imu: int) -> Matrix:
    return _stretch(at, imu) @ rotations(-at.imus[imu, Part.MISALIGNMENT])


def _jacobian(vector_rad: Array) -> Matrix:
    """Return J of exp([(v + d) x]) = exp([(J d) x]) exp([v x]), to first order in d."""
    angle = float(np.linalg.norm(vector_rad))
    cross = skew(vector_rad)
    if angle < 1e-6:
        return np.eye(3) + cross / 2.0
    return np.asarray(
        np.eye(3) + (1.0 - math.cos(angle)) / angle**2 * cross + (angle - math.sin(angle)) / angle**3 * cross @ cross
    )
