"""Checks of the attitude that is sent to the autopilot, and its difference from the autopilot's own attitude."""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from typing import Final

import msgspec
import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.attitude.estimator import REFUSED_S, Attitude, AttitudeEstimator
from companion.attitude.quaternion import (
    Quaternion,
    Triple,
    conjugate,
    from_roll_pitch_yaw,
    from_rotation_vector,
    multiply,
    roll_pitch_yaw,
    rotate,
    shortest_arc,
)
from companion.autopilot.vehicle.vehicle import Vehicle, VehicleEvent
from companion.daemon.heading.carrier import AttitudeCarrier
from companion.physics.frames import vector
from companion.physics.units import DEG

SILENT_S: Final = 0.2
HEADING_SIGMA_DEG: Final = 15.0
TILT_SIGMA_DEG: Final = 15.0
DIFFERS_SIGMAS: Final = 3.0
DIFFERS_S: Final = 5.0
ATTITUDE_RATE_HZ: Final = 10.0
THEIR_TILT_DEG: Final = 2.0
"""Standard deviation of the autopilot's tilt, including trim (AHRS_TRIM) and mounting errors."""
THEIR_HEADING_DEG: Final = 5.0
"""Standard deviation of the autopilot's heading, from a compass or from the companion."""
GOOD_S: Final = 3.0  # Time without a fault before a stopped push resumes
TOLD_TILT_DEG: Final = 4.0
TOLD_HEADING_DEG: Final = 8.0
"""Smoothed heading difference that starts a warning (tilt: `TOLD_TILT_DEG`); half the difference ends the warning."""
SMOOTHED_S: Final = 3.0
"""Time constant that smooths attitude differences: two filters with different delays disagree briefly."""
OLD_S: Final = 2.0
STEEP_RAD: Final = math.radians(60.0)
"""Pitch beyond which roll and heading cannot be separated."""
FORGETS_PER_S: Final = 0.02
"""Rate, s/s, at which the smallest clock offset seen is raised: clocks drift, a simulated autopilot's by 1 %."""
HEADING_UNKNOWN: Final = "heading unknown: no compass reading fits"
_DOWN: Final[Triple] = (0.0, 0.0, 1.0)

DRIFT_LIMIT_RAD: Final = math.radians(5.0)
DRIFT_FADE_S: Final = 4.0
"""Time constant of the fading sum of heading drift. Drift up to 1.25 deg/s is undetected: the compass corrects it."""
STRAYS_SIGMAS: Final = 3.0  # Allowed drift in sigmas of the heading: the compass may correct a poorly known heading
SCALES: Final = 0.01
"""Tolerated difference between the scale factors of two gyros, as a fraction of the angle turned."""
LATE_S: Final = 0.03  # Usual time difference between the two attitudes
LONGEST_STEP_S: Final = 0.25
"""Longest time step over which heading and gyros are compared: a longer one could hide a turn to and fro."""


class HeadingDriftMonitor:
    """Detects heading drift as companion/lua does: sums heading changes minus turns by the autopilot's gyros."""

    def __init__(self) -> None:
        self.strayed_rad = 0.0
        self.is_too_far = False
        self._last: tuple[float, float, float] | None = None
        self._turned_rad = self._sigma_rad = self._apart_rad = 0.0

    def skip(self) -> None:
        self._last = None

    def add(self, t_s: float, heading_rad: float, sigma_rad: float, rate_rad_s: float, late_s: float = 0.0) -> None:
        """Add a heading, its sigma, and the autopilot's rate about the vertical; `late_s`: error beyond `LATE_S`."""
        before, self._last = self._last, (t_s, heading_rad, rate_rad_s)
        if before is None:
            self._sigma_rad = max(self._sigma_rad, sigma_rad)
            return
        passed_s = t_s - before[0]
        kept = 1.0 - passed_s / DRIFT_FADE_S if 0.0 < passed_s < DRIFT_FADE_S else 0.0
        self.strayed_rad *= kept
        self._turned_rad *= kept
        self._apart_rad *= kept
        self._sigma_rad = max(self._sigma_rad * kept, sigma_rad)
        if 0.0 < passed_s <= LONGEST_STEP_S:
            by_gyros = 0.5 * (rate_rad_s + before[2]) * passed_s
            heading = math.remainder(heading_rad - before[1], 2.0 * math.pi)
            self.strayed_rad += heading - by_gyros
            self._turned_rad += abs(by_gyros)
            self._apart_rad = max(self._apart_rad, late_s * max(abs(rate_rad_s), abs(heading / passed_s)))
        apart = LATE_S * abs(rate_rad_s) + self._apart_rad
        allowed = max(DRIFT_LIMIT_RAD, STRAYS_SIGMAS * self._sigma_rad) + SCALES * self._turned_rad + apart
        self.is_too_far = abs(self.strayed_rad) > allowed


