"""The model behind `align`: what every reading of every stand should be, and how it changes with what is sought.

A *stand* is one still window. Sought are, for all stands together: the gradienter's zero; for every IMU its
misalignment against the base, accelerometer scale, shear and bias, and gyro bias; gravity and the Earth's rate
within what the place leaves open; the plane of the spot; and how the aircraft stood each time.

With u = C_k (0, 0, -1) (up in the vehicle), g, and the Earth's rate W in the ground frame (NED, or, without a north,
turned about the vertical):

    gradienter     reading = law(M^T u) + zero                          M: vehicle from sensor
    accelerometer  f = (I + S) exp(-[m x]) g u + b                      S: scale on the diagonal, shear beside it
    gyro           w = C_k W + b_w
    compass        heading of C_k
    turn           of C_k since the stand before, about the vehicle's z axis, (1 + s) times      s: a gyro's scale
    spot           down of the vehicle, seen from the ground, is the normal of the spot: C_k^T z = n + placement

The last line is the level reversal (method 3.4): the spot's true tilt is the same in the
ground's frame, however the aircraft is turned on it. "Level" is what is parallel to the plane on which it is turned.
All derivatives are analytic; an attitude error eps is C = (I - [eps x]) C_0, as in `bias`.
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
"""Sigma about the first guess of what only the readings determine: it keeps the equations solvable."""


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
    """One still window.

    `heading_rad` counts from the same north in all stands, which need not be the true one.
    """

    imus: tuple[ImuStand, ...]
    tilt_deg: tuple[float, float] | None
    """The gradienter's readings less the configured offset; None where it was out of its range, or there is none."""
    tilt_sigma_deg: tuple[float, float]
    heading_rad: float
    heading_sigma_rad: float
    on_spot: bool
    """On the one spot on which the aircraft was turned."""
    counted: bool = False
    """The heading is that of the stand before and what the gyros counted since (`seconds.counting`), not wrapped; its
    sigma is that of this turn, but for the gyros' scale (`Priors.turn_scale`)."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Gravity and the Earth's rate at the place, and what is open of them."""

    gravity_m_s2: float
    gravity_sigma_m_s2: float
    rate_rad_s: Array
    """Shape (3,), in the frame from whose x axis headings count."""
    rate_covariance: Matrix


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Priors:
    """One sigma of what is known before; 0: taken as it is and not sought (method 3.4, joint MAP covariance)."""

    offset_deg: float = 1.0
    placement_deg: float = 0.02
    """Of each time that the aircraft is put onto the spot, each axis."""
    scale: float = 0.005
    shear: float = 0.002
    misalignment_deg: float = 1.0
    accel_bias_m_s2: float = 30.0 * MG
    gyro_bias_rad_s: float = 5.0 * DEG
    turn_scale: float = 0.01
    """Of the gyros that count turns, the same in all of them."""


@dataclasses.dataclass(frozen=True, slots=True)
class Row:
    """Whose residual a row is: a group, the stand (from 1; 0: none) and the name of an IMU where there is one."""

    group: Group
    stand: int = 0
    name: str = ""


class Part(enum.IntEnum):
    """What is sought of an IMU, three figures each: of x, y, z, and of the shear xy, xz, yz."""

    MISALIGNMENT = 0
    SCALE = 1
    SHEAR = 2
    ACCEL_BIAS = 3
    GYRO_BIAS = 4


@dataclasses.dataclass(slots=True, eq=False)
class Unknowns:
    """Everything that is sought, at its present value."""

    values: Array
    """(size,) in SI units, as `Model` has them; zero in the place of the attitudes' errors."""
    attitudes: list[Matrix]
    """C_k, body from ground."""

    @property
    def gravity_m_s2(self) -> float:
        """Its strength."""
        return float(self.values[Model.gravity.start])

    @property
    def imus(self) -> Array:
        """(imus, parts, 3)."""
        return self.values[Model.turn.stop + 3 * len(self.attitudes) :].reshape(-1, len(Part), 3)


