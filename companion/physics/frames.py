"""Coordinate frames and rotations.

Body axes are FRD (x forward, y right, z down), as in MAVLink messages; navigation axes are NED. The paper on which the
method is based has RFU (x right, y forward, z up) and ENU instead. Theta is pitch (nose up +), gamma is roll (right
side down +), psi is heading, clockwise from true north; they are the aerospace 3-2-1 angles (method.md section 1.1).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from companion.physics.units import DEG
from companion.rotations import ROTATIONS_DEG
from companion.samples import Vector

Floats = NDArray[np.float64]
Matrix = Floats
Array = Floats


def body_from_ned(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Matrix:
    """Return the direction cosine matrix C_n^b, 3x3, which converts a vector from NED to body axes (FRD).

    It is equation (5) of the method's paper, corrected. The paper has the wrong sign in the second terms of T11 and
    T12, and the cosine of the latitude instead of cos(theta) in row 2 (method.md section 1.3).
    """
    sr, cr = math.sin(roll_rad), math.cos(roll_rad)
    st, ct = math.sin(pitch_rad), math.cos(pitch_rad)
    sp, cp = math.sin(yaw_rad), math.cos(yaw_rad)
    return np.array(
        [
            [ct * cp, ct * sp, -st],
            [sr * st * cp - cr * sp, sr * st * sp + cr * cp, sr * ct],
            [cr * st * cp + sr * sp, cr * st * sp - sr * cp, cr * ct],
        ]
    )


def rotation_matrix(mounting: str | tuple[float, float, float]) -> Matrix:
    """Return the 3x3 matrix from sensor to vehicle axes for a MAVLink rotation, or for roll, pitch, yaw in degrees."""
    angles_deg = ROTATIONS_DEG[mounting] if isinstance(mounting, str) else mounting
    matrix = body_from_ned(*(angle * DEG for angle in angles_deg)).T
    if all(angle % 90.0 == 0.0 for angle in angles_deg):
        return np.rint(matrix) + 0.0  # exact for multiples of 90 degrees, without negative zeros
    return matrix


def vector(values: Array) -> Vector:
    x, y, z = values.tolist()
    return x, y, z


def skew(vectors: Floats) -> Floats:
    """Return the cross-product matrices [v x], (..., 3, 3), of vectors (..., 3)."""
    found = np.zeros((*vectors.shape, 3))
    x, y, z = np.moveaxis(vectors, -1, 0)
    found[..., 0, 1], found[..., 0, 2], found[..., 1, 2] = -z, y, -x
    found[..., 1, 0], found[..., 2, 0], found[..., 2, 1] = z, -y, x
    return found


def symmetric(beside: Floats) -> Floats:
    """Return symmetric matrices (..., 3, 3) with a zero diagonal, from their elements xy, xz and yz, (..., 3)."""
    xy, xz, yz = np.moveaxis(beside, -1, 0)
    zero = np.zeros_like(xy)
    return np.stack([zero, xy, xz, xy, zero, yz, xz, yz, zero], axis=-1).reshape(*beside.shape, 3)


def symmetric_by(vector: Array) -> Matrix:
    """Return the derivative, 3x3, of `symmetric(beside) @ vector` by the elements xy, xz and yz."""
    x, y, z = vector
    return np.array([[y, z, 0.0], [x, 0.0, z], [0.0, x, y]])


def rotations(vectors: Floats) -> Floats:
    """Return the rotation matrices (..., 3, 3) of rotation vectors (..., 3) in rad, by Rodrigues' formula."""
    angle2 = np.einsum("...i,...i->...", vectors, vectors)
    angle = np.sqrt(angle2)
    small = angle < 1e-4
    divisor = np.where(small, 1.0, angle)
    sine = np.where(small, 1.0 - angle2 / 6.0, np.sin(angle) / divisor)
    cosine = np.where(small, 0.5 - angle2 / 24.0, (1.0 - np.cos(angle)) / np.square(divisor))
    cross = skew(vectors)
    return np.asarray(np.eye(3) + sine[..., None, None] * cross + cosine[..., None, None] * (cross @ cross))


def running_products(turns: Floats) -> Floats:
    """Return products of the first 1, 2, ... n matrices (n, 3, 3), in a few numpy calls (Hillis and Steele's scan)."""
    found, step = turns.copy(), 1
    while step < len(found):
        found[step:] = found[:-step] @ found[step:]
        step *= 2
    return found


def wrap_deg(angle_deg: float) -> float:
    return (angle_deg + 180.0) % 360.0 - 180.0


def roll_pitch_from_up(up: Array) -> tuple[float, float]:
    """Return roll gamma and pitch theta, rad, from the unit vector (3,) that points up, in body axes (FRD)."""
    return math.atan2(-up[1], -up[2]), math.atan2(up[0], math.hypot(up[1], up[2]))
