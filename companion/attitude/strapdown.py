"""Quaternion strapdown: integrate calibrated rates to attitude, and rotate the specific force.

Frame E is fixed to the Earth and near NED; leveller and heading hold the rest. Rotation vectors with two-sample coning,
phi_k = a_k + (a_{k-1} x a_k) / 12 (Savage; method 3.7). Plain floats: at these sizes ten times faster than arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

from companion.attitude.quaternion import (
    IDENTITY,
    Quaternion,
    Triple,
    from_rotation_vector,
    multiply,
    normalised,
    rotate,
)
from companion.samples import ImuSample

STEP_S: Final = 0.02
"""Length of the steps over which specific force is averaged for levelling."""
TURN_S: Final = 0.004
"""Longest time between rotations of the specific force into E: 4 degrees at 1000 deg/s."""
GAP_S: Final = 0.1
"""Silence beyond which the integration is a guess, counted as `missing_s`."""
_ROUNDING_S: Final = 1e-6
_ANGLE_SQUARE: Final = 1e6
_FORCE_SQUARE: Final = 1e8
"""Limits of one sample, squared: ten times those of the decoders, so that nothing overflows."""
LOST_S: Final = 1.0
"""Silence after which the attitude is lost."""


class MotionStep(NamedTuple):
    """Motion in about `STEP_S` seconds."""

    t_s: float
    span_s: float
    force_m_s2: Triple
    """Mean specific force in E."""
    rate_rad_s: Triple
    """Mean rate in the sensor's axes, bias removed."""
    missing_s: float
    """Time in it without samples."""
    orientation: Quaternion
    """Sensor axes to E at its end."""


class Strapdown:
    """Integrates the rates of one IMU in its own axes; `orientation` is sensor axes to E."""

    def __init__(self) -> None:
        self.orientation: Quaternion = IDENTITY
        self.bias_rad_s: Triple = (0.0, 0.0, 0.0)
        self.force_bias_m_s2: Triple = (0.0, 0.0, 0.0)
        self.frame_rate_rad_s: Triple = (0.0, 0.0, 0.0)
        """The Earth's rotation, in E."""
        self.last_s: float | None = None
        self.last_rate_rad_s: Triple = (0.0, 0.0, 0.0)
        self.lost = False
        self._previous: Triple = (0.0, 0.0, 0.0)
        self._clear()

    def restart(self, orientation: Quaternion, t_s: float | None) -> None:
        """Start from an orientation at `t_s`."""
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
        """Integrate samples in order of time; return the steps they complete."""
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
        """Return the seconds since the last sample; None where this one cannot be used."""
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
        """Rotate the specific force since the last call into E."""
        (vx, vy, vz), (fx, fy, fz) = self._velocity, rotate(self.orientation, self._unturned)
        self._velocity = (vx + fx, vy + fy, vz + fz)
        self._unturned, self._turn_s = (0.0, 0.0, 0.0), 0.0

    def _finished(self, t_s: float) -> MotionStep:
        """Return the complete step and begin the next."""
        (ex, ey, ez), half = self.frame_rate_rad_s, -0.5 * self._span_s
        self.orientation = normalised(multiply((1.0, half * ex, half * ey, half * ez), self.orientation))
        (vx, vy, vz), (ux, uy, uz), mean = self._velocity, self._angle, 1.0 / self._span_s
        force, rate = (vx * mean, vy * mean, vz * mean), (ux * mean, uy * mean, uz * mean)
        done = MotionStep(t_s, self._span_s, force, rate, self._missing_s, self.orientation)
        self._clear()
        return done
