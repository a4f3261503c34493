"""What no IMU at rest reads, however biased: gravity along another axis than it lies, or biases beyond any part's.

Such a reading has another cause than a bias (a mounting, exchanged axes, a unit), which is named with what to do about
it. All that judge readings ask here: the gates, the estimate, `companion check`.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from companion.physics.frames import Array, Matrix, rotation_matrix
from companion.physics.units import DEG, G
from companion.rotations import ROTATIONS_DEG
from companion.samples import Triad

MOST_GYRO_RAD_S: Final = 30.0 * DEG
MOST_ACCEL_M_S2: Final = 0.3 * G
"""Several times the worst that data sheets allow for a power-up: biases of such size are none."""
_TILTED_RAD: Final = math.radians(20.0)
"""Of gravity by the IMU against that by the tilt: the largest bias turns it by 17 degrees."""
_FITS_M_S2: Final = 0.2 * G
_AS_WELL_M_S2: Final = 0.02 * G
"""Mountings that explain a reading about as well: level, ROLL_180 and PITCH_180 read the same. The first counts."""
_AXES: Final = "xyz"
_UNITS: Final = {"g": G, "mg": 1e-3 * G, "cm/s^2": 0.01, "ft/s^2": 0.3048}
_GRAVITY_M_S2: Final = (8.3, 11.3)


def unit_of_force(size: float) -> str:
    """In which other unit a specific force of such size would be gravity; empty where in none."""
    low, high = _GRAVITY_M_S2
    return next((unit for unit, factor in _UNITS.items() if low <= size * factor <= high), "")


def implausible(
    name: str,
    rate_rad_s: Array,
    force_m_s2: Array,
    expected_m_s2: Array,
    sensor_to_vehicle: Matrix,
    remedy: str,
) -> dict[Triad, str]:
    """What of one IMU's means over a still stretch cannot be biased readings, by triad, and why.

    The means and `expected_m_s2`, the specific force by the tilt, are (3,) in vehicle FRD; `remedy` is how another
    mounting is said, with {} for its name.
    """
    found: dict[Triad, str] = {}
    if words := misplaced(name, force_m_s2, expected_m_s2, sensor_to_vehicle, remedy):
        return {"gyro": words, "accel": words}
    bias, rate = np.abs(force_m_s2 - expected_m_s2), np.abs(rate_rad_s)
    if bias[axis := int(bias.argmax())] > MOST_ACCEL_M_S2:
        found["accel"] = (
            f"accel {name}: a bias of {bias[axis] / G:.2f} g on {_AXES[axis]}, more than any part has"
            f" ({MOST_ACCEL_M_S2 / G:g}): scale, unit or tilt are wrong"
        )
    if rate[axis := int(rate.argmax())] > MOST_GYRO_RAD_S:
        found["gyro"] = (
            f"gyro {name}: a bias of {rate[axis] / DEG:.0f} deg/s on {_AXES[axis]}, more than any part has"
            f" ({MOST_GYRO_RAD_S / DEG:g}): deg/s for rad/s?"
        )
    return found


def misplaced(name: str, force_m_s2: Array, expected_m_s2: Array, sensor_to_vehicle: Matrix, remedy: str) -> str | None:
    """Why its gravity lies along another axis than by the tilt; None where it does not. Arguments as above."""
    sizes = float(np.linalg.norm(force_m_s2)), float(np.linalg.norm(expected_m_s2))
    if min(sizes) == 0.0:
        return None
    cosine = float(force_m_s2 @ expected_m_s2) / (sizes[0] * sizes[1])
    if cosine > math.cos(_TILTED_RAD):
        return None
    mounting = _mounting(sensor_to_vehicle.T @ force_m_s2, expected_m_s2)
    what = "check its mounting and the tilt sensor's" if mounting is None else remedy.format(mounting)
    axis, by_tilt = _pointing(force_m_s2), _pointing(expected_m_s2)
    if axis == by_tilt:
        return f"accel {name}: gravity is {math.degrees(math.acos(cosine)):.0f} deg off the tilt: {what}"
    return f"accel {name}: {axis}, by the tilt {by_tilt}: {what}"


def _pointing(force: Array) -> str:
    """At rest specific force points up."""
    axis = int(np.abs(force).argmax())
    return f"{_AXES[axis]} points {'up' if force[axis] > 0.0 else 'down'}"


def _mounting(sensed_m_s2: Array, expected_m_s2: Array) -> str | None:
    """The simplest rotation by right angles that brings the reading, in the sensor's axes, to where it should be."""
    off = {
        rotation: float(np.linalg.norm(rotation_matrix(rotation) @ sensed_m_s2 - expected_m_s2))
        for rotation, angles in ROTATIONS_DEG.items()
        if all(angle % 90.0 == 0.0 for angle in angles)
    }
    least = min(off.values())
    if least > _FITS_M_S2:
        return None
    return min((each for each, size in off.items() if size <= least + _AS_WELL_M_S2), key=lambda each: each.count("_"))
