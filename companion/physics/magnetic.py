"""Heading from a magnetic field vector, and the heading error that a disturbance causes.

`up` is the unit vector of specific force at rest, `field` the magnetic field in any unit, both of shape (3,). Their
common axes are forward, right, down of the vehicle or of the sensor (method.md section 3.5).
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from companion.physics.frames import Array
from companion.physics.units import DEG

BOUND_OF_TWO: Final = 3.043
"""Ratio of the 95 % bound of an unknown third component to the length of the two known ones; all have the same sigma.
Student's t with two degrees of freedom gives the ratio 4.303 / sqrt(2). A direction uniform on the sphere gives the
same value, 0.95 / sqrt(1 - 0.95^2)."""
BOUND_OF_ONE: Final = 12.71
"""Ratio of the 95 % bound of an unknown component to the only known one: Student's t, one degree of freedom."""
_VERTICAL: Final = 1e-9


def horizontal(vector: Array, up: Array) -> Array:
    """Return the part (3,) of a vector that is perpendicular to `up`."""
    return vector - (vector @ up) * up


def heading_rad(field: Array, up: Array) -> float:
    """Return the tilt-compensated heading of the first axis, clockwise from magnetic north, in (-pi, pi].

    Raises:
        ValueError: the first axis or the field is vertical: there is no heading.
    """
    forward, right = _horizontal_axes(up)
    ahead, across = float(field @ forward), float(field @ right)
    if math.hypot(ahead, across) <= _VERTICAL * float(np.linalg.norm(field)):
        raise ValueError("the field is vertical: it shows no heading")
    return math.atan2(-across, ahead)


def heading_by_up(field: Array, up: Array) -> Array:
    """Return the gradient (3,) of `heading_rad` by `up`; in a level aircraft -tan I along magnetic east.

    A tilt error makes the vertical field look horizontal. A tilt error about magnetic north turns the heading by tan I
    times itself, with the inclination I (2.5 times at 68 degrees); one about the heading by tan theta times itself.

    Raises:
        ValueError: the first axis or the field is vertical: there is no heading.
    """
    forward, right = _horizontal_axes(up)
    heading = heading_rad(field, up)
    east = math.sin(heading) * forward + math.cos(heading) * right
    pitch_rad = math.asin(max(-1.0, min(1.0, float(up[0]))))
    return -math.tan(pitch_rad) * right - math.tan(inclination_rad(field, up)) * east


def inclination_rad(field: Array, up: Array) -> float:
    return math.atan2(-float(field @ up), float(np.linalg.norm(horizontal(field, up))))


def inclination_by_up(field: Array, up: Array) -> Array:
    """Return the gradient (3,) of `inclination_rad` by `up`: minus the unit vector of magnetic north.

    Raises:
        ValueError: the field is vertical.
    """
    across = horizontal(field, up)
    size = float(np.linalg.norm(across))
    if size <= _VERTICAL * float(np.linalg.norm(field)):
        raise ValueError("the field is vertical: it shows no heading")
    return -across / size


def deflection_bound_deg(unseen_gauss: float, horizontal_gauss: float) -> float:
    """Return the largest heading error by an unseen field across the meridian, at most 180 degrees.

    The error is 180 degrees if the unseen field is as strong as the measured horizontal field (method.md section 3.5).
    """
    if unseen_gauss >= horizontal_gauss:
        return 180.0
    return math.asin(unseen_gauss / horizontal_gauss) / DEG


def _horizontal_axes(up: Array) -> tuple[Array, Array]:
    ahead = horizontal(np.array([1.0, 0.0, 0.0]), up)
    size = float(np.linalg.norm(ahead))
    if size <= _VERTICAL:
        raise ValueError("the first axis is vertical: it has no heading")
    forward = ahead / size
    return forward, np.cross(-up, forward)
