"""Detection of a port's device from its bytes: a sensor, an autopilot, or something else.

Every decoder of the registry reads the bytes; the decoder that accepts the most frames wins.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

from companion.config.sections import Parity
from companion.messages import message
from companion.protocols.registry import DEVICES, Kind, main_kind

COMMON_BAUDS: Final = (9600, 115200, 19200, 38400, 57600, 230400, 460800, 921600, 4800, 2400, 1200)
ENOUGH_BYTES: Final = 1500  # six frames of the longest protocol; if no decoder has accepted one, none will

_LEAST_FRAMES: Final = 2
_SURE_FRAMES: Final = 4
_CONSOLE: Final = re.compile(rb"\blogin: |\bPassword: |Linux version \d|\[ {0,4}\d+\.\d{6}\] |\bgetty\b")
_MODEM: Final = re.compile(rb"(?:^|[\r\n])AT(?:[+&^$][A-Z]|[EZVI]\d?[\r\n])")
_NOT_PLAIN: Final = bytes(byte for byte in range(256) if byte not in b"\t\r\n" and not 0x20 <= byte < 0x7F)
_MAVLINK_OVERHEAD: Final = {0xFD: 12, 0xFE: 8}
_MAVLINK_RUN: Final = 4


class Line(NamedTuple):
    """Setting of a serial line, always with 8 data bits and one stop bit."""

    baud: int
    parity: Parity

    def __str__(self) -> str:
        return f"{self.baud} 8{self.parity[0].upper()}1"


@dataclass(frozen=True, slots=True)
class Candidate:
    """Protocol that may have produced the received bytes, with its counts of frames."""

    protocol: str
    kinds: tuple[Kind, ...]
    accepted: int
    rejected: int

    @property
    def likely(self) -> bool:
        return self.accepted >= _LEAST_FRAMES and self.accepted >= 2 * self.rejected

    @property
    def sure(self) -> bool:
        return self.accepted >= _SURE_FRAMES and self.accepted >= 4 * self.rejected


def candidates(data: bytes) -> list[Candidate]:
    """List the protocols that may have produced the bytes, the likeliest first."""
    found = []
    for info, kinds in DEVICES.items():
        decoder = info.decoder()
        decoder.interrupted()  # the first frame may lack its beginning
        decoder.feed(data, 0.0)
        if decoder.accepted:
            rejected = max(decoder.rejected.total() - 1, 0)
            main_first = sorted(kinds, key=lambda kind: kind != main_kind(info.name))
            found.append(Candidate(info.name, tuple(main_first), decoder.accepted, rejected))
    return sorted(found, key=lambda one: (one.likely, one.accepted - 2 * one.rejected), reverse=True)


def likeliest(data: bytes) -> Candidate | None:
    return next((one for one in candidates(data) if one.likely), None)


def lines_to_try(first: Sequence[Line] = ()) -> Iterator[Line]:
    """Yield each line setting once, the likeliest first; `first`: settings to try before all others."""
    defaults = [Line(info.baud, info.parity) for info in DEVICES]
    bauds = dict.fromkeys([*(line.baud for line in (*first, *defaults)), *COMMON_BAUDS])
    parities: tuple[Parity, ...] = ("none", "even", "odd")
    rest = [Line(baud, parity) for parity in parities for baud in bauds]
    yield from dict.fromkeys([*first, *defaults, *rest])


def strangers(data: bytes) -> str | None:
    """Describe a device that is no sensor: a login console, a program that sends modem commands, an autopilot."""
    if _CONSOLE.search(data):
        return "a login console or kernel messages"
    if _MODEM.search(data):
        return "AT commands, as ModemManager sends them"
    if is_mavlink(data):
        return message("mavlink_on_the_port", speaker="an autopilot or its radio")
    return None


def plain_share(data: bytes) -> float:
    return len(data.translate(None, _NOT_PLAIN)) / len(data) if data else 0.0


def is_mavlink(data: bytes) -> bool:
    """Return whether the bytes hold `_MAVLINK_RUN` MAVLink packets in a row without a gap."""
    for start in range(len(data)):
        at = start
        for _ in range(_MAVLINK_RUN):
            overhead = _MAVLINK_OVERHEAD.get(data[at]) if at + 2 < len(data) else None
            if overhead is None:
                break
            signature = 13 if data[at] == 0xFD and data[at + 2] & 1 else 0
            at += data[at + 1] + overhead + signature
        else:
            return True
    return False


AUTOPILOT_NAMES: Final = {3: "ArduPilot", 12: "PX4"}  # by MAV_AUTOPILOT: firmwares that the companion can calibrate

_FRAMES: Final = (
    # Version 2: length 9, two bytes of flags, sequence, system, component, the message's number in three bytes.
    re.compile(rb"(?=\xfd(\x09...(..)\x00\x00\x00(.{9}))(..))", re.DOTALL),
    # Version 1: no flags, one byte of number.
    re.compile(rb"(?=\xfe(\x09.(..)\x00(.{9}))(..))", re.DOTALL),
)
_HEARTBEAT_EXTRA: Final = 50  # the message's CRC_EXTRA
_NO_AUTOPILOT: Final = 8
_TYPE_AT, _AUTOPILOT_AT = 4, 5
_GROUND_STATION: Final = 6
_X25_POLYNOMIAL: Final = 0x8408


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """Sender of a HEARTBEAT."""

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
    """List the senders of complete HEARTBEATs, autopilots first, each once.

    One HEARTBEAT confirms the baud rate. Its last byte is never zero, so MAVLink 2 never truncates its nine bytes.
    """
    found = [
        Heartbeat(match[2][0], match[2][1], match[3][_TYPE_AT], match[3][_AUTOPILOT_AT])
        for frame in _FRAMES
        for match in frame.finditer(data)
        if _x25(match[1] + bytes((_HEARTBEAT_EXTRA,))) == match[4][0] | match[4][1] << 8
    ]
    return sorted(dict.fromkeys(found), key=lambda one: not one.is_autopilot)


def _x25(data: bytes) -> int:
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (_X25_POLYNOMIAL if value & 1 else 0)
    return value
