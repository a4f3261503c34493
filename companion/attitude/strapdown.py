"""Quaternion strapdown: integration of calibrated rates to an attitude, with specific force and covariance.

Frame E is fixed to the Earth and close to NED; the module `estimator` holds the rotation from E to NED. Rotation
vectors have a two-sample coning correction, phi_k = a_k + (a_{k-1} x a_k) / 12 (Savage; method.md section 3.7). Plain
floats are ten times faster than arrays at these sizes.

The covariance has six states: attitude error in NED (rad) and gyro bias error in sensor axes (rad/s). The update has
Joseph's form, because the gains are not a Kalman filter's (method.md sections 2.2 and 3.7).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from companion.attitude.quaternion import (
    IDENTITY,
    Quaternion,
    Triple,
    from_rotation_vector,
    multiply,
    normalised,
    rotate,
)
from companion.config.sections import AllanModel
from companion.physics.frames import Array, Matrix
from companion.samples import ImuSample

STEP_S: Final = 0.02  # Length of the steps over which specific force is averaged for levelling
TURN_S: Final = 0.004
"""Longest time between two rotations of specific force into frame E (nearly NED): 4 degrees at 1000 deg/s."""
GAP_S: Final = 0.1
"""Longest gap between samples, s, without consequence; longer gaps add up as `missing_s`."""
_ROUNDING_S: Final = 1e-6
_ANGLE_SQUARE: Final = 1e6
_FORCE_SQUARE: Final = 1e8
"""Largest squared norm of a sample's specific force: ten times the decoders' limits, so that nothing overflows."""
LOST_S: Final = 1.0
"""Gap between samples, s, after which the attitude counts as lost."""


class MotionStep(NamedTuple):
    """Motion in an interval of about `STEP_S`: mean specific force, mean rotation rate, and orientation at its end."""

    t_s: float
    span_s: float
    force_m_s2: Triple  # Mean specific force in frame E (nearly NED)
    rate_rad_s: Triple  # Mean rate in the sensor's axes, bias removed
    missing_s: float
    orientation: Quaternion  # From sensor axes to frame E, at the end


class Strapdown:
    """Integrator of one IMU's rates in sensor axes; `orientation` rotates from sensor axes to frame E (nearly NED)."""

    def __init__(self) -> None:
        self.orientation: Quaternion = IDENTITY
        self.bias_rad_s: Triple = (0.0, 0.0, 0.0)
        self.force_bias_m_s2: Triple = (0.0, 0.0, 0.0)
        self.frame_rate_rad_s: Triple = (0.0, 0.0, 0.0)
        """Rotation rate of the Earth, in frame E (nearly NED)."""
        self.last_s: float | None = None
        self.last_rate_rad_s: Triple = (0.0, 0.0, 0.0)
        self.lost = False
        self._previous: Triple = (0.0, 0.0, 0.0)
        self._clear()

    def restart(self, orientation: Quaternion, t_s: float | None) -> None:
        self.orientation, self.last_s, self.lost = orientation, t_s, False
        self._previous = (0.0, 0.0, 0.0)
        self._clear()

    def _clear(self) -> None:
        self._span_s = 0.0
        self._missing_s = 0.0
        self._angle: Triple = (0.0, 0.0, 0.0)
        self._velocity: Triple = (0.0, 0.0, 0.0)
        self._unturned: Triple = (0.0, 0.0, 0.0)
        self._turn_s = 0.0

    def integrate(self, samples: Sequence[ImuSample]) -> list[MotionStep]:
        done: list[MotionStep] = []
        for sample in samples:
            if (dt := self._since_last(sample)) is None:
                continue
            (gx, gy, gz), (bx, by, bz) = sample.gyro_rad_s, self.bias_rad_s
            (fx, fy, fz), (cx, cy, cz) = sample.accel_m_s2, self.force_bias_m_s2
            (px, py, pz), (ux, uy, uz), (sx, sy, sz) = self._previous, self._angle, self._unturned
            ax, ay, az = (gx - bx) * dt, (gy - by) * dt, (gz - bz) * dt
            rx = ax + (py * az - pz * ay) / 12.0
            ry = ay + (pz * ax - px * az) / 12.0
            rz = az + (px * ay - py * ax) / 12.0
            if not (rx * rx + ry * ry + rz * rz < _ANGLE_SQUARE and fx * fx + fy * fy + fz * fz < _FORCE_SQUARE):
                self._missing_s += dt  # impossible values
                continue
            self._previous = (ax, ay, az)
            self.orientation = multiply(self.orientation, from_rotation_vector((rx, ry, rz)))
            self._angle = (ux + ax, uy + ay, uz + az)
            self._unturned = (sx + (fx - cx) * dt, sy + (fy - cy) * dt, sz + (fz - cz) * dt)
            self._turn_s += dt
            self._span_s += dt
            if self._turn_s > TURN_S - _ROUNDING_S:
                self._turn()
                if self._span_s > STEP_S - _ROUNDING_S:
                    done.append(self._finished(sample.t_s))
        if samples:
            (gx, gy, gz), (bx, by, bz) = samples[-1].gyro_rad_s, self.bias_rad_s
            self.last_rate_rad_s = (gx - bx, gy - by, gz - bz)
        return done

    def _since_last(self, sample: ImuSample) -> float | None:
        if self.last_s is None:
            self.last_s = sample.t_s
            return None
        dt = sample.t_s - self.last_s
        if not dt > 0.0:
            return None
        self.last_s = sample.t_s
        if dt > GAP_S:
            self._missing_s += dt
        if dt > LOST_S:
            self.lost, self._previous = True, (0.0, 0.0, 0.0)
            return None
        return dt

    def _turn(self) -> None:
        (vx, vy, vz), (fx, fy, fz) = self._velocity, rotate(self.orientation, self._unturned)
        self._velocity = (vx + fx, vy + fy, vz + fz)
        self._unturned, self._turn_s = (0.0, 0.0, 0.0), 0.0

    def _finished(self, t_s: float) -> MotionStep:
        (ex, ey, ez), half = self.frame_rate_rad_s, -0.5 * self._span_s
        self.orientation = normalised(multiply((1.0, half * ex, half * ey, half * ez), self.orientation))
        (vx, vy, vz), (ux, uy, uz), mean = self._velocity, self._angle, 1.0 / self._span_s
        force, rate = (vx * mean, vy * mean, vz * mean), (ux * mean, uy * mean, uz * mean)
        done = MotionStep(t_s, self._span_s, force, rate, self._missing_s, self.orientation)
        self._clear()
        return done


