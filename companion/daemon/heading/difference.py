"""Our attitude beside the autopilot's own, at the same instant."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.attitude.estimator import Attitude
from companion.attitude.quaternion import (
    Quaternion,
    Triple,
    conjugate,
    from_roll_pitch_yaw,
    from_rotation_vector,
    multiply,
    roll_pitch_yaw,
    rotate,
)
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.links.mavlink.link import MavlinkLink

SMOOTHED_S: Final = 3.0
"""The two differ for moments by their filters' delays; over so long what lasts is left."""
OLD_S: Final = 2.0
"""Without the autopilot's attitude for so long there is no difference to speak of."""
STEEP_RAD: Final = math.radians(60.0)
"""Beyond it a heading tells roll and heading apart badly."""
FORGETS_PER_S: Final = 1e-4
"""The shortest delay that was seen is forgotten as two clocks may run apart."""
_DOWN: Final[Triple] = (0.0, 0.0, 1.0)


def turn_between(ours: Quaternion, theirs: Quaternion) -> Triple:
    """How theirs lies to ours, both body to NED: turns about north, east and down in rad; of large ones 2 sin(half)."""
    error = multiply(theirs, conjugate(ours))
    sign = math.copysign(2.0, error[0])
    return sign * error[1], sign * error[2], sign * error[3]


class Difference:
    """Listens to ATTITUDE of the latched autopilot; ours comes back from other stations under our own number.

    Args:
        link: the connection.
        vehicle: whose attitude counts.
        now: our attitude at the last sample.
        kept_at: what is remembered of an instant before.
    """

    def __init__(
        self,
        link: MavlinkLink,
        vehicle: Vehicle,
        now: Callable[[], Attitude | None],
        kept_at: Callable[[float], tuple[float, Quaternion] | None],
    ) -> None:
        self._vehicle, self._now, self._kept_at = vehicle, now, kept_at
        self._offset_s: float | None = None
        self._heard_s = -math.inf
        self._since_s = -math.inf
        self._sine = self._cosine = 0.0
        self._down: Triple = (0.0, 0.0, 0.0)
        self.forget()
        self.close = link.subscribe(mavlink.MAVLink_attitude_message, self._on_attitude)

    def forget(self) -> None:
        """What we carry has been set anew."""
        self._sine = self._cosine = 0.0
        self._down = (0.0, 0.0, 0.0)
        self._since_s = math.inf

    def is_known(self, now_s: float) -> bool:
        """Whether the autopilot tells its attitude, and has for a while."""
        return now_s - self._heard_s < OLD_S and now_s - self._since_s > SMOOTHED_S

    @property
    def tilt_rad(self) -> float:
        """Between the two opinions of the vertical, smoothed."""
        return math.hypot(*self._down)

    @property
    def heading_rad(self) -> float:
        """Theirs less ours, smoothed, in [-pi, pi]."""
        return math.atan2(self._sine, self._cosine)

    def _on_attitude(self, message: mavlink.MAVLink_attitude_message, t_s: float) -> None:
        angles = (message.roll, message.pitch, message.yaw)
        if not self._vehicle.sent(message) or not all(map(math.isfinite, angles)):
            return
        late_s = self._late_s(message.time_boot_ms * 1e-3, t_s)
        ours = self._now()
        if ours is None or abs(ours.t_s - t_s) > OLD_S:
            return
        span_s = min(max(t_s - self._heard_s, 0.0), OLD_S)
        self._heard_s = t_s
        instant_s = t_s - late_s
        kept_s, turn = self._kept_at(instant_s) or (ours.t_s, ours.quaternion)
        since_s = kept_s - instant_s
        rx, ry, rz = ours.rate_rad_s
        then = multiply(turn, from_rotation_vector((-rx * since_s, -ry * since_s, -rz * since_s)))
        self._compare(then, from_roll_pitch_yaw(*angles), span_s, t_s)

    def _compare(self, ours: Quaternion, theirs: Quaternion, span_s: float, t_s: float) -> None:
        first = self._since_s == math.inf
        if first:
            self._since_s = t_s
        gain = 1.0 if first else 1.0 - math.exp(-span_s / SMOOTHED_S)
        mine, other = rotate(conjugate(ours), _DOWN), rotate(conjugate(theirs), _DOWN)
        x, y, z = (kept + gain * (b - a - kept) for kept, a, b in zip(self._down, mine, other, strict=True))
        self._down = (x, y, z)
        _, pitch, yaw = roll_pitch_yaw(ours)
        _, their_pitch, their_yaw = roll_pitch_yaw(theirs)
        if max(abs(pitch), abs(their_pitch)) < STEEP_RAD:
            self._sine += gain * (math.sin(their_yaw - yaw) - self._sine)
            self._cosine += gain * (math.cos(their_yaw - yaw) - self._cosine)

    def _late_s(self, boot_s: float, t_s: float) -> float:
        """How much later than the quickest this message came; a restart or a leap begins anew."""
        offset_s = t_s - boot_s
        if self._offset_s is None or abs(offset_s - self._offset_s) > OLD_S:
            self._offset_s = offset_s
        else:
            forgotten_s = FORGETS_PER_S * min(max(t_s - self._heard_s, 0.0), OLD_S)
            self._offset_s = min(offset_s, self._offset_s + forgotten_s)
        return offset_s - self._offset_s
