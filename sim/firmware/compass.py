"""A magnetometer of the autopilot, with hard and soft iron, in the Earth's field."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from sim.earth import Array


@dataclasses.dataclass(slots=True, eq=False)
class SimCompass:
    """Magnetometer with iron: in vehicle axes (FRD), reading = soft^-1 field - hard, so soft (reading + hard) is right.

    `soft` is symmetric, 3x3. `spot` returns the field (3,), NED, milligauss, that iron in the ground adds at an
    attitude (body from NED). `noise_mgauss`: sigma of a reading. `unplugged`: zero. `stuck`: the last reading stays.
    `mounting` (3, 3) turns the sensor's axes to the vehicle's; the board's orientation parameter is meant to undo it,
    or, if `external`, the compass' own.
    """

    hard_mgauss: Sequence[float] = (0.0, 0.0, 0.0)
    soft: Array = dataclasses.field(default_factory=lambda: np.eye(3))
    spot: Callable[[Array], Array] | None = None
    noise_mgauss: float = 0.0
    unplugged: bool = False
    stuck: bool = False
    mounting: Array = dataclasses.field(default_factory=lambda: np.eye(3))
    external: bool = False

    def reading(self, body_from_ned: Array, field_ned: Array, random: np.random.Generator) -> Array:
        """Return a reading (3,) in the sensor's axes, milligauss."""
        if self.unplugged:
            return np.zeros(3)
        field = field_ned if self.spot is None else field_ned + self.spot(body_from_ned)
        noise = self.noise_mgauss * random.standard_normal(3) if self.noise_mgauss else 0.0
        read: Array = np.linalg.solve(self.soft, body_from_ned @ field) - np.asarray(self.hard_mgauss) + noise
        return np.asarray(self.mounting.T @ read)


Three = Array | Sequence[float]


def soft_matrix(diagonal: Three, beside: Three) -> Array:
    """Return the matrix with this diagonal and the elements xy, xz and yz beside it; a diagonal of zeros: no matrix."""
    xy, xz, yz = beside
    soft = np.diag(np.array(diagonal)) + np.array([[0.0, xy, xz], [xy, 0.0, yz], [xz, yz, 0.0]])
    return soft if np.any(diagonal) else np.eye(3)


def corrected(reading: Array, offset: Three, diagonal: Three, beside: Three) -> Array:
    """Return D (reading + offset), where D is the `soft_matrix`."""
    return np.asarray(soft_matrix(diagonal, beside) @ (reading + np.asarray(offset)))
