"""Covariance of the attitude, for the gains in use, which are not a Kalman filter's (Joseph's form).

Six states: attitude error in NED (rad) and gyro bias error in the sensor's axes (rad/s). Method 2.2 and 3.7.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from companion.attitude.quaternion import Triple
from companion.config.sections import AllanModel
from companion.physics.frames import Array, Matrix

SCALE_SHARE: Final = 0.003
"""Scale error and misalignment of a trimmed consumer gyro, times the net turn since the last correction."""
GAP_RATE_RAD_S: Final = math.radians(20.0)
"""Error of the rate while samples were missing."""
MANOEUVRE_M_S2: Final = {"ground": 0.05, "flight": 0.6}
"""Horizontal acceleration after averaging that does not show in the length of the force."""
MANOEUVRE_LASTS_S: Final = 2.0
HEADING_UNKNOWN_RAD: Final = math.pi / math.sqrt(3.0)
"""One sigma of an unknown heading."""
_BIAS_WANDERS_S: Final = 300.0
"""Time in which a bias moves by the floor of its Allan deviation, for consumer gyros."""


class Uncertainty:
    """Covariance of attitude and gyro bias.

    `bias_covariance`: (3, 3) of the gyro bias, sensor axes, by sigma_use. The accelerometer bias adds a constant tilt.
    """

    def __init__(
        self, noise: AllanModel, bias_covariance: Matrix, accel_sigma_m_s2: Triple, gravity_m_s2: float
    ) -> None:
        self._noise = noise
        self._gravity = gravity_m_s2
        self._level_variance = (max(accel_sigma_m_s2) / gravity_m_s2) ** 2
        self._bias_start = np.asarray(bias_covariance, dtype=np.float64)
        self.restart(np.eye(3) * HEADING_UNKNOWN_RAD**2)

    def restart(self, attitude_covariance: Matrix) -> None:
        """Start from the covariance of an alignment, (3, 3) in NED, rad^2."""
        self._covariance = np.zeros((6, 6))
        self._covariance[:3, :3] = attitude_covariance
        self._covariance[3:, 3:] = self._bias_start
        self._levelled = 0.0
        self._turned = np.zeros(3)

    def propagate(self, span_s: float, ned_from_sensor: Matrix, turned_rad: Array, missing_s: float) -> None:
        """Add the errors of `span_s` with a turn by `turned_rad` (3,) about the sensor's axes."""
        step = np.eye(6)
        step[:3, 3:] = -span_s * ned_from_sensor
        self._covariance = step @ self._covariance @ step.T
        white = self._noise.white**2 * span_s
        turned = ned_from_sensor @ turned_rad
        self._turned += turned
        guessed = (GAP_RATE_RAD_S * missing_s) ** 2
        wander = (self._noise.walk**2 + self._noise.floor**2 / _BIAS_WANDERS_S) * span_s
        self._covariance[range(6), range(6)] += [white + guessed] * 3 + [wander] * 3

    def level(self, span_s: float, tau_s: float, believed: float, doubt: float, phase: str) -> None:
        """Add a correction by the leveller over `span_s`."""
        gain = min(1.0, span_s * believed / tau_s)
        keep = np.eye(6)
        keep[0, 0] = keep[1, 1] = 1.0 - gain
        acceleration = max(MANOEUVRE_M_S2[phase], doubt * self._gravity)
        variance = (acceleration / self._gravity) ** 2 * 2.0 * MANOEUVRE_LASTS_S / span_s
        self._covariance = keep @ self._covariance @ keep.T
        self._covariance[range(2), range(2)] += gain**2 * variance
        self._turned[:2] *= 1.0 - gain
        self._levelled += (1.0 - self._levelled) * gain

    def head(self, gain: float, sigma_rad: float) -> None:
        """Add a correction by a heading with this sigma."""
        keep = np.eye(6)
        keep[2, 2] = 1.0 - gain
        self._turned[2] *= 1.0 - gain
        self._covariance = keep @ self._covariance @ keep.T
        # The error of a compass is constant for minutes: readings do not average it.
        known = math.sqrt(max(self._covariance[2, 2], 0.0))
        self._covariance[2, 2] = (known + gain * sigma_rad) ** 2

    def _rest_variance(self, seconds: float) -> float:
        return self._noise.white**2 / seconds + self._noise.floor**2

    def rest_sigma(self, seconds: float) -> Array:
        """Return the sigma of the mean rate of a rest, (3,), sensor axes."""
        return np.sqrt(np.maximum(np.diag(self._covariance)[3:], 0.0) + self._rest_variance(seconds))

    def rest(self, seconds: float) -> Matrix:
        """Add a rest; return the gain (6, 3) for its mean rate, sensor axes."""
        variance = self._rest_variance(seconds)
        part = self._covariance[:, 3:]
        gain = np.linalg.solve(self._covariance[3:, 3:] + np.eye(3) * variance, part.T).T
        self._covariance = self._covariance - gain @ part.T
        self._covariance = 0.5 * (self._covariance + self._covariance.T)
        return np.asarray(gain)

    @property
    def attitude(self) -> Matrix:
        """Return the covariance (3, 3) of the attitude error in NED, rad^2."""
        result = self._covariance[:3, :3].copy()
        result[range(2), range(2)] += self._levelled**2 * self._level_variance
        result[range(3), range(3)] += np.square(SCALE_SHARE * self._turned)
        return result

    @property
    def heading_sigma_rad(self) -> float:
        """Return one sigma of the heading, at most that of an unknown one."""
        variance = float(self._covariance[2, 2]) + (SCALE_SHARE * float(self._turned[2])) ** 2
        return min(math.sqrt(max(variance, 0.0)), HEADING_UNKNOWN_RAD)