SCALE_SHARE: Final = 0.003
"""Scale error and misalignment of a trimmed consumer gyro, as a share of the net turn since the last correction."""
GAP_RATE_RAD_S: Final = math.radians(20.0)
"""Assumed error of the rotation rate while samples were missing."""
MANOEUVRE_M_S2: Final = {"ground": 0.05, "flight": 0.6}
"""Horizontal acceleration of the aircraft that averaging leaves and the specific force's length does not show."""
MANOEUVRE_LASTS_S: Final = 2.0
HEADING_UNKNOWN_RAD: Final = math.pi / math.sqrt(3.0)
_BIAS_WANDERS_S: Final = 300.0
"""Time in which a consumer gyro's bias moves by the floor of its Allan deviation, s."""


class Uncertainty:
    """Covariance of the attitude error and of the gyro bias error.

    `bias_covariance` (3, 3) is for the calibrated gyro bias, in sensor axes. Accelerometer bias adds a constant tilt.
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
        """Start again from the covariance of an aligned attitude, (3, 3) in NED, rad^2."""
        self._covariance = np.zeros((6, 6))
        self._covariance[:3, :3] = attitude_covariance
        self._covariance[3:, 3:] = self._bias_start
        self._levelled = 0.0
        self._turned = np.zeros(3)

    def propagate(self, span_s: float, ned_from_sensor: Matrix, turned_rad: Array, missing_s: float) -> None:
        """Add the errors that arise in `span_s` while the sensor turns by `turned_rad` (3,) about its own axes."""
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
        """Return one sigma (3,), in sensor axes, of the mean rate that gyros measure in `seconds` at rest."""
        return np.sqrt(np.maximum(np.diag(self._covariance)[3:], 0.0) + self._rest_variance(seconds))

    def rest(self, seconds: float) -> Matrix:
        """Update the covariance after `seconds` at rest; return the gain (6, 3) for the mean rate in sensor axes."""
        variance = self._rest_variance(seconds)
        part = self._covariance[:, 3:]
        gain = np.linalg.solve(self._covariance[3:, 3:] + np.eye(3) * variance, part.T).T
        self._covariance = self._covariance - gain @ part.T
        self._covariance = 0.5 * (self._covariance + self._covariance.T)
        return np.asarray(gain)

    @property
    def attitude(self) -> Matrix:
        """Covariance (3, 3) of the attitude error in NED, rad^2."""
        result = self._covariance[:3, :3].copy()
        result[range(2), range(2)] += self._levelled**2 * self._level_variance
        result[range(3), range(3)] += np.square(SCALE_SHARE * self._turned)
        return result

    @property
    def heading_sigma_rad(self) -> float:
        variance = float(self._covariance[2, 2]) + (SCALE_SHARE * float(self._turned[2])) ** 2
        return min(math.sqrt(max(variance, 0.0)), HEADING_UNKNOWN_RAD)
