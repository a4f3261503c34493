"""Which of all the heartbeats on a network is that of the autopilot to calibrate, and what it is."""

from __future__ import annotations

from typing import Final, Literal

from pymavlink.dialects.v20 import ardupilotmega as mavlink

Firmware = Literal["ardupilot", "px4", "other"]

ADOPT_OTHER_COMPONENT_S: Final = 2.0
"""How long an autopilot on another component than 1 must have been heard before it is taken for the one."""

_NOT_AIRCRAFT: Final = frozenset(
    {
        mavlink.MAV_TYPE_ANTENNA_TRACKER,
        mavlink.MAV_TYPE_GCS,
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
        mavlink.MAV_TYPE_GIMBAL,
        mavlink.MAV_TYPE_ADSB,
        mavlink.MAV_TYPE_CAMERA,
        mavlink.MAV_TYPE_CHARGING_STATION,
        mavlink.MAV_TYPE_FLARM,
        mavlink.MAV_TYPE_SERVO,
        mavlink.MAV_TYPE_ODID,
        mavlink.MAV_TYPE_BATTERY,
        mavlink.MAV_TYPE_PARACHUTE,
        mavlink.MAV_TYPE_LOG,
        mavlink.MAV_TYPE_OSD,
        mavlink.MAV_TYPE_IMU,
        mavlink.MAV_TYPE_GPS,
        mavlink.MAV_TYPE_WINCH,
        mavlink.MAV_TYPE_ILLUMINATOR,
        mavlink.MAV_TYPE_GRIPPER,
    }
)


def is_aircraft(message: mavlink.MAVLink_heartbeat_message) -> bool:
    """Whether it claims to be a vehicle with an autopilot: ground stations, gimbals and the like are not."""
    return message.type not in _NOT_AIRCRAFT and message.autopilot != mavlink.MAV_AUTOPILOT_INVALID


def firmware_of(message: mavlink.MAVLink_heartbeat_message) -> Firmware:
    """Which firmware a heartbeat is of."""
    known: dict[int, Firmware] = {
        mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ardupilot",
        mavlink.MAV_AUTOPILOT_PX4: "px4",
    }
    return known.get(message.autopilot, "other")


def version_text(packed: int) -> str:
    """Major, minor, patch and kind of release from AUTOPILOT_VERSION.flight_sw_version, one byte each."""
    major, minor, patch, kind = packed.to_bytes(4, "big")
    suffix = "-dev" if kind < 64 else "-alpha" if kind < 128 else "-beta" if kind < 192 else "-rc" if kind < 255 else ""
    return f"{major}.{minor}.{patch}{suffix}"


class Latch:
    """Decides which autopilot is taken."""

    def __init__(self, system_id: int | None) -> None:
        self._system_id = system_id
        self._candidates: dict[tuple[int, int], float] = {}

    def takes(self, message: mavlink.MAVLink_heartbeat_message, t_s: float) -> bool:
        """Whether this heartbeat of an aircraft, heard at `t_s`, is the one to go by from now on."""
        system, component = message.get_srcSystem(), message.get_srcComponent()
        if self._system_id not in (None, system) or system == 0:
            return False
        if component == mavlink.MAV_COMP_ID_AUTOPILOT1:
            return True
        if firmware_of(message) == "other":
            return False
        first_s = self._candidates.setdefault((system, component), t_s)
        return t_s - first_s >= ADOPT_OTHER_COMPONENT_S
