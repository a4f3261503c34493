"""Logic of heartbeats: choice of the autopilot, its arm state and its restarts. Times are arguments.

Anybody on an unsigned link can send "disarmed" with the autopilot's ids, but the autopilot's own heartbeats arrive too.
So "armed" outweighs "disarmed", and a sender that alternates between both is not believed at all.
"""

from __future__ import annotations

import enum
import math
from collections import deque
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.messages import message

ARMED_HOLDS_S: Final = 3.0  # time for which "armed" outweighs "disarmed": at 1 Hz two heartbeats may be lost

_CHANGES: Final = 4
_CHANGES_WITHIN_S: Final = 5.0  # arming and disarming twice within this time is more than pilots do
_ONLY_ARMED_S: Final = 10.0
_ONLY_DISARMED_S: Final = 30.0
"""Time of only "disarmed" heartbeats before they are believed again; long, as an "armed" sender may be silenced.
"armed" heartbeats alone are believed earlier (`_ONLY_ARMED_S`), as they permit nothing."""
_RESTARTS_S: Final = 1.0  # two restarts within this time mean two autopilots, whose times since boot alternate
_TWO_HOLDS_S: Final = 5.0  # time after the last sign of a second autopilot for which neither is believed


class ArmState(enum.Enum):
    """Arm state of the aircraft; only DISARMED permits a write."""

    DISARMED = "disarmed"
    ARMED = "armed"
    UNKNOWN = "unknown"

    @property
    def why_not_written(self) -> str | None:
        """Reason why nothing may be written, as text for people; None: writing is allowed."""
        if self is ArmState.DISARMED:
            return None
        return message("aircraft_is_armed") if self is ArmState.ARMED else message("unknown_whether_armed")


class ArmingWatch:
    """Decides the arm state from the heartbeats with one vehicle's ids; some of them may be forged."""

    def __init__(self) -> None:
        self._armed: bool | None = None
        self._armed_s = self._disarmed_s = self._two_s = self._restarted_s = -math.inf
        self._contradicted = False
        self._changes_s: deque[float] = deque(maxlen=_CHANGES)

    def heard(self, t_s: float, *, armed: bool) -> None:
        self._contradicted = self.contradicts_itself(t_s)
        if armed:
            self._armed_s = t_s
        else:
            self._disarmed_s = t_s
        if self._armed is not None and self._armed is not armed:
            self._changes_s.append(t_s)
            if len(self._changes_s) == _CHANGES and t_s - self._changes_s[0] <= _CHANGES_WITHIN_S:
                self._contradicted = True
        self._armed = armed

    def restarted(self, t_s: float) -> None:
        """Discard earlier "disarmed" heartbeats; "armed" ones continue to count, as a restart can be forged."""
        self._armed = None
        if t_s - self._restarted_s < _RESTARTS_S:
            self.two_seen(t_s)
        self._restarted_s = t_s

    def flashed(self) -> None:
        """Note that another firmware was flashed: a restart just before must not count as a second autopilot."""
        self._restarted_s = -math.inf

    def armed(self, t_s: float) -> bool | None:
        """Return whether the aircraft is armed; None: unknown, before the first heartbeat or after a restart."""
        if t_s - self._armed_s < ARMED_HOLDS_S:
            return True
        return self._armed

    def two_seen(self, t_s: float) -> None:
        self._two_s = t_s

    def conflict(self, t_s: float, system_id: int | None) -> str | None:
        """Describe a conflict: two autopilots with the same ids, of which neither is believed; None: no conflict."""
        if self.contradicts_itself(t_s):
            return message("armed_and_disarmed_by_turns", system=system_id)
        return message("two_autopilots_with_one_id", system=system_id) if t_s - self._two_s < _TWO_HOLDS_S else None

    def contradicts_itself(self, t_s: float) -> bool:
        """Check for alternating armed and disarmed heartbeats, from two autopilots, or from one and a forger."""
        only_armed = self._armed is True and t_s - self._disarmed_s >= _ONLY_ARMED_S
        return self._contradicted and not only_armed and t_s - self._armed_s < _ONLY_DISARMED_S


ADOPT_OTHER_COMPONENT_S: Final = 2.0  # time of heartbeats from a component other than 1 before it is latched

_NOT_AIRCRAFT: Final = frozenset(
    getattr(mavlink, f"MAV_TYPE_{name}")
    for name in (
        "ANTENNA_TRACKER", "GCS", "ONBOARD_CONTROLLER", "GIMBAL", "ADSB", "CAMERA", "CHARGING_STATION", "FLARM",
        "SERVO", "ODID", "BATTERY", "PARACHUTE", "LOG", "OSD", "IMU", "GPS", "WINCH", "ILLUMINATOR", "GRIPPER",
    )
)  # fmt: skip


