"""Which parameters of the autopilot the companion's telemetry port needs: SERIALn_* on ArduPilot, MAV_1_* on PX4.

No message tells on which port a component is heard: PX4's are those of TELEM 2, which its MAV_1 is meant for; of
ArduPilot all ports with MAVLink are looked at.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, NamedTuple

from companion.autopilot.vehicle.vehicle import Firmware

_TELEM2: Final = 102
_MAVLINK_1, _MAVLINK_2 = 1, 2
_SERIALS: Final = range(1, 9)


class PortRow(NamedTuple):
    """One parameter of a port, as it is and as it should be."""

    parameter: str
    now: float
    wanted: float
    why: str


def port_names(firmware: Firmware | None) -> list[str]:
    """What is to be read; some releases and boards lack some of it."""
    if firmware == "px4":
        return ["MAV_1_CONFIG", "SER_TEL2_BAUD", "MAV_1_FORWARD"]
    if firmware == "ardupilot":
        return [f"SERIAL{number}_{what}" for number in _SERIALS for what in ("PROTOCOL", "BAUD")]
    return []


def port_rows(firmware: Firmware | None, found: Mapping[str, float], baud: int | None) -> list[PortRow]:
    """What concerns the companion's port, of parameters as they were read.

    `baud`: of our own serial line to it; None: it is reached another way.
    """
    rows: list[PortRow] = []
    if firmware == "px4":
        on_telem2 = found.get("MAV_1_CONFIG") == _TELEM2
        if "MAV_1_CONFIG" in found:
            rows.append(PortRow("MAV_1_CONFIG", found["MAV_1_CONFIG"], _TELEM2, "MAVLink on TELEM 2"))
        if baud is not None and on_telem2 and "SER_TEL2_BAUD" in found:
            rows.append(PortRow("SER_TEL2_BAUD", found["SER_TEL2_BAUD"], baud, "as in mavlink.url"))
        if "MAV_1_FORWARD" in found:
            rows.append(PortRow("MAV_1_FORWARD", found["MAV_1_FORWARD"], 1, "ground stations reach the companion"))
        return rows
    for number in _SERIALS:
        protocol, speed = f"SERIAL{number}_PROTOCOL", f"SERIAL{number}_BAUD"
        if found.get(protocol) in (_MAVLINK_1, _MAVLINK_2):
            rows.append(PortRow(protocol, found[protocol], _MAVLINK_2, "MAVLink 2"))
            if speed in found:
                rows.append(PortRow(speed, found[speed], found[speed], "its speed, in thousands"))
    return rows


def port_needs(firmware: Firmware | None, baud: int) -> str:
    """What the autopilot's end of a serial line needs, in one line."""
    ardupilot = f"SERIALn_PROTOCOL = 2, SERIALn_BAUD = {baud // 1000}"
    px4 = f"MAV_1_CONFIG = 102, SER_TEL2_BAUD = {baud}"
    needs = {"ardupilot": ardupilot, "px4": px4}.get(firmware or "", f"{ardupilot} (ArduPilot), or {px4} (PX4)")
    return f"its port needs {needs}, and a restart"


def baud_of(url: str) -> int | None:
    """The speed of a MAVLink url; None where it is no serial line."""
    return int(url.rpartition(":")[2]) if url.startswith("serial:") else None
