"""Detection of readings at rest that no bias explains: gravity along the wrong axis, or beyond any sensor's bias.

The cause is a wrong mounting, exchanged axes or a wrong unit. The text names the cause and the remedy. The gates, the
estimate and `companion check` use this module.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from companion.messages import message
from companion.physics.frames import Array, Matrix, rotation_matrix
from companion.physics.units import DEG, G
from companion.rotations import ROTATIONS_DEG
from companion.samples import Triad

MOST_GYRO_RAD_S: Final = 30.0 * DEG
MOST_ACCEL_M_S2: Final = 0.3 * G  # Several times the worst power-up bias in data sheets
_TILTED_RAD: Final = math.radians(20.0)
"""Largest plausible angle between gravity by IMU and by tilt sensor: the largest bias turns gravity by 17 degrees."""
_COMMON_BIAS_M_S2: Final = 0.05 * G  # Most parts' bias at power-up is below: 0.02 to 0.05 g in data sheets
_EXPLAINED: Final = 0.3  # Largest error left, over the error before, if a turned tilt sensor explains it
_FITS_M_S2: Final = 0.2 * G
_AS_WELL_M_S2: Final = 0.02 * G
"""Difference in fit below which the simpler of two mountings is chosen: ROLL_180 and PITCH_180 fit alike when level."""
_AXES: Final = "xyz"
_UNITS: Final = {"g": G, "mg": 1e-3 * G, "cm/s^2": 0.01, "ft/s^2": 0.3048}
_GRAVITY_M_S2: Final = (8.3, 11.3)


def unit_of_force(size: float) -> str:
    low, high = _GRAVITY_M_S2
    return next((unit for unit, factor in _UNITS.items() if low <= size * factor <= high), "")


def implausible(
    name: str,
    rate_rad_s: Array,
    force_m_s2: Array,
    expected_m_s2: Array,
    sensor_to_vehicle: Matrix,
    remedy: str,
    any_bias: str,
) -> dict[Triad, str]:
    """Return, for each implausible triad of a motionless IMU, the reason why no bias explains its mean readings.

    The means and `expected_m_s2`, the specific force by the tilt sensor, are (3,), vehicle axes (FRD). `remedy`: text
    on how to configure another mounting, with {} for the name of that mounting; `any_bias`: how to accept a large bias.
    """
    if words := misplaced(name, force_m_s2, expected_m_s2, sensor_to_vehicle, remedy):
        return {"gyro": words, "accel": words}
    found: dict[Triad, str] = {}
    bias, rate = np.abs(force_m_s2 - expected_m_s2), np.abs(rate_rad_s)
    if (deg := _turned(force_m_s2, expected_m_s2)) is not None:
        found["accel"] = message("tilt_sensor_turned", imu=name, deg=deg)
    elif bias[axis := int(bias.argmax())] > MOST_ACCEL_M_S2:
        found["accel"] = (
            f"accel {name}: a bias of {bias[axis] / G:.2f} g on {_AXES[axis]}, more than any sensor has"
            f" ({MOST_ACCEL_M_S2 / G:g}): scale, unit or tilt are wrong; {any_bias}"
        )
    if rate[axis := int(rate.argmax())] > MOST_GYRO_RAD_S:
        found["gyro"] = (
            f"gyro {name}: a bias of {rate[axis] / DEG:.0f} deg/s on {_AXES[axis]}, more than any sensor has"
            f" ({MOST_GYRO_RAD_S / DEG:g}): deg/s for rad/s? {any_bias}"
        )
    return found


def misplaced(name: str, force_m_s2: Array, expected_m_s2: Array, sensor_to_vehicle: Matrix, remedy: str) -> str | None:
    """Explain why gravity by the IMU differs from the tilt; None if both agree. Arguments: see `implausible`."""
    sizes = float(np.linalg.norm(force_m_s2)), float(np.linalg.norm(expected_m_s2))
    if min(sizes) == 0.0:
        return None
    cosine = float(force_m_s2 @ expected_m_s2) / (sizes[0] * sizes[1])
    if cosine > math.cos(_TILTED_RAD):
        return None
    # Find the simplest rotation by right angles that maps the reading, in the sensor's axes, to the expected one.
    off = {
        rotation: float(np.linalg.norm(rotation_matrix(rotation) @ sensor_to_vehicle.T @ force_m_s2 - expected_m_s2))
        for rotation, angles in ROTATIONS_DEG.items()
        if all(angle % 90.0 == 0.0 for angle in angles)
    }
    fitting = [each for each, size in off.items() if size <= min(min(off.values()) + _AS_WELL_M_S2, _FITS_M_S2)]
    what = "check its mounting and the tilt sensor's"
    if fitting:
        what = remedy.format(min(fitting, key=lambda each: each.count("_")))
    axis, by_tilt = _pointing(force_m_s2), _pointing(expected_m_s2)
    if axis == by_tilt:
        return f"accel {name}: gravity is {math.degrees(math.acos(cosine)):.0f} deg off the tilt: {what}"
    return f"accel {name}: {axis}, by the tilt {by_tilt}: {what}"


def _turned(force_m_s2: Array, expected_m_s2: Array) -> int | None:
    """Return the turn of the tilt sensor about z, deg, that explains an error above a common bias; None: none does."""
    off = float(np.linalg.norm(force_m_s2 - expected_m_s2))
    if off > _COMMON_BIAS_M_S2:
        for deg in (180, 90, 270):
            if np.linalg.norm(force_m_s2 - rotation_matrix(f"ROTATION_YAW_{deg}") @ expected_m_s2) < _EXPLAINED * off:
                return deg
    return None


def _pointing(force: Array) -> str:
    axis = int(np.abs(force).argmax())
    return f"{_AXES[axis]} points {'up' if force[axis] > 0.0 else 'down'}"
