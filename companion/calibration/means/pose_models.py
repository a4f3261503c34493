"""How the readings of gradienter and compass become the direction of up and a heading of the vehicle."""

from __future__ import annotations

import dataclasses
import math
from typing import Final

from companion.physics.frames import Array, Matrix, body_from_ned, roll_pitch_from_up
from companion.physics.gradienter import Law, up_in_sensor
from companion.physics.units import DEG

LEVEL_COSINE: Final = math.cos(2.0 * DEG)
"""Data sheets give a compass' error "level" and "tilted" without a border: only what a table is counts as level."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class GradienterModel:
    """How a gradienter's readings become the direction of up in the vehicle: law, zero offset, mounting, sigma."""

    law: Law
    vehicle_from_sensor: Matrix
    offset_deg: tuple[float, float]
    sigma_deg: float


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class CompassModel:
    """How a compass reading becomes a true heading: reference, offset, mounting, sigma."""

    magnetic: bool
    vehicle_from_sensor: Matrix
    offset_deg: float
    sigma_deg: float
    counts_per_gauss: float | None = None
    """Of a device that gives its field in counts; None: only their direction means something."""
    prefers_field: bool = False
    """The heading is worked out from the field even where the device gives one of its own."""
    tilted_sigma_deg: float | None = None
    """Where it does not stand level; None: as `sigma_deg`."""

    def sigma_at(self, up: Array) -> float:
        """Its sigma in degrees where `up`, shape (3,), is up in the vehicle's axes."""
        upright = float(-(self.vehicle_from_sensor.T @ up)[2])
        if self.tilted_sigma_deg is None or upright >= LEVEL_COSINE:
            return self.sigma_deg
        return self.tilted_sigma_deg


def up_in_vehicle(model: GradienterModel, x_deg: float, y_deg: float) -> Array:
    """Up in the vehicle's axes, shape (3,), from the gradienter's two readings.

    Raises:
        ValueError: the readings cannot belong together.
    """
    x_deg, y_deg = x_deg - model.offset_deg[0], y_deg - model.offset_deg[1]
    return model.vehicle_from_sensor @ up_in_sensor(model.law, x_deg, y_deg)


def vehicle_heading_rad(compass: CompassModel, heading_deg: float, up: Array) -> float:
    """Heading of the vehicle, from the compass' own north (magnetic or true), not wrapped.

    A compass gives the azimuth of its own forward axis. The azimuth that this axis has when the vehicle heads
    north, at the tilt it has, is what the mounting adds.
    """
    gamma, theta = roll_pitch_from_up(up)
    forward_ned = body_from_ned(gamma, theta, 0.0).T @ compass.vehicle_from_sensor[:, 0]
    mounted_rad = math.atan2(forward_ned[1], forward_ned[0])
    return (heading_deg + compass.offset_deg) * DEG - mounted_rad