class Model:
    """Residuals and their derivatives, every one divided by its sigma."""

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
        """How many parameters only the readings determine."""
        angle, bias = priors.misalignment_deg * DEG, (priors.accel_bias_m_s2, priors.gyro_bias_rad_s)
        each = [angle, priors.scale, priors.shear, *bias]
        sigma[self._first_imu :] = np.tile(np.repeat(each, 3), count)
        self.sigma = sigma
        """Of every parameter before any reading; 0: not sought."""
        self._known = np.zeros(self.size)
        self._known[self.gravity], self._known[self.rate] = ground.gravity_m_s2, ground.rate_rad_s

    # --- where each parameter stands in the vector

    def pose(self, stand: int) -> slice:
        """Attitude error of a stand, counted from 0."""
        return slice(self._poses + 3 * stand, self._poses + 3 * stand + 3)

    def imu(self, imu: int, part: Part) -> slice:
        """One part of an IMU, counted from 0."""
        start = self._first_imu + 15 * imu + 3 * part
        return slice(start, start + 3)

    # --- values

    def begin(self, attitudes: list[Matrix]) -> Unknowns:
        """A first guess from attitudes alone."""
        spots = [a.T @ DOWN for a, stand in zip(attitudes, self.stands, strict=True) if stand.on_spot]
        at = Unknowns(self._known.copy(), list(attitudes))
        at.values[self.spot] = np.mean(spots, axis=0)[:2] if spots else 0.0
        return at

    def step(self, at: Unknowns, by: Array) -> None:
        """Change everything by one step."""
        at.values = at.values + by
        at.values[self._poses : self._first_imu] = 0.0
        for k in range(len(self.stands)):
            at.attitudes[k] = rotations(-by[self.pose(k)]) @ at.attitudes[k]

    # --- residuals

    def linearise(self, at: Unknowns) -> tuple[Array, Matrix, list[Row]]:
        """Residuals (n,), their derivatives (n, size), both over sigma, and whose each is.

        Raises:
            ValueError: the readings cannot belong together.
        """
        rows = _Rows(self.size)
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
        for part in (slice(p, p + 1) for p in range(self.size)):
            if self.sigma[part] > 0.0:
                is_zero = part.start < self.offset.stop
                of_readings = self.spot.start <= part.start < self.spot.stop or (
                    self._poses <= part.start < self._first_imu
                )
                row = Row("zero" if is_zero else "nothing" if of_readings else "prior")
                by = rows.add(row, -off[part], self.sigma[part])
                by[0, part] = 1.0
        return rows.stacked()

    def _heading(self, rows: _Rows, at: Unknowns, k: int) -> None:
        stand, attitude = self.stands[k], at.attitudes[k]
        forward = attitude.T[:, 0]
        turn = attitude.T @ -skew(np.array([1.0, 0.0, 0.0]))
        across = forward[0] ** 2 + forward[1] ** 2
        off = math.remainder(stand.heading_rad - math.atan2(forward[1], forward[0]), 2.0 * math.pi)
        by = rows.add(Row("compass", k + 1), np.array([off]), np.array([stand.heading_sigma_rad]))
        by[:, self.pose(k)] = (forward[0] * turn[1] - forward[1] * turn[0]) / max(across, 1e-6)

    def _turn(self, rows: _Rows, at: Unknowns, k: int) -> None:
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

    def _gradienter(self, rows: _Rows, at: Unknowns, k: int, up: Array) -> None:
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

    def _accelerometer(self, rows: _Rows, at: Unknowns, where: tuple[int, int], imu: ImuStand, up: Array) -> None:
        k, i = where
        read = imu.accel_m_s2 - self.reading(at, i, up)
        by = rows.add(Row("accelerometer", k + 1, imu.name), read, imu.accel_sigma_m_s2)
        by += self.reading_by(at, i, up)
        by[:, self.pose(k)] = at.gravity_m_s2 * _response(at, i) @ skew(up)

    def reading(self, at: Unknowns, imu: int, up: Array) -> Array:
        """What the accelerometers of an IMU, counted from 0, read where `up` is up in the vehicle; (3,)."""
        return np.asarray(_response(at, imu) @ up * at.gravity_m_s2 + at.imus[imu, Part.ACCEL_BIAS])

    def reading_by(self, at: Unknowns, imu: int, up: Array) -> Matrix:
        """How that changes with everything but the attitude, (3, size)."""
        misalignment, gravity = at.imus[imu, Part.MISALIGNMENT], at.gravity_m_s2
        stretch, aligned = _stretch(at, imu), rotations(-misalignment) @ up
        by = np.zeros((3, self.size))
        by[:, self.imu(imu, Part.MISALIGNMENT)] = gravity * stretch @ skew(aligned) @ _jacobian(-misalignment)
        by[:, self.imu(imu, Part.SCALE)] = gravity * np.diag(aligned)
        by[:, self.imu(imu, Part.SHEAR)] = gravity * symmetric_by(aligned)
        by[:, self.imu(imu, Part.ACCEL_BIAS)] = np.eye(3)
        by[:, self.gravity] = (stretch @ aligned)[:, None]
        return by

    def _gyro(self, rows: _Rows, at: Unknowns, where: tuple[int, int], imu: ImuStand) -> None:
        k, i = where
        rate = at.attitudes[k] @ at.values[self.rate]
        read = imu.gyro_rad_s - rate - at.imus[i, Part.GYRO_BIAS]
        by = rows.add(Row("gyro", k + 1, imu.name), read, imu.gyro_sigma_rad_s)
        by[:, self.pose(k)] = skew(rate)
        by[:, self.rate] = at.attitudes[k]
        by[:, self.imu(i, Part.GYRO_BIAS)] = np.eye(3)


class _Rows:
    """Residuals and derivatives as they are collected."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._parts: list[tuple[Array, Matrix, Array]] = []
        self._labels: list[Row] = []

    def add(self, row: Row, residual: Array, sigma: Array) -> Matrix:
        """Add rows; returns their derivatives, to be filled in."""
        derivative = np.zeros((len(residual), self._size))
        self._labels += [row] * len(residual)
        self._parts.append((residual, derivative, sigma))
        return derivative

    def stacked(self) -> tuple[Array, Matrix, list[Row]]:
        residuals = [residual / sigma for residual, _, sigma in self._parts]
        derivatives = [derivative / sigma[:, None] for _, derivative, sigma in self._parts]
        return np.concatenate(residuals), np.vstack(derivatives), self._labels


def response(scale: Array, shear: Array) -> Matrix:
    """I + S, (3, 3), of scale x y z and shear xy, xz, yz."""
    return np.diag(1.0 + scale) + symmetric(shear)


def _stretch(at: Unknowns, imu: int) -> Matrix:
    return response(at.imus[imu, Part.SCALE], at.imus[imu, Part.SHEAR])


def _response(at: Unknowns, imu: int) -> Matrix:
    return _stretch(at, imu) @ rotations(-at.imus[imu, Part.MISALIGNMENT])


def _jacobian(vector_rad: Array) -> Matrix:
    """How exp([v x]) turns on when v grows: exp([(v + d) x]) = exp([(J d) x]) exp([v x]) to first order in d."""
    angle = float(np.linalg.norm(vector_rad))
    cross = skew(vector_rad)
    if angle < 1e-6:
        return np.eye(3) + cross / 2.0
    return np.asarray(
        np.eye(3) + (1.0 - math.cos(angle)) / angle**2 * cross + (angle - math.sin(angle)) / angle**3 * cross @ cross
    )
