"""Conversion between attitude and the two readings of a gradienter (two-axis tilt sensor).

Equation (1) of the method's paper holds only for a sensor whose outputs are the elevations of its own axes. A liquid
cell reads the slope of the liquid's surface, and many modern devices give Euler angles. The wrong law causes 0.15
degrees of error (2.6 mg) at 10/10 degrees (method.md section 1.2). The law is therefore a property of the sensor:

| law     | outputs for (theta, gamma)                       | recovered by                                     |
|---------|--------------------------------------------------|--------------------------------------------------|
| "axis"  | qy = theta, qx = asin(sin gamma cos theta)       | theta = qy, gamma = asin(sin qx / cos theta)     |
| "slope" | qy = atan(tan theta / cos gamma), qx = gamma     | gamma = qx, theta = atan(tan qy cos qx)          |
| "euler" | qy = theta, qx = gamma                           | theta = qy, gamma = qx                           |

The reading qx is positive with the right side down, qy with the nose up; both are in the sensor's own frame.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from companion.physics.frames import Array, Floats, Matrix
from companion.physics.units import DEG

Law = Literal["axis", "slope", "euler"]


def attitude_from_readings(law: Law, x_deg: float, y_deg: float) -> tuple[float, float]:
    """Return pitch theta and roll gamma, rad, from a gradienter's two readings.

    Raises:
        ValueError: the readings are inconsistent ("axis" needs |qx| + |qy| <= 90 degrees).
    """
    qx, qy = x_deg * DEG, y_deg * DEG
    if law == "axis":
        sine = math.sin(qx) / math.cos(qy) if abs(y_deg) < 90.0 else math.inf
        if abs(sine) > 1.0:
            raise ValueError(
                f"gradienter readings x {x_deg:.3f} deg and y {y_deg:.3f} deg cannot belong together: with"
                ' law = "axis" |x| + |y| is at most 90 deg'
            )
        return qy, math.asin(sine)
    if law == "slope":
        return math.atan(math.tan(qy) * math.cos(qx)), qx
    return qy, qx


def up_in_sensor(law: Law, x_deg: float, y_deg: float) -> Array:
    """Return the unit vector (3,) pointing up (specific force at rest) in the gradienter's own FRD axes.

    Raises:
        ValueError: the readings are inconsistent.
    """
    theta, gamma = attitude_from_readings(law, x_deg, y_deg)
    return np.array([math.sin(theta), -math.sin(gamma) * math.cos(theta), -math.cos(gamma) * math.cos(theta)])


def readings_from_up(law: Law, up: Floats) -> Floats:
    """Return a gradienter's readings (..., 2), degrees, for specific forces (..., 3) of any length in its own axes."""
    x, y, z = np.moveaxis(up / np.linalg.norm(up, axis=-1, keepdims=True), -1, 0)
    if law == "axis":
        return np.asarray(np.stack([np.arcsin(-y), np.arcsin(x)], axis=-1) / DEG)
    # "slope" reads tan theta / cos gamma, with cos gamma = -z / hypot.
    across = -z if law == "slope" else np.hypot(y, z)
    return np.asarray(np.stack([np.arctan2(-y, -z), np.arctan2(x, across)], axis=-1) / DEG)


def up_jacobian(law: Law, x_deg: float, y_deg: float) -> Matrix:
    """Return the derivative (3, 2) of the up vector by a gradienter's readings (qx, qy), per radian.

    Raises:
        ValueError: the readings are inconsistent.
    """
    theta, gamma = attitude_from_readings(law, x_deg, y_deg)
    st, ct, sg, cg = math.sin(theta), math.cos(theta), math.sin(gamma), math.cos(gamma)
    if law == "axis":
        cx, cy = math.cos(x_deg * DEG), math.cos(y_deg * DEG)
        sx, sy = math.sin(x_deg * DEG), math.sin(y_deg * DEG)
        c = ct * cg
        return np.array([[0.0, cy], [-cx, 0.0], [sx * cx / c, sy * cy / c]])
    by_theta = np.array([ct, sg * st, cg * st])
    by_gamma = np.array([0.0, -cg * ct, sg * ct])
    if law == "euler":
        return np.column_stack([by_gamma, by_theta])
    # slope: gamma = qx, tan theta = tan qy cos qx; d theta / d qx and d theta / d qy by the chain rule.
    qx, qy = x_deg * DEG, y_deg * DEG
    theta_by_x = -math.tan(qy) * math.sin(qx) * ct**2
    theta_by_y = math.cos(qx) / math.cos(qy) ** 2 * ct**2
    return np.column_stack([by_gamma + by_theta * theta_by_x, by_theta * theta_by_y])
