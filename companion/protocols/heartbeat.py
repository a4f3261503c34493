"""MAVLink HEARTBEATs in raw bytes: does an autopilot speak at this speed?

One is enough. Its nine bytes end with one that is never zero, so version 2 never cuts it short.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

AUTOPILOT_NAMES: Final = {3: "ArduPilot", 12: "PX4"}  # MAV_AUTOPILOT of those that the companion can calibrate

_FRAMES: Final = (
    # Version 2: length 9, two bytes of flags, sequence, system, component, the message's number in three bytes.
    re.compile(rb"(?=\xfd(\x09...(..)\x00\x00\x00(.{9}))(..))", re.DOTALL),
    # Version 1: no flags, one byte of number.
    re.compile(rb"(?=\xfe(\x09.(..)\x00(.{9}))(..))", re.DOTALL),
)
_EXTRA: Final = 50
_NO_AUTOPILOT: Final = 8
_TYPE, _AUTOPILOT = 4, 5
_GROUND_STATION: Final = 6
_POLYNOMIAL: Final = 0x8408


@dataclass(frozen=True, slots=True)
class Heartbeat:
    system_id: int
    component_id: int
    kind: int
    autopilot: int

    @property
    def is_autopilot(self) -> bool:
        return self.autopilot != _NO_AUTOPILOT

    def __str__(self) -> str:
        if self.is_autopilot:
            who = AUTOPILOT_NAMES.get(self.autopilot, f"autopilot of kind {self.autopilot}")
        else:
            who = "ground station" if self.kind == _GROUND_STATION else f"MAVLink component {self.component_id}"
        return f"{who}, system {self.system_id}"


def heartbeats(data: bytes) -> list[Heartbeat]:
    """List the senders of whole HEARTBEATs, autopilots first, each once."""
    found = [
        Heartbeat(match[2][0], match[2][1], match[3][_TYPE], match[3][_AUTOPILOT])
        for frame in _FRAMES
        for match in frame.finditer(data)
        if _checksum(match[1] + bytes((_EXTRA,))) == match[4][0] | match[4][1] << 8
    ]
    return sorted(dict.fromkeys(found), key=lambda one: not one.is_autopilot)


def _checksum(data: bytes) -> int:
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (_POLYNOMIAL if value & 1 else 0)
    return value
