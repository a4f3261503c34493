"""Attitude of the aircraft, estimated from one calibrated IMU, a compass and the site (method.md section 3.7).

Calibrated rates minus the Earth's rotation are integrated; a slow leveller corrects the tilt, a scalar gain the
heading. Gyro biases are refined at rest only: in flight a manoeuvre looks like a bias.

Levelling has the form of VQF (Laidig and Seel, Information Fusion 91:187-204, 2023): specific force is low-passed in a
frame that only gyro errors turn. Over the time constant tau, manoeuvre accelerations average out and gravity stays; a
gyro bias b leaves a tilt of b * tau. A lasting turn or climb does not average out, but makes the force longer or
shorter than g: then the force has less weight.

The compass corrects the heading through a gate, never the tilt. A compass' own tilt comes from a pendulum, which is
wrong while the aircraft accelerates or is steep (method.md section 3.5).
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Sequence
from typing import Final, Literal

import msgspec
import numpy as np

from companion.attitude.quaternion import (
    IDENTITY,
    Quaternion,
    Triple,
    conjugate,
    from_matrix,
    from_rotation_vector,
    multiply,
    normalised,
    roll_pitch_yaw,
    rotate,
    shortest_arc,
    to_matrix,
)
from companion.attitude.strapdown import HEADING_UNKNOWN_RAD, MotionStep, Strapdown, Uncertainty
from companion.config.sections import AllanModel
from companion.physics.earth import earth_rate_ned_rad_s
from companion.physics.frames import Matrix
from companion.samples import ImuSample

Phase = Literal["ground", "flight"]

LEVEL_TAU_S: Final[dict[Phase, float]] = {"ground": 3.0, "flight": 30.0}
STEADY_SHARE: Final = 0.03
"""Largest difference of specific force from g, as a share of g, at which a self-levelling compass is used."""
STEADY_RAD_S: Final = math.radians(20.0)  # Largest rate at which the compass is used
COVARIANCE_STEP_S: Final = 0.2
REST_S: Final = 1.0
REST_SIGMAS: Final = 5.0  # Threshold above which a rest counts as an undetected movement
KEPT_S: Final = 2.0  # Span of orientations stored for late compass readings
FORCE_SMOOTHED_S: Final = 1.0
"""Averaging time of the specific force's length, s; longer than vibration and gusts."""
DOUBTED_SHARE: Final = 0.03
"""Difference of specific force from g, as a share of g, that halves the force's weight: three times the scale error of
accelerometers. In a turn beyond 15 degrees of bank, levelling adds more tilt error than a calibrated gyro's drift."""
_UP: Final = (0.0, 0.0, -1.0)

TAU_S: Final = 9.0
"""Time constant of the heading correction, s; the first readings after an alignment without heading count more."""
GATE_SIGMAS: Final = 4.0
GATE_LEAST_RAD: Final = math.radians(10.0)
STEEP_RAD: Final = math.radians(60.0)
FIRST_S: Final = 0.1  # Time span assigned to the first reading
POORLY_KNOWN_RATIO: Final = 1.5
"""Ratio of heading sigma to compass sigma above which the heading counts as poorly known."""
REFUSED_S: Final = 20.0
"""Time, s, in which all compass readings are rejected, after which the companion stops sending the heading."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class AttitudeSettings:
    """Calibration results and site data that the estimator needs, in vehicle axes (FRD)."""

    vehicle_from_sensor: Matrix
    gravity_m_s2: float
    latitude_deg: float | None
    """Latitude of the site; None: the Earth's rotation is not subtracted, an error of up to 15 deg/h."""
    gyro_noise: AllanModel
    gyro_bias_rad_s: Triple
    gyro_covariance: Matrix  # (3, 3) covariance of the bias in the next minutes
    accel_bias_m_s2: Triple
    accel_sigma_m_s2: Triple


class Attitude(msgspec.Struct, frozen=True, gc=False):
    """Attitude at one instant, from body axes (FRD) to NED and true north, with one sigma of roll, pitch and yaw.

    `rate_rad_s` is the rotation rate of the body relative to the Earth, in FRD, without bias.
    """

    t_s: float
    quaternion: Quaternion
    """Components w, x, y, z of the rotation from body axes to NED; w >= 0."""
    roll_rad: float
    pitch_rad: float
    yaw_rad: float  # In [-pi, pi], from true north
    rate_rad_s: Triple
    sigma_rad: Triple  # One sigma of roll, pitch and yaw