class Difference:
    """Difference between the companion's attitude and the one in the autopilot's ATTITUDE messages."""

    def __init__(self, vehicle: Vehicle, carrier: AttitudeCarrier) -> None:
        self._carrier = carrier
        self._offset_s: float | None = None
        self._forgotten_s = 0.0
        """Largest error of a time stamp, s: rise of the clock offset since the message with the least delay."""
        self.theirs: tuple[float, Quaternion] | None = None
        """Autopilot's latest attitude: time on the companion's clock, and quaternion from body to NED."""
        self.latest: tuple[float, float] | None = None
        """Unsmoothed differences between both attitudes, rad: tilt, heading; None if a pitch is beyond `STEEP_RAD`."""
        self.heard_s = -math.inf
        self.forget()
        vehicle.hear(mavlink.MAVLink_attitude_message, self._on_attitude, ATTITUDE_RATE_HZ)

    def forget(self) -> None:
        self._heading = 0j
        self._down = self._down_now = np.zeros(3)
        self._since_s = math.inf
        self.straying = HeadingDriftMonitor()

    def is_heard(self, now_s: float) -> bool:
        return now_s - self.heard_s < OLD_S

    def is_known(self, now_s: float) -> bool:
        return self.is_heard(now_s) and now_s - self._since_s > SMOOTHED_S

    @property
    def tilt_rad(self) -> float:
        return float(np.linalg.norm(self._down))

    @property
    def heading_rad(self) -> float:
        """Smoothed difference of heading, the autopilot's minus the companion's, in [-pi, pi]."""
        return cmath.phase(self._heading)

    def levelled(self, attitude: Attitude, now_s: float) -> Attitude:
        """Return the attitude, rotated by the shortest arc to the autopilot's vertical if this vertical is known.

        PX4 computes yaw with an order of Euler angles that depends on its own tilt. At 30 deg of tilt the yaw of two
        orders differs by up to 10 deg. PX4 jumps to a heading that it has refused for 1 s (ev_yaw_control.cpp,
        getEulerYaw).
        """
        if not self.is_heard(now_s):
            return attitude
        ours = rotate(conjugate(attitude.quaternion), _DOWN)
        turn = multiply(attitude.quaternion, shortest_arc(vector(np.add(ours, self._down_now)), ours))
        roll, pitch, yaw = roll_pitch_yaw(turn)
        return msgspec.structs.replace(attitude, quaternion=turn, roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw)

    def _on_attitude(self, message: mavlink.MAVLink_attitude_message, t_s: float) -> None:
        angles = (message.roll, message.pitch, message.yaw)
        if not all(map(math.isfinite, angles)):
            return
        late_s = self._late_s(message.time_boot_ms * 1e-3, t_s)
        self.theirs = t_s - late_s, from_roll_pitch_yaw(*angles)
        ours = self._carrier.now()
        if ours is None or abs(ours.t_s - t_s) > OLD_S:
            return
        span_s = min(max(t_s - self.heard_s, 0.0), OLD_S)
        self.heard_s = t_s
        instant_s, theirs = self.theirs
        kept_s, turn = self._carrier.kept_at(instant_s) or (ours.t_s, ours.quaternion)
        since_s = kept_s - instant_s
        rx, ry, rz = ours.rate_rad_s
        then = multiply(turn, from_rotation_vector((-rx * since_s, -ry * since_s, -rz * since_s)))
        self._compare(then, theirs, span_s, t_s)
        pitch_rate, yaw_rate = message.pitchspeed, message.yawspeed
        if abs(message.pitch) < STEEP_RAD and math.isfinite(pitch_rate) and math.isfinite(yaw_rate):
            across = pitch_rate * math.sin(message.roll) + yaw_rate * math.cos(message.roll)
            rate = across / math.cos(message.pitch)
            heading, sigma = roll_pitch_yaw(then)[2], ours.sigma_rad[2]
            self.straying.add(message.time_boot_ms * 1e-3, heading, sigma, rate, self._forgotten_s)

    def _compare(self, ours: Quaternion, theirs: Quaternion, span_s: float, t_s: float) -> None:
        first = self._since_s == math.inf
        if first:
            self._since_s = t_s
        gain = 1.0 if first else 1.0 - math.exp(-span_s / SMOOTHED_S)
        self._down_now = np.subtract(rotate(conjugate(theirs), _DOWN), rotate(conjugate(ours), _DOWN))
        self._down = self._down + gain * (self._down_now - self._down)
        self.latest = None
        _, pitch, yaw = roll_pitch_yaw(ours)
        _, their_pitch, their_yaw = roll_pitch_yaw(theirs)
        if max(abs(pitch), abs(their_pitch)) < STEEP_RAD:
            heading = cmath.rect(1.0, their_yaw - yaw)
            self.latest = float(np.linalg.norm(self._down_now)), cmath.phase(heading)
            self._heading += gain * (heading - self._heading)

    def _late_s(self, boot_s: float, t_s: float) -> float:
        offset_s = t_s - boot_s
        if self._offset_s is None or abs(offset_s - self._offset_s) > OLD_S:
            self._offset_s = offset_s
        else:
            forgotten_s = FORGETS_PER_S * min(max(t_s - self.heard_s, 0.0), OLD_S)
            self._offset_s += forgotten_s
            self._forgotten_s += forgotten_s
            if offset_s < self._offset_s - LATE_S:
                # The end of a delay would look like a heading difference during a turn.
                self.straying.skip()
        if offset_s <= self._offset_s:
            self._offset_s, self._forgotten_s = offset_s, 0.0
        return offset_s - self._offset_s


