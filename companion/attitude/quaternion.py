"""Unit quaternions as plain tuples (w, x, y, z), with Hamilton's product; tuples are faster than arrays of this size.

A quaternion `q` maps a vector's components from frame A to frame B: v_B = rotate(q, v_A). Multiplying on the left
rotates in B, on the right in A.
"""

from __future__ import annotations

import math

import numpy as np

from companion.physics.frames import Matrix

Quaternion = tuple[float, float, float, float]
Triple = tuple[float, float, float]

IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)
_NO_LENGTH = 1e-150


def multiply(p: Quaternion, q: Quaternion) -> Quaternion:
    """Return the product p q: the rotation by q, followed by the rotation by p."""
    pw, px, py, pz = p
    qw, qx, qy, qz = q
    return (
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    )


def conjugate(q: Quaternion) -> Quaternion:
    return (q[0], -q[1], -q[2], -q[3])


def normalised(q: Quaternion) -> Quaternion:
    """Scale a quaternion to length 1; raise ValueError if its length is zero or not finite."""
    w, x, y, z = q
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if not 0.0 < length < math.inf:
        raise ValueError("no rotation: length zero or not finite")
    return (w / length, x / length, y / length, z / length)


def rotate(q: Quaternion, v: Triple) -> Triple:
    w, x, y, z = q
    a, b, c = v
    tx, ty, tz = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return (a + w * tx + y * tz - z * ty, b + w * ty + z * tx - x * tz, c + w * tz + x * ty - y * tx)


def from_rotation_vector(v: Triple) -> Quaternion:
    x, y, z = v
    angle = math.sqrt(x * x + y * y + z * z)
    scale = math.sin(0.5 * angle) / angle if angle > 1e-9 else 0.5
    return (math.cos(0.5 * angle), scale * x, scale * y, scale * z)


def shortest_arc(a: Triple, b: Triple) -> Quaternion:
    """Return the smallest rotation from direction `a` to direction `b`; the identity if either has length zero."""
    length_a, length_b = math.hypot(*a), math.hypot(*b)
    if not (length_a > _NO_LENGTH and length_b > _NO_LENGTH):
        return IDENTITY
    ax, ay, az = a[0] / length_a, a[1] / length_a, a[2] / length_a
    bx, by, bz = b[0] / length_b, b[1] / length_b, b[2] / length_b
    w = 1.0 + ax * bx + ay * by + az * bz
    if w < 1e-9:
        # Opposite: half a turn about anything at right angles to `a`.
        x, y, z = (0.0, -az, ay) if abs(ax) < max(abs(ay), abs(az)) else (-az, 0.0, ax)
        return normalised((0.0, x, y, z))
    return normalised((w, ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))


def from_matrix(matrix: Matrix) -> Quaternion:
    """Convert a 3x3 rotation matrix to a quaternion, by Shepperd's choice of the largest element."""
    ((xx, xy, xz), (yx, yy, yz), (zx, zy, zz)) = np.asarray(matrix, dtype=np.float64).tolist()
    # The rows are multiples of the quaternion; the largest one is known best.
    rows = (
        (1.0 + xx + yy + zz, zy - yz, xz - zx, yx - xy),
        (zy - yz, 1.0 + xx - yy - zz, xy + yx, xz + zx),
        (xz - zx, xy + yx, 1.0 - xx + yy - zz, yz + zy),
        (yx - xy, xz + zx, yz + zy, 1.0 - xx - yy + zz),
    )
    return normalised(max(rows, key=lambda row: math.hypot(*row)))


def to_matrix(q: Quaternion) -> Matrix:
    return np.array([rotate(q, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]).T


def roll_pitch_yaw(q: Quaternion) -> Triple:
    """Return roll, pitch and yaw, rad, of a quaternion from body axes (FRD) to NED; yaw is in [-pi, pi].

    At pitch +-90 degrees roll and yaw are not separable: roll is then 0, and yaw carries both.
    """
    w, x, y, z = q
    sine = 2.0 * (w * y - z * x)
    if abs(sine) > 1.0 - 1e-12:
        pitch = math.copysign(0.5 * math.pi, sine)
        return 0.0, pitch, math.remainder(-2.0 * math.copysign(1.0, sine) * math.atan2(x, w), 2.0 * math.pi)
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(sine),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


def from_roll_pitch_yaw(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Quaternion:
    """Return the quaternion from body axes (FRD) to NED for roll, pitch and yaw."""
    roll, pitch = from_rotation_vector((roll_rad, 0.0, 0.0)), from_rotation_vector((0.0, pitch_rad, 0.0))
    return multiply(from_rotation_vector((0.0, 0.0, yaw_rad)), multiply(pitch, roll))
