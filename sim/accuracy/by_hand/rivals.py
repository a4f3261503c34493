"""What else is done with stands by hand, re-stated from its description; means in the sensor's axes, SI units.

- imu_tk (Tedaldi et al., ICRA 2014; `MultiPosCalibration::calibrateAcc`): 100 readings of each stand, all alike, a
  triangular matrix, least squares on the length of every reading.
- ArduPilot's six positions (`AccelCalibrator`; autopilots 3): half a second each, offsets and scales; the
  length of gravity is 9.80665 wherever it flies.
- PX4's (`accelerometer_calibration.cpp`; autopilots 4.6): 750 readings each, offsets are the middle of two opposite
  sides, scales the diagonal of the inverse of three sides, which are taken for exact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np

from sim.earth import STANDARD_GRAVITY_M_S2, Array

IMU_TK_READINGS: Final = 100
ARDUPILOT_READINGS: Final = 50
PX4_READINGS: Final = 750
_ROUNDS: Final = 15


class Found(NamedTuple):
    """Biases (3) and scales (3), such that reading = (1 + scale) force + bias, shear aside."""

    bias: Array
    scale: Array


def imu_tk(stands: Sequence[Array], gravity_m_s2: float) -> Found:
    """Of readings (n, 3) in each stand; gravity as long as it is at the place."""
    rows = np.concatenate([stand[:IMU_TK_READINGS] for stand in stands])

    def off(figures: Array) -> Array:
        return np.asarray(np.linalg.norm((rows - figures[6:]) @ _triangular(figures).T, axis=1) - gravity_m_s2)

    figures = _least_squares(off, np.concatenate([np.zeros(3), np.ones(3), np.zeros(3)]))
    # Of a triangular matrix times a rotation the symmetric one has the scales that belong to no rotation.
    left, sizes, _ = np.linalg.svd(np.linalg.inv(_triangular(figures)))
    response = left @ np.diag(sizes) @ left.T
    return Found(figures[6:], np.diag(response) - 1.0)


def _triangular(figures: Array) -> Array:
    yz, zy, zx = figures[:3]
    scales: Array = figures[3:6]
    return np.asarray(np.array([[1.0, -yz, zy], [0.0, 1.0, -zx], [0.0, 0.0, 1.0]]) * scales)


def ardupilot(sides: Sequence[Array]) -> Found:
    """Of readings (n, 3) on six sides."""
    means = np.array([side[:ARDUPILOT_READINGS].mean(axis=0) for side in sides])

    def off(figures: Array) -> Array:
        return np.asarray(np.linalg.norm((means - figures[:3]) * figures[3:], axis=1) - STANDARD_GRAVITY_M_S2)

    figures = _least_squares(off, np.concatenate([np.zeros(3), np.ones(3)]))
    return Found(figures[:3], 1.0 / figures[3:] - 1.0)


def px4(sides: Sequence[Array]) -> Found:
    """Of readings (n, 3) on the sides +x, -x, +y, -y, +z, -z upwards."""
    means = np.array([side[:PX4_READINGS].mean(axis=0) for side in sides])
    offset = np.array([(means[2 * axis, axis] + means[2 * axis + 1, axis]) / 2.0 for axis in range(3)])
    transform = np.linalg.inv(means[::2] - offset) * STANDARD_GRAVITY_M_S2
    return Found(offset, 1.0 / np.diag(transform) - 1.0)


def _least_squares(off: Callable[[Array], Array], figures: Array) -> Array:
    """Gauss-Newton with numerical derivatives."""
    for _ in range(_ROUNDS):
        residual = off(figures)
        slopes = np.array([(off(figures + 1e-6 * unit) - residual) / 1e-6 for unit in np.eye(len(figures))]).T
        step = np.linalg.lstsq(slopes, residual, rcond=None)[0]
        figures = figures - step
        if np.abs(step).max() < 1e-9:
            break
    return figures
