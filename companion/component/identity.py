"""Who we are on the network: the heartbeat, and the version message that ground stations ask for."""

from __future__ import annotations

import re

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion import __version__

CAPABILITIES = (
    mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
    # Our parameters are all REAL32, the same in both encodings; the flags tell every client to send the number
    # itself. PARAM_FLOAT is what Mission Planner decides by, ENCODE_C_CAST what the protocol now asks for.
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT
    | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
)


def heartbeat(mav_state: int) -> mavlink.MAVLink_heartbeat_message:
    """Our heartbeat: an onboard controller that is no autopilot."""
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mav_state, 3
    )


def autopilot_version() -> mavlink.MAVLink_autopilot_version_message:
    """AUTOPILOT_VERSION (148) of this component: its capabilities and the companion's own version."""
    nothing = (0,) * 8
    return mavlink.MAVLink_autopilot_version_message(
        CAPABILITIES, encode_version(__version__), 0, 0, 0, nothing, nothing, nothing, 0, 0, 0
    )


def encode_version(version: str) -> int:
    """Encode "major.minor.patch" as `flight_sw_version`: a byte each, then the release type (255 official, 0 not)."""
    match = re.match(r"(\d+)\.(\d+)\.(\d+)", version)
    major, minor, patch = (min(int(part), 255) for part in match.groups()) if match else (0, 0, 0)
    official = match is not None and match.end() == len(version)
    release_type = mavlink.FIRMWARE_VERSION_TYPE_OFFICIAL if official else mavlink.FIRMWARE_VERSION_TYPE_DEV
    return major << 24 | minor << 16 | patch << 8 | release_type