def disagreements(attitude: Attitude, tilt_rad: float, heading_rad: float) -> tuple[str | None, str | None]:
    def differs(name: str, found_rad: float, ours_rad: float, theirs_deg: float) -> str | None:
        found_deg = abs(found_rad) / DEG
        beyond = found_deg > DIFFERS_SIGMAS * math.hypot(ours_rad / DEG, theirs_deg)
        return f"{name} differs by {found_deg:.0f} deg from the autopilot's" if beyond else None

    roll, pitch, yaw = attitude.sigma_rad
    tilt = differs("tilt", tilt_rad, max(roll, pitch), THEIR_TILT_DEG)
    return tilt, differs("heading", heading_rad, yaw, THEIR_HEADING_DEG)


class Health:
    """Decides whether the attitude may be sent to the autopilot (pushed); call `judge` several times a second.

    A heading that differs from the autopilot's stops the sending in two cases: the headings agreed since the last
    alignment, or the autopilot's heading agrees with its own compass (`own_agrees`). Then one heading is wrong.
    A detected heading drift stops the sending until the next alignment.
    """

    def __init__(
        self, carrier: AttitudeCarrier, difference: Difference, vehicle: Vehicle, own_agrees: Callable[[float], bool]
    ) -> None:
        self._carrier, self._difference, self._vehicle, self._own_agrees = carrier, difference, vehicle, own_agrees
        self.pushing = False
        self.why_not = carrier.waiting_for
        self.warning: str | None = None
        self._stopped = False
        self._good_since_s: float | None = None
        self._differs_since_s: float | None = None
        self._agreed = False
        self._alignments = 0
        self._strayed: str | None = None
        self._has_ours = False
        vehicle.on_event.add(self._on_event)

    def _on_event(self, event: VehicleEvent) -> None:
        self._has_ours &= event != "rebooted"

    def judge(self, now_s: float) -> None:
        if self._alignments != self._carrier.alignments:
            self._alignments = self._carrier.alignments
            self._agreed, self._differs_since_s, self._strayed = False, None, None
            self._difference.forget()
        wrong = self._wrong(now_s)
        self._compare(now_s)
        if wrong is not None:
            self.stop(wrong)
            return
        if self._good_since_s is None:
            self._good_since_s = now_s
        wait_s = GOOD_S if self._stopped else 0.0
        if now_s - self._good_since_s >= wait_s:
            self.pushing, self.why_not, self._stopped, self._has_ours = True, "", False, True
        else:
            self.why_not = f"well again, pushed after {GOOD_S:.0f} s of it"

    def stop(self, why: str) -> None:
        self._stopped |= self.pushing
        self.pushing, self.why_not, self._good_since_s = False, why, None

    def _wrong(self, now_s: float) -> str | None:
        carrier = self._carrier
        if self._vehicle.system_id is None:
            return "waiting for the autopilot"
        if not self._vehicle.kind.heading_settings:
            return "this autopilot is neither ArduPilot nor PX4"
        if self._vehicle.conflict is not None:
            return self._vehicle.conflict
        if carrier.estimator is None and carrier.doubt is None:
            return carrier.waiting_for
        silent_s = now_s - carrier.heard_s
        if silent_s > SILENT_S:
            return f"IMU {carrier.imu.name} sends nothing"
        if carrier.doubt is not None:
            self._agreed = True  # `Resume` pushes nothing before the two attitudes agree
            return carrier.doubt
        straying = self._difference.straying
        if self._strayed is None and straying.is_too_far and carrier.phase == "flight":
            self._strayed = f"heading drifts: {abs(straying.strayed_rad) / DEG:.0f} deg off the autopilot's gyros"
            carrier.align_wanted = True
        if self._strayed is not None:
            return self._strayed
        return self._unsure(now_s, carrier.estimator)

    def _unsure(self, now_s: float, estimator: AttitudeEstimator | None) -> str | None:
        carrier, attitude = self._carrier, None if estimator is None else estimator.attitude()
        if estimator is None or attitude is None:
            if carrier.alignments and carrier.phase == "flight":
                return "attitude lost in flight: it is aligned again on the ground"
            return carrier.waiting_for
        if not estimator.heading_known:
            return HEADING_UNKNOWN
        roll, pitch, heading = (sigma / DEG for sigma in attitude.sigma_rad)
        if heading > HEADING_SIGMA_DEG:
            return f"heading sigma {heading:.0f} deg > {HEADING_SIGMA_DEG:.0f}"
        if max(roll, pitch) > TILT_SIGMA_DEG and abs(attitude.pitch_rad) < math.radians(80.0):
            return f"tilt sigma {max(roll, pitch):.0f} deg > {TILT_SIGMA_DEG:.0f}"
        if (refused_s := estimator.compass.refused_for_s(carrier.heard_s)) > REFUSED_S:
            return f"compass disagrees for {refused_s:.0f} s"
        return self._differs(now_s, attitude)

    def _differs(self, now_s: float, attitude: Attitude) -> str | None:
        difference = self._difference
        has_own = not self._has_ours and not self._agreed and self._own_agrees(now_s)
        if not difference.is_known(now_s):
            self._differs_since_s = None
            return "comparing with the autopilot's heading" if has_own and difference.is_heard(now_s) else None
        tilt, heading = disagreements(attitude, difference.tilt_rad, difference.heading_rad)
        own_deg = attitude.sigma_rad[2] / DEG
        self._agreed |= abs(difference.heading_rad) / DEG < math.hypot(own_deg, THEIR_HEADING_DEG)
        words = tilt or (heading if self._agreed else None)
        if words is None and heading is not None and has_own:
            words = f"{heading} compass: one of the two is wrong"
        if words is None:
            self._differs_since_s = None
            return None
        if self._differs_since_s is None:
            self._differs_since_s = now_s
        # A difference that has stopped the push keeps it stopped as long as it lasts.
        return words if now_s - self._differs_since_s >= DIFFERS_S or not self.pushing else None

    def _compare(self, now_s: float) -> None:
        difference = self._difference
        if not difference.is_known(now_s):
            self.warning = None
            return
        share = 0.5 if self.warning is not None else 1.0
        tilt, heading = difference.tilt_rad / DEG, abs(difference.heading_rad) / DEG
        parts = [f"{tilt:.0f} deg in tilt"] if tilt > share * TOLD_TILT_DEG else []
        parts += [f"{heading:.0f} deg in heading"] if heading > share * TOLD_HEADING_DEG else []
        self.warning = f"attitude is {', '.join(parts)} off the autopilot's" if parts else None
