"""Noise-free windows as an ideal set of sensors would give them, from a construction of its own."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from companion.estimation.means.pose import HeadingWindow, TiltWindow
from companion.estimation.means.windows import ImuWindow, Window

Array = NDArray[np.float64]
RATE_RAD_S = 7.292115e-5


def about(axis: int, angle_rad: float) -> Array:
    """Right-handed rotation by an angle about axis 0, 1 or 2, as a matrix acting on vectors."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    matrix = np.eye(3)
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    return matrix


def ned_from_body(pitch_deg: float, roll_deg: float, heading_deg: float) -> Array:
    """The attitude as three successive turns, aerospace order."""
    yaw, pitch, roll = (math.radians(angle) for angle in (heading_deg, pitch_deg, roll_deg))
    return about(2, yaw) @ about(1, pitch) @ about(0, roll)


def readings(up: Array, law: Literal["axis", "slope", "euler"]) -> tuple[float, float]:
    """Readings x and y, degrees, of a gradienter in whose FRD axes `up` (unit) points up, by the law."""
    if law == "axis":
        return math.degrees(math.asin(-up[1])), math.degrees(math.asin(up[0]))
    if law == "slope":
        return math.degrees(math.atan2(-up[1], -up[2])), math.degrees(math.atan2(up[0], -up[2]))
    return math.degrees(math.atan2(-up[1], -up[2])), math.degrees(math.asin(up[0]))


def imu_means(gyro_rad_s: Array, gyro_sigma: float, accel_m_s2: Array, accel_sigma: float) -> ImuWindow:
    """The means of one IMU, with one sigma of all axes."""

    def axes(vector: Array) -> tuple[float, float, float]:
        x, y, z = (float(value) for value in vector)
        return x, y, z

    return ImuWindow(
        name="fc",
        samples=1000,
        duration_s=10.0,
        gyro_rad_s=axes(gyro_rad_s),
        accel_m_s2=axes(accel_m_s2),
        gyro_sigma_stat_rad_s=(gyro_sigma,) * 3,
        accel_sigma_stat_m_s2=(accel_sigma,) * 3,
        gyro_sigma_use_rad_s=(gyro_sigma,) * 3,
        accel_sigma_use_m_s2=(accel_sigma,) * 3,
        temperature_degc=25.0,
        warnings=(),
    )


def ideal_window(
    *,
    ned_body: Array,
    body_gradienter: Array,
    law: Literal["axis", "slope", "euler"],
    latitude_deg: float,
    gravity_m_s2: float,
    heading_deg: float,
    gyro_bias: Array,
    accel_bias: Array,
    sigma: float = 0.0,
) -> Window:
    """The window of one IMU with given biases (vehicle FRD) in a given attitude."""
    up = ned_body.T @ np.array([0.0, 0.0, -1.0])
    latitude = math.radians(latitude_deg)
    rate = ned_body.T @ np.array([RATE_RAD_S * math.cos(latitude), 0.0, -RATE_RAD_S * math.sin(latitude)])
    x_deg, y_deg = readings(body_gradienter.T @ up, law)
    return Window(
        start_s=0.0,
        end_s=10.0,
        imus=(imu_means(rate + gyro_bias, sigma, gravity_m_s2 * up + accel_bias, sigma),),
        tilt=TiltWindow(x_deg=x_deg, y_deg=y_deg, x_sigma_deg=0.0, y_sigma_deg=0.0, temperature_degc=None),
        heading=HeadingWindow(heading_deg=heading_deg % 360.0, sigma_deg=0.0),
    )
