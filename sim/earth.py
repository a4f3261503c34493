"""The simulator's model of the Earth, written from the definitions so that it can judge the companion's own.

Nothing here is shared with `companion.physics`; the two meet only in tests.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

EARTH_RATE_RAD_S = 7.292115e-5
STANDARD_GRAVITY_M_S2 = 9.80665

_SEMI_MAJOR_M = 6378137.0
_FLATTENING = 1.0 / 298.257223563
_SEMI_MINOR_M = _SEMI_MAJOR_M * (1.0 - _FLATTENING)
_GRAVITY_EQUATOR_M_S2 = 9.7803253359
_GRAVITY_POLE_M_S2 = 9.8321849378
_GM_M3_S2 = 3.986004418e14
_M = EARTH_RATE_RAD_S**2 * _SEMI_MAJOR_M**2 * _SEMI_MINOR_M / _GM_M3_S2


def normal_gravity_m_s2(latitude_deg: float, height_m: float = 0.0) -> float:
    """Normal gravity of WGS 84 at a height above the ellipsoid.

    Somigliana's closed formula with both axes and both normal gravities, continued upwards to second order in the
    height (NIMA TR8350.2, equations 4-1 and 4-3).
    """
    latitude = math.radians(latitude_deg)
    cos2, sin2 = math.cos(latitude) ** 2, math.sin(latitude) ** 2
    on_ellipsoid = (_SEMI_MAJOR_M * _GRAVITY_EQUATOR_M_S2 * cos2 + _SEMI_MINOR_M * _GRAVITY_POLE_M_S2 * sin2) / (
        math.sqrt(_SEMI_MAJOR_M**2 * cos2 + _SEMI_MINOR_M**2 * sin2)
    )
    relative = height_m / _SEMI_MAJOR_M
    return on_ellipsoid * (
        1.0 - 2.0 * (1.0 + _FLATTENING + _M - 2.0 * _FLATTENING * sin2) * relative + 3.0 * relative**2
    )


def earth_rate_ned_rad_s(latitude_deg: float) -> Array:
    """Return the Earth's rotation relative to space (3,): north, east and down."""
    latitude = math.radians(latitude_deg)
    return EARTH_RATE_RAD_S * np.array([math.cos(latitude), 0.0, -math.sin(latitude)])


def axis_rotation(axis: int, angle_rad: float) -> Array:
    """Return the right-handed rotation matrix about a coordinate axis (0, 1, 2)."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    matrix = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def mounting_matrix(roll_deg: float, pitch_deg: float, yaw_deg: float) -> Array:
    """Return the rotation from sensor to vehicle axes; the sensor is turned by yaw, pitch, roll about its own axes."""
    return (
        axis_rotation(2, math.radians(yaw_deg))
        @ axis_rotation(1, math.radians(pitch_deg))
        @ axis_rotation(0, math.radians(roll_deg))
    )


def body_from_ned(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array:
    """Return the rotation from north, east, down to the body's forward, right, down."""
    return axis_rotation(0, -roll_rad) @ axis_rotation(1, -pitch_rad) @ axis_rotation(2, -yaw_rad)


def bodies_from_ned(angles_rad: Array) -> Array:
    """Return the rotations from NED to body (n, 3, 3) for roll, pitch, yaw (n, 3)."""
    sr, sp, sy = np.sin(angles_rad).T
    cr, cp, cy = np.cos(angles_rad).T
    rows = [
        [cp * cy, cp * sy, -sp],
        [sr * sp * cy - cr * sy, sr * sp * sy + cr * cy, sr * cp],
        [cr * sp * cy + sr * sy, cr * sp * sy - sr * cy, cr * cp],
    ]
    return np.array(rows).transpose(2, 0, 1)


def angles_of(body_from_ned_matrix: Array) -> tuple[float, float, float]:
    """Return roll, pitch, yaw in rad of a matrix made by `body_from_ned`."""
    c = body_from_ned_matrix
    return math.atan2(c[1, 2], c[2, 2]), -math.asin(max(-1.0, min(1.0, c[0, 2]))), math.atan2(c[0, 1], c[0, 0])