def is_aircraft(message: mavlink.MAVLink_heartbeat_message) -> bool:
    return message.type not in _NOT_AIRCRAFT and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID


def unique_id(message: mavlink.MAVLink_autopilot_version_message) -> str | None:
    """Return AUTOPILOT_VERSION.uid2 as 36 hex digits, otherwise uid as 16; None: the board reports neither."""
    if any(message.uid2):
        return bytes(message.uid2).hex()
    return f"{message.uid:016x}" if message.uid else None


def version_text(packed: int) -> str:
    """Decode AUTOPILOT_VERSION.flight_sw_version: major, minor, patch and kind of release, one byte each."""
    major, minor, patch, kind = packed.to_bytes(4, "big")
    suffix = "-dev" if kind < 64 else "-alpha" if kind < 128 else "-beta" if kind < 192 else "-rc" if kind < 255 else ""
    return f"{major}.{minor}.{patch}{suffix}"


class AutopilotChooser:
    """Chooses the autopilot to work with, by its heartbeats."""

    def __init__(self, system_id: int | None) -> None:
        self._system_id = system_id
        self._candidates: dict[tuple[int, int], float] = {}

    def takes(self, message: mavlink.MAVLink_heartbeat_message, t_s: float, *, is_known: bool) -> bool:
        system, component = message.get_srcSystem(), message.get_srcComponent()
        if self._system_id not in (None, system) or system == 0:
            return False
        if component == mavlink.MAV_COMP_ID_AUTOPILOT1:
            return True
        if not is_known:
            return False
        first_s = self._candidates.setdefault((system, component), t_s)
        return t_s - first_s >= ADOPT_OTHER_COMPONENT_S


_BACK_S: Final = 0.5  # step back that means a restart; late and repeated packets step back by milliseconds

_GAP_S: Final = 2.0
_CONFIRM_S: Final = 0.5
_CLOCKS: Final = 1.01  # ratio beyond that of any two quartz clocks
_WRAP_S: Final = 2**32 * 1e-3  # time_boot_ms has 32 bits: it starts again at zero after 49.7 days


class BootClock:
    """Detects restarts from the time since boot, which many messages carry.

    A restart shows in one of two ways. First, the time goes back. Second, after a silence, the time since boot is
    shorter than the silence and has advanced by less than half of it. The autopilot then restarted while the link was
    lost, and its time since boot has overtaken the old one. Both conditions are needed: a simulator on a busy machine
    may advance by less than half. But its time since boot is longer than the silence, so it did not restart meanwhile.
    The second way must hold for another half second, as the first messages after a pause of our own process are old.
    """

    def __init__(self) -> None:
        self.latest: tuple[float, float] | None = None  # latest time since boot, and the time when it arrived
        self._before_gap: tuple[float, float] | None = None
        self._suspected_s = 0.0

    def rebooted(self, boot_s: float, t_s: float) -> bool:
        """Note a time since boot received at `t_s`; return whether the autopilot restarted since the last call."""
        if self.latest is None:
            self.latest = (boot_s, t_s)
            return False
        last_boot_s, last_t_s = self.latest
        advance_s = boot_s - last_boot_s
        if advance_s < -_BACK_S and not (last_boot_s > _WRAP_S - 60.0 and boot_s < 60.0 + (t_s - last_t_s)):
            self.latest, self._before_gap = (boot_s, t_s), None
            return True
        if self._before_gap is None and _too_slow(boot_s, t_s, self.latest):
            self._before_gap, self._suspected_s = self.latest, t_s
        elif self._before_gap is not None:
            if not _too_slow(boot_s, t_s, self._before_gap):
                self._before_gap = None
            elif t_s - self._suspected_s >= _CONFIRM_S:
                self.latest, self._before_gap = (boot_s, t_s), None
                return True
        if advance_s < -_BACK_S or advance_s >= 0.0:
            self.latest = (boot_s, t_s)
        return False


def _too_slow(boot_s: float, t_s: float, since: tuple[float, float]) -> bool:
    silence_s = t_s - since[1]
    advance_s = (boot_s - since[0]) % _WRAP_S
    fits_in_silence = boot_s <= silence_s * _CLOCKS + _BACK_S
    return silence_s > _GAP_S and fits_in_silence and advance_s < 0.5 * silence_s - 0.5
