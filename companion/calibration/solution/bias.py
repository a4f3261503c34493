"""The bias equations of the paper in their corrected form, and their covariance.

| paper | printed                                           | here                                                |
|-------|---------------------------------------------------|-----------------------------------------------------|
| (2)   | gravity in body axes                              | specific force: minus gravity, at rest g * up       |
| (3)   | accelerometer = gravity + bias                    | accelerometer = specific force + bias               |
| (4)   | dN = -mean + g sin, dE with cos cos, dU + g cos   | bias = mean - g * up, one vector equation           |
| (5)   | T11, T12 with wrong signs; latitude in row 2      | physics.frames.body_from_ned (orthogonal)           |
| (6)   | -mean - T Omega                                   | bias = mean - C_n^b w_ie^n                          |

Coded as printed, (4) returns the negative of the north bias and (6) minus the bias less twice the Earth's rate
(method section 1.3). Everything is FRD and NED; `up` is the unit vector of specific force at rest.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from companion.physics.frames import Array, Matrix, roll_pitch_from_up, skew


def accelerometer_bias(mean_m_s2: Array, up: Array, gravity_m_s2: float) -> Array:
    """Equation (4), corrected: mean reading minus the specific force at rest; shape (3,), FRD, m/s^2."""
    return mean_m_s2 - gravity_m_s2 * up


def gyro_bias(mean_rad_s: Array, earth_rate_body_rad_s: Array) -> Array:
    """Equation (6), corrected: mean reading minus the Earth's rotation in body axes; shape (3,), FRD, rad/s."""
    return mean_rad_s - earth_rate_body_rad_s


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Uncertain:
    """A vector that is known up to a covariance: `mean` shape (3,), `covariance` shape (3, 3)."""

    mean: Array
    covariance: Matrix


def attitude_error_jacobian(up: Array) -> Matrix:
    """How a change of `up` turns the attitude, at a fixed heading angle: eps = jacobian @ d up, shape (3, 3).

    C_hat = (I - [eps x]) C. Roll turns about the body's x axis, pitch about the horizontal axis
    (0, cos gamma, -sin gamma); with gamma = atan2(-u_y, -u_z) and sin theta = u_x.
    """
    gamma, theta = roll_pitch_from_up(up)
    horizontal = np.hypot(up[1], up[2])
    by_gamma = np.array([0.0, up[2], -up[1]]) / horizontal**2
    by_theta = np.array([1.0 / np.cos(theta), 0.0, 0.0])
    return np.outer([1.0, 0.0, 0.0], by_gamma) + np.outer([0.0, np.cos(gamma), -np.sin(gamma)], by_theta)


def bias_covariance(
    *,
    attitude_covariance_rad2: Matrix,
    up: Array,
    gravity_m_s2: float,
    gravity_sigma_m_s2: float,
    earth_rate_body: Uncertain,
) -> Matrix:
    """The 6x6 covariance of (gyro bias, accelerometer bias) without the sensors' own variances; method section 2.1.

    An attitude error eps makes db_a = eps x f and db_g = eps x w; the cross term is kept, since one tilt error
    makes both. What remains unknown of the Earth's rate (latitude, or a heading never measured) comes in with
    `earth_rate_body.covariance`.
    """
    by_rate = -skew(earth_rate_body.mean)  # eps x w = -[w x] eps
    by_force = -skew(gravity_m_s2 * up)
    jacobian = np.vstack([by_rate, by_force])
    covariance = jacobian @ attitude_covariance_rad2 @ jacobian.T
    covariance[:3, :3] += earth_rate_body.covariance
    covariance[3:, 3:] += np.outer(up, up) * gravity_sigma_m_s2**2
    return covariance
