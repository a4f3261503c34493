"""STIM300 datagrams: which there are, how long they are, where their values lie, and their CRC.

Source: Sensonor/Safran TS1524 rev. 31, tables 5-13 to 5-23. Datagrams with AUX (0x98 to 0x9C, 0xAD to 0xAF) are those
of earlier revisions, which rev. 31 calls PPS (0xF0 to 0xF7); both add one cluster of a 24-bit value and a status byte.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import Final

CRC_BYTES: Final = 4
PART_NUMBER, SERIAL_NUMBER = (0xB1, 0xB3), (0xB5, 0xB7)
CONFIGURATION: Final = (0xBC, 0xBD)
EXTENDED_ERROR, BIAS_TRIM = (0xBE, 0xBF), (0xD1, 0xD2)

SPECIAL_BYTES: Final[dict[int, int]] = {
    identifier: size
    for identifiers, size in (
        (PART_NUMBER, 20),
        (SERIAL_NUMBER, 20),
        (CONFIGURATION, 26),
        (EXTENDED_ERROR, 21),
        (BIAS_TRIM, 40),
    )
    for identifier in identifiers
}
"""Sizes, with the CRC, of the datagrams that are sent at start-up or on demand; the second of each ends in CR LF."""

_VECTOR = "bHbHbHB"
"""Three 24-bit numbers, each as its signed first byte and the rest, and the cluster's status byte."""
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


@dataclass(frozen=True, slots=True)
class Layout:
    """Where the parts of one normal mode datagram stand among its unpacked values; None: it does not have them."""

    frame_bytes: int
    values: struct.Struct
    accel: int | None
    inclination: int | None
    gyro_temperature: int | None
    inclination_temperature: int | None
    counter: int


def _layout(*, accel: bool, inclination: bool, temperature: bool, extra: bool) -> Layout:
    code, count = ">x" + _VECTOR, 7
    places: dict[str, int] = {}
    for name, present in (("accel", accel), ("inclination", inclination)):
        if present:
            places[name] = count
            code, count = code + _VECTOR, count + 7
    if temperature:
        for name in ("gyro", *places):
            places[f"{name}_temperature"] = count
            code, count = code + "hhhB", count + 4
    if extra:
        code, count = code + "xxxB", count + 1
    values = struct.Struct(code + "BH")
    return Layout(
        frame_bytes=values.size + CRC_BYTES,
        values=values,
        accel=places.get("accel"),
        inclination=places.get("inclination"),
        gyro_temperature=places.get("gyro_temperature"),
        inclination_temperature=places.get("inclination_temperature"),
        counter=count,
    )


def _normal_mode() -> dict[int, Layout]:
    layouts: dict[int, Layout] = {}
    for content in range(8):
        accel, inclination, temperature = bool(content & 1), bool(content & 2), bool(content & 4)
        plain = _layout(accel=accel, inclination=inclination, temperature=temperature, extra=False)
        extra = _layout(accel=accel, inclination=inclination, temperature=temperature, extra=True)
        first = 0xA0 if content > 4 else 0x90
        layouts |= {first + content: plain, first + 8 + content: extra, 0xF0 + content: extra}
    return layouts


NORMAL_MODE: Final = _normal_mode()
FRAME_BYTES: Final = {name: layout.frame_bytes for name, layout in NORMAL_MODE.items()} | SPECIAL_BYTES
MAX_FRAME_BYTES: Final = max(FRAME_BYTES.values())


def is_whole(frame: bytes) -> bool:
    """Whether the CRC at the end of a datagram is right.

    CRC-32/MPEG-2 over the datagram and as many zero bytes as fill its last word, which are not sent. It is zlib's CRC
    with all bits in the other order and without the last inversion, so zlib can do the work on mirrored bytes.
    """
    mirrored = frame.translate(_REVERSED)
    body = mirrored[:-CRC_BYTES]
    crc = zlib.crc32(body.ljust(len(body) + 3 & ~3, b"\0")) ^ 0xFFFFFFFF
    return crc == int.from_bytes(mirrored[-CRC_BYTES:], "little")