class Leveller:
    """Estimator of the rotation from frame E (nearly NED) to NED that makes the mean specific force vertical."""

    def __init__(self, gravity_m_s2: float) -> None:
        self.gravity_m_s2 = gravity_m_s2
        self.ned_from_e: Quaternion = IDENTITY
        self.doubt = 0.0
        """Smoothed deviation of the specific force's length from gravity, as a share of g."""
        self._force: Triple = (0.0, 0.0, -gravity_m_s2)
        self._slope: Triple = (0.0, 0.0, 0.0)
        self._length = gravity_m_s2

    def update(self, force_m_s2: Triple, span_s: float, tau_s: float) -> float:
        """Add the mean specific force (3,) over `span_s`, in frame E (nearly NED); return its weight, at most 1.

        The filter is a second-order Butterworth low-pass with natural frequency sqrt(2) / tau; tau can change.
        """
        x, y, z = force_m_s2
        length = math.sqrt(x * x + y * y + z * z)
        self._length += (length - self._length) * min(1.0, span_s / FORCE_SMOOTHED_S)
        self.doubt = abs(self._length - self.gravity_m_s2) / self.gravity_m_s2
        believed = 1.0 / (1.0 + (self.doubt / DOUBTED_SHARE) ** 2)
        omega = math.sqrt(2.0) / tau_s
        # The weight scales the time step. Semi-implicit, hence stable up to omega * step = 1; the longest span is far
        # shorter than the shortest tau.
        step = min(believed * span_s, 0.5 / omega)
        damped, pulled = 1.0 / (1.0 + math.sqrt(2.0) * omega * step), omega * omega * step
        fx, fy, fz = self._force
        sx, sy, sz = self._slope
        sx, sy, sz = (
            (sx + pulled * (x - fx)) * damped,
            (sy + pulled * (y - fy)) * damped,
            (sz + pulled * (z - fz)) * damped,
        )
        self._slope = (sx, sy, sz)
        self._force = (fx + sx * step, fy + sy * step, fz + sz * step)
        found = rotate(self.ned_from_e, self._force)
        self.ned_from_e = normalised(multiply(shortest_arc(found, _UP), self.ned_from_e))
        return believed


class HeadingAid:
    """Gain and rejection gate of the heading correction by a compass."""

    def __init__(self) -> None:
        self._last_s: float | None = None
        self._refused_since_s: float | None = None

    def gain(self, t_s: float, innovation_rad: float, sigma_rad: float, compass_sigma_rad: float) -> float:
        """Return the gain for a compass innovation, 0 if the gate rejects it; `sigma_rad`: of the estimated heading."""
        gate = max(GATE_LEAST_RAD, GATE_SIGMAS * math.hypot(sigma_rad, compass_sigma_rad))
        if not abs(innovation_rad) <= gate:
            if self._refused_since_s is None:
                self._refused_since_s = t_s
            return 0.0
        since_s = FIRST_S if self._last_s is None else max(0.0, t_s - self._last_s)
        self._last_s, self._refused_since_s = t_s, None
        # The first reading sets a poorly known heading; after that the time constant applies. A heading that the
        # compass corrects has the compass sigma plus gyro drift since then: it is not poorly known.
        badly_rad = POORLY_KNOWN_RATIO * compass_sigma_rad
        trust = 1.0 - (badly_rad / sigma_rad) ** 2 if sigma_rad > badly_rad else 0.0
        return max(trust, min(1.0, since_s / TAU_S))

    def refused_for_s(self, t_s: float) -> float:
        return 0.0 if self._refused_since_s is None else t_s - self._refused_since_s


