"""Script for ArduPilot flight controllers, which their owner installs there, and the messages to this script."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

ARMING_SCRIPT: Final = Path(__file__).with_name("companion_arming.lua")
"""ArduPilot script with arming gate and IMU output; on the flight controller: APM/scripts/companion_arming.lua."""

INSTALLATION: Final = (
    "save it on the flight controller as APM/scripts/companion_arming.lua (SD card or MAVFTP)",
    "set SCR_ENABLE to 1 and reboot the flight controller (ArduPilot 4.5 or later, more than 1 MB of flash)",
    'set calibration.at_arm = "gate" here; a forced arming passes by this gate (docs/arming.md)',
)

TUNNEL_TYPE: Final = 33191
"""Payload type of our TUNNEL messages, from MAVLink's range for local use (above 32767); payloads begin with a mark."""
TUNNEL_BYTES: Final = 128


def to_script(system_id: int, data: bytes) -> mavlink.MAVLink_tunnel_message:
    """Return a TUNNEL message with `data` for our script on the autopilot of a system id."""
    payload = list(data.ljust(TUNNEL_BYTES, b"\0"))
    return mavlink.MAVLink_tunnel_message(system_id, mavlink.MAV_COMP_ID_AUTOPILOT1, TUNNEL_TYPE, len(data), payload)
