"""A coarse stand-in for EKF3: a gyro bias estimate that goes stale after a write, and an attitude that follows.

Only effects that matter to a companion (autopilots 1.7 and 9.3.1): after a step in the offsets the old estimate stays
and fades over about two minutes; the autopilot's own gyro calibration resets it; a horizontal accelerometer error
becomes a tilt error; after a boot the vertical estimate is wrong by hundreds of deg/h for a while.
"""

from __future__ import annotations

import math

import numpy as np

from sim.earth import STANDARD_GRAVITY_M_S2, Array
from sim.imu_model import DEG_H

_BIAS_FADES_S = 40.0
_TILT_FADES_S = 10.0
_YAW_FADES_S = 40.0
"""Time constant of a wrong heading's decay: 5 deg at 40 s after a step of 0.3 deg/s, under 1 deg at 140 s."""
_TILT_PART_1_S = 0.135
_TILT_PART_FADES_S = 9.0
"""Time constant of a wrong gyro bias after a reset of the gyro biases: the estimator takes part of a tilt error for
gyro bias. 1.75 deg give 850 deg/h for half a minute, as in the real firmware after a step of 30 mg.
"""
_START_ERROR_RAD_S = np.array([60.0, 40.0, -1500.0]) * DEG_H


class CoarseEstimator:
    """Estimates of EKF3 in vehicle FRD; `update` receives the present errors of the corrected IMU output."""

    def __init__(self) -> None:
        self.gyro_bias_rad_s = np.zeros(3)
        self.tilt_error_rad = np.zeros(2)
        """Errors of the estimated roll and pitch."""
        self.yaw_error_rad = 0.0
        self.compass = True
        """True: a compass corrects a wrong heading."""
        self._start_error = np.zeros(3)
        self._tilt_part: Array = np.zeros(3)
        self._tilt_goal: Array = np.zeros(2)
        self._time_s = 0.0
        self.reset(0.0)

    def reset(self, t_s: float) -> None:
        """Start at this time without any estimate; at first the vertical gyro bias is estimated wrongly."""
        self.gyro_bias_rad_s[:] = 0.0
        self.tilt_error_rad[:] = 0.0
        self.yaw_error_rad = 0.0
        self._start_error[:] = _START_ERROR_RAD_S
        self._tilt_part[:] = 0.0
        self._time_s = t_s

    def reset_gyro_bias(self) -> None:
        """Reset the gyro bias, as the autopilot's own gyro calibration does."""
        self.gyro_bias_rad_s[:] = 0.0
        self._start_error[:] = 0.0
        self._tilt_part[:2] = _TILT_PART_1_S * (self._tilt_goal - self.tilt_error_rad)

    @property
    def omega_i(self) -> Array:
        """Return AHRS.omegaI, which is minus the estimated gyro bias."""
        result: Array = -(self.gyro_bias_rad_s + self._start_error + self._tilt_part)
        return result

    def update(self, t_s: float, gyro_error: Array, accel_error: Array) -> None:
        """Advance to this time, with the errors (output minus truth) since the last update."""
        tilt = np.array([-accel_error[1], accel_error[0]]) / STANDARD_GRAVITY_M_S2
        span = max(t_s - self._time_s, 0.0)
        stays = math.exp(-span / _BIAS_FADES_S)
        # The heading turns by what the estimate does not know; both fade at the same rate.
        unknown = float(gyro_error[2] - self.gyro_bias_rad_s[2])
        self.yaw_error_rad += unknown * span
        if self.compass:
            self.yaw_error_rad *= math.exp(-span / _YAW_FADES_S)
        self.gyro_bias_rad_s += (1.0 - stays) * (gyro_error - self.gyro_bias_rad_s)
        self._start_error *= stays
        self._tilt_part *= math.exp(-span / _TILT_PART_FADES_S)
        self._tilt_goal = tilt
        self.tilt_error_rad += (1.0 - math.exp(-span / _TILT_FADES_S)) * (tilt - self.tilt_error_rad)
        self._time_s = t_s