class AttitudeEstimator:
    """Estimator of the aircraft's attitude, called once per batch of samples; no sample value raises an exception."""

    def __init__(self, settings: AttitudeSettings) -> None:
        self._strapdown = Strapdown()
        self.compass = HeadingAid()
        self._history: deque[tuple[float, Quaternion]] = deque()
        self._aligned = False
        self._still_s = 0.0
        self._still_angle: Triple = (0.0, 0.0, 0.0)
        self._waiting_s = self._missing_s = 0.0
        self._turned_rad: Triple = (0.0, 0.0, 0.0)
        self._settle(settings)
        self._leveller = Leveller(settings.gravity_m_s2)

    def settle(self, settings: AttitudeSettings) -> None:
        """Switch to a newer calibration; keep the attitude, and restart the covariance of the gyro bias from it."""
        kept = self._uncertainty.attitude
        self._settle(settings)
        self._leveller.gravity_m_s2 = settings.gravity_m_s2
        self._uncertainty.restart(kept)

    def _settle(self, settings: AttitudeSettings) -> None:
        self._settings = settings
        turn = settings.vehicle_from_sensor
        self._sensor_from_vehicle = from_matrix(turn.T)
        self._strapdown.bias_rad_s = rotate(self._sensor_from_vehicle, settings.gyro_bias_rad_s)
        self._strapdown.force_bias_m_s2 = rotate(self._sensor_from_vehicle, settings.accel_bias_m_s2)
        latitude = settings.latitude_deg
        north, east, down = (0.0, 0.0, 0.0) if latitude is None else earth_rate_ned_rad_s(latitude).tolist()
        self._earth: Triple = (north, east, down)
        covariance, sigma = turn.T @ settings.gyro_covariance @ turn, settings.accel_sigma_m_s2
        self._uncertainty = Uncertainty(settings.gyro_noise, covariance, sigma, settings.gravity_m_s2)

    # --- alignment

    def align(self, t_s: float | None, body_from_ned: Matrix, covariance: Matrix) -> None:
        """Start from a known attitude (3, 3) at `t_s` (None: at the next sample); `covariance` (3, 3) is in NED, rad^2.

        An unknown heading may have any value, with a variance of at least `HEADING_UNKNOWN_RAD` squared.
        """
        ned_from_body = from_matrix(np.asarray(body_from_ned).T)
        self._strapdown.restart(multiply(ned_from_body, conjugate(self._sensor_from_vehicle)), t_s)
        self._leveller, self.compass = Leveller(self._settings.gravity_m_s2), HeadingAid()
        self._uncertainty.restart(np.asarray(covariance))
        self._history.clear()
        self._forget_rest()
        self._waiting_s = self._missing_s = 0.0
        self._turned_rad = (0.0, 0.0, 0.0)
        self._aligned = True

    @property
    def aligned(self) -> bool:
        return self._aligned and not self._strapdown.lost

    @property
    def heading_known(self) -> bool:
        return self.aligned and self._uncertainty.heading_sigma_rad < 0.5 * HEADING_UNKNOWN_RAD

    @property
    def gyro_bias_rad_s(self) -> Triple:
        return rotate(conjugate(self._sensor_from_vehicle), self._strapdown.bias_rad_s)

    # --- samples

    def update(
        self, samples: Sequence[ImuSample], *, phase: Phase, still: bool = False, airspeed_m_s: float | None = None
    ) -> None:
        """Process samples, in the sensor's axes and in order of time; before an alignment, samples are ignored.

        `still`: motionless, so that gyro biases are refined. `airspeed_m_s`: subtract omega x V from specific force.
        """
        if not self._aligned:
            return
        self._strapdown.frame_rate_rad_s = rotate(conjugate(self._leveller.ned_from_e), self._earth)
        for step in self._strapdown.integrate(samples):
            self._take(step, phase, still=still, airspeed_m_s=airspeed_m_s)

    def _take(self, step: MotionStep, phase: Phase, *, still: bool, airspeed_m_s: float | None) -> None:
        leveller, span_s, force = self._leveller, step.span_s, step.force_m_s2
        if airspeed_m_s is not None:
            force = self._without_turning(force, step, airspeed_m_s)
        tau_s = LEVEL_TAU_S[phase]
        believed = leveller.update(force, span_s, tau_s)
        self._remember(step)
        rx, ry, rz = step.rate_rad_s
        tx, ty, tz = self._turned_rad
        self._turned_rad = (tx + rx * span_s, ty + ry * span_s, tz + rz * span_s)
        self._waiting_s += span_s
        self._missing_s += step.missing_s
        if self._waiting_s >= COVARIANCE_STEP_S:
            ned_from_sensor = to_matrix(multiply(leveller.ned_from_e, step.orientation))
            self._uncertainty.propagate(self._waiting_s, ned_from_sensor, np.asarray(self._turned_rad), self._missing_s)
            self._uncertainty.level(self._waiting_s, tau_s, believed, leveller.doubt, phase)
            self._waiting_s = self._missing_s = 0.0
            self._turned_rad = (0.0, 0.0, 0.0)
        if still and phase == "ground" and not step.missing_s:
            self._rest(step)
        else:
            self._forget_rest()

    def _without_turning(self, force: Triple, step: MotionStep, airspeed_m_s: float) -> Triple:
        vx, vy, vz = rotate(self._sensor_from_vehicle, (airspeed_m_s, 0.0, 0.0))
        wx, wy, wz = step.rate_rad_s
        turning = (wy * vz - wz * vy, wz * vx - wx * vz, wx * vy - wy * vx)
        tx, ty, tz = rotate(step.orientation, turning)
        return force[0] - tx, force[1] - ty, force[2] - tz

    def _remember(self, step: MotionStep) -> None:
        history = self._history
        history.append((step.t_s, step.orientation))
        while history[0][0] < step.t_s - KEPT_S:
            history.popleft()

    # --- rest

    def _forget_rest(self) -> None:
        self._still_s = 0.0
        self._still_angle = (0.0, 0.0, 0.0)

    def _rest(self, step: MotionStep) -> None:
        span_s = step.span_s
        rx, ry, rz = step.rate_rad_s
        ax, ay, az = self._still_angle
        self._still_s += span_s
        self._still_angle = (ax + rx * span_s, ay + ry * span_s, az + rz * span_s)
        if self._still_s < REST_S:
            return
        sensor_from_ned = conjugate(multiply(self._leveller.ned_from_e, step.orientation))
        left = np.asarray(self._still_angle) / self._still_s - np.asarray(rotate(sensor_from_ned, self._earth))
        if np.any(np.abs(left) > REST_SIGMAS * self._uncertainty.rest_sigma(self._still_s)):
            self._forget_rest()
            return
        gain = self._uncertainty.rest(self._still_s)
        # Both states are true value minus estimate: add the correction to the bias, and turn the attitude by it.
        found = gain @ left
        bx, by, bz = self._strapdown.bias_rad_s
        self._strapdown.bias_rad_s = (bx + float(found[3]), by + float(found[4]), bz + float(found[5]))
        turn = from_rotation_vector((float(found[0]), float(found[1]), float(found[2])))
        self._leveller.ned_from_e = normalised(multiply(turn, self._leveller.ned_from_e))
        self._forget_rest()

    # --- compass

    def add_heading(self, t_s: float, heading_true_rad: float, sigma_rad: float) -> bool:
        """Correct the heading by a self-levelling compass' reading of time `t_s`; return True if it was accepted."""
        found = self.kept_at(t_s)
        if found is None or self._leveller.doubt > STEADY_SHARE:
            return False
        rx, ry, rz = self._strapdown.last_rate_rad_s
        if rx * rx + ry * ry + rz * rz > STEADY_RAD_S**2:
            return False
        _, pitch, yaw = roll_pitch_yaw(found[1])
        if abs(pitch) > STEEP_RAD:
            return False
        innovation_rad = math.remainder(heading_true_rad - yaw, 2.0 * math.pi)
        gain = self.compass.gain(t_s, innovation_rad, self._uncertainty.heading_sigma_rad, sigma_rad)
        if gain == 0.0:
            return False
        clockwise = from_rotation_vector((0.0, 0.0, gain * innovation_rad))
        self._leveller.ned_from_e = normalised(multiply(clockwise, self._leveller.ned_from_e))
        self._uncertainty.head(gain, sigma_rad)
        return True

    def kept_at(self, t_s: float) -> tuple[float, Quaternion] | None:
        """Return the last stored time up to `t_s` and its attitude (body to NED by the newest levelling), or None."""
        for then_s, orientation in reversed(self._history if self.aligned else ()):
            if then_s <= t_s:
                return then_s, multiply(multiply(self._leveller.ned_from_e, orientation), self._sensor_from_vehicle)
        return None

    # --- result

    def attitude(self) -> Attitude | None:
        t_s = self._strapdown.last_s
        if not self.aligned or t_s is None:
            return None
        q = multiply(multiply(self._leveller.ned_from_e, self._strapdown.orientation), self._sensor_from_vehicle)
        w, x, y, z = normalised(q)
        if w < 0.0:
            w, x, y, z = -w, -x, -y, -z
        roll, pitch, yaw = roll_pitch_yaw((w, x, y, z))
        rate = rotate(conjugate(self._sensor_from_vehicle), self._strapdown.last_rate_rad_s)
        ex, ey, ez = rotate((w, -x, -y, -z), self._earth)
        rate = (rate[0] - ex, rate[1] - ey, rate[2] - ez)
        return Attitude(t_s, (w, x, y, z), roll, pitch, yaw, rate, self._sigmas(pitch, yaw))

    def _sigmas(self, pitch_rad: float, yaw_rad: float) -> Triple:
        (nn, ne, _), (_, ee, _), (_, _, dd) = self._uncertainty.attitude.tolist()
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        about_forward = max(c * c * nn + 2.0 * c * s * ne + s * s * ee, 0.0)
        about_right = max(s * s * nn - 2.0 * c * s * ne + c * c * ee, 0.0)
        # Near +-90 degrees of pitch roll and yaw cannot be separated: both are unknown.
        level = max(math.cos(pitch_rad) ** 2, 1e-4)
        unknown = HEADING_UNKNOWN_RAD**2
        return (
            math.sqrt(min(about_forward / level, unknown)),
            math.sqrt(min(about_right, unknown)),
            math.sqrt(min(dd + about_forward * (1.0 / level - 1.0), unknown)),
        )
