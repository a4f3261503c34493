"""PNI TCM, Prime, TRAX, SeaTRAX and TargetPoint3: the binary protocol.

    00 10 | 05 | 02 | 05 43 B3 F3 33 | 18 41 28 00 00 | 5C 2D      kGetDataResp: heading 359.9, pitch 10.5

A frame is its whole length (16 bits, big-endian), a frame id, a payload, and a CRC-16/XMODEM, big-endian, over all
bytes before the CRC. Nothing marks the beginning of a frame: each offset with a possible length and id is tried. A data
frame lists its own components. Sources: PNI TCM3/TCM5 manual r12 p. 33-43, TCM manual r06 p. 36-47, TRAX manual r06 p.
10 and 36-50; PNI's own pni-sdk-rs for component 88. Pitch is positive nose up, roll right side down (TRAX p. 10).

Floats are big-endian by default (kBigEndian, TRAX p. 42), but the device can save the other order. A little-endian
heading, read as big-endian, may be a small number that looks valid. So both orders are tried on all floats of a frame:
only a frame that is valid in exactly one order decides, and two such frames in a row change the order.
"""

from __future__ import annotations

import binascii
import functools
import math
import re
import struct
from typing import Final

from companion.protocols.decoding.base import ECHO, NO_FRAME, Decoder, RejectedError
from companion.protocols.decoding.dialogue import PollDialogue
from companion.samples import CompassSample, MagSample, Sample, TiltSample

SHORTEST: Final = 5
LONGEST: Final = 200

DISTORTION: Final = "magnetic distortion"
"""Rejection: the device reports its magnetometer out of range (80 to 150 uT by model), so the heading is invalid."""
HEADING_UNSURE: Final = "heading unsure"
"""Rejection: the device reports a heading error of more than 10 degrees (TRAX p. 49, kHeadingStatus 3)."""
NOT_CALIBRATED: Final = "not calibrated by the user"
BYTE_ORDER: Final = "byte order"

_MOD_INFO, _SET_COMPONENTS, _GET_DATA, _DATA = 1, 3, 4, 5
_COMMANDS: Final = frozenset((1, 3, 4, 6, 7, 9, 10, 11, 12, 13, 15, 21, 22, 24, 25, 29, 31, 36, 43, 46, 49, 52, 79, 80))
_KNOWN: Final = (
    _COMMANDS | frozenset(range(1, 32)) | {37, 44, 47, 53, 81, *range(107, 111), *range(119, 122), 128, 129, 130}
)

_HEADING, _TEMPERATURE, _DISTORTION, _CALIBRATED, _PITCH, _ROLL = 5, 7, 8, 9, 24, 25
_MAG = (27, 28, 29)
_QUATERNION, _HEADING_STATUS, _MAG_ACCURACY = 77, 79, 88
_BYTES: Final = frozenset((_DISTORTION, _CALIBRATED, _HEADING_STATUS))

_LIMITS: Final[dict[int, tuple[float, float, float]]] = {
    # Least and greatest value, and the least magnitude besides zero that a device sends. A smaller number is a float in
    # the other byte order.
    _HEADING: (0.0, 360.0, 1e-6),
    _PITCH: (-90.0, 90.0, 1e-6),
    _ROLL: (-180.0, 180.0, 1e-6),
    _TEMPERATURE: (-60.0, 150.0, 1e-6),
    **dict.fromkeys((21, 22, 23), (-100.0, 100.0, 1e-9)),
    **dict.fromkeys(_MAG, (-1e4, 1e4, 1e-6)),
    **dict.fromkeys((74, 75, 76), (-100.0, 100.0, 0.0)),
    _QUATERNION: (-1.001, 1.001, 0.0),
    _MAG_ACCURACY: (0.0, 1e4, 1e-6),
}
_SIZES: Final = {**dict.fromkeys(_LIMITS, 4), _QUATERNION: 16, **dict.fromkeys(_BYTES, 1)}
_UT_PER_GAUSS: Final = 100.0


class PniDecoder(Decoder):
    """Decoder of PNI frames into `CompassSample`, `MagSample`, and `TiltSample` if there is no heading."""

    _little = False
    _contrary = 0

    START = re.compile(b"\0")

    def _size(self, buffer: bytes, at: int) -> int:
        size = buffer[at + 1]
        if not SHORTEST <= size <= LONGEST or buffer[at + 2] not in _KNOWN:
            return NO_FRAME
        if buffer[at + 2] == _DATA:
            _components(buffer[at : at + size], size)
        return size

    def _check(self, frame: bytes) -> None:
        if binascii.crc_hqx(frame, 0) != 0:
            raise RejectedError("checksum")

    def _decode(self, frame: bytes, t_s: float) -> list[Sample]:
        if frame[2] != _DATA:
            raise RejectedError(ECHO if frame[2] in _COMMANDS else "reply")
        parts = _components(frame, len(frame))
        flags = {part: frame[place] for part, place in parts if part in _BYTES}
        values = self._values(frame, [(part, place) for part, place in parts if part not in _BYTES])
        if flags.get(_DISTORTION, 0) > 1 or flags.get(_CALIBRATED, 0) > 1:
            raise RejectedError("out of range")
        if flags.get(_DISTORTION):
            raise RejectedError(DISTORTION)
        if flags.get(_HEADING_STATUS) == 3:
            raise RejectedError(HEADING_UNSURE)
        samples: list[Sample] = []
        heading_deg, pitch_deg, roll_deg = (values.get(part) for part in (_HEADING, _PITCH, _ROLL))
        if roll_deg is not None and abs(roll_deg) > 90.0:
            raise RejectedError("out of range")  # upside down: the heading is not specified there
        if heading_deg is not None:
            samples.append(CompassSample(t_s, heading_deg, pitch_deg, roll_deg))
        elif pitch_deg is not None and roll_deg is not None:
            samples.append(TiltSample(t_s, roll_deg, pitch_deg, values.get(_TEMPERATURE)))
        if all(part in values for part in _MAG):
            x, y, z = (values[part] / _UT_PER_GAUSS for part in _MAG)
            samples.append(MagSample(t_s, (x, y, z)))
        if not samples:
            raise RejectedError("nothing of use")
        if flags.get(_CALIBRATED) == 0:
            self.warned[NOT_CALIBRATED] += 1
        return samples

    def _values(self, frame: bytes, parts: list[tuple[int, int]]) -> dict[int, float]:
        raw = b"".join(frame[place : place + _SIZES[part]] for part, place in parts)
        names = [part for part, _ in parts for _ in range(_SIZES[part] // 4)]
        big, little = (struct.unpack(f"{order}{len(names)}f", raw) for order in "><")
        possible = _possible(names, little), _possible(names, big)
        if not any(possible):
            finite = all(map(math.isfinite, little if self._little else big))
            raise RejectedError("out of range" if finite else "non-finite")
        if not possible[not self._little]:
            self._contrary += 1
            if self._contrary < 2:
                raise RejectedError(BYTE_ORDER)
            self._little = not self._little
        self._contrary = 0
        return dict(zip(names, little if self._little else big, strict=True))


def _possible(names: list[int], values: tuple[float, ...]) -> bool:
    for part, value in zip(names, values, strict=True):
        least, greatest, smallest = _LIMITS[part]
        if not least <= value <= greatest or 0.0 < abs(value) < smallest or (part == _HEADING and value == 360.0):
            return False
    return True


def _components(frame: bytes, size: int) -> list[tuple[int, int]]:
    """List the received components of a frame of `size` bytes, each as its id and the offset of its value."""
    here, last = 4, size - 2
    parts: list[tuple[int, int]] = []
    for _ in range(frame[3] if len(frame) > 3 else 0):
        if here >= last:
            raise RejectedError("field count")
        if here >= len(frame):
            return parts
        part = frame[here]
        if part not in _SIZES:
            raise RejectedError("unknown field")
        parts.append((part, here + 1))
        here += 1 + _SIZES[part]
    if here != last and len(frame) > 3:
        raise RejectedError("field count")
    return parts


def frame(frame_id: int, payload: bytes = b"") -> bytes:
    body = struct.pack(">HB", SHORTEST + len(payload), frame_id) + payload
    return body + struct.pack(">H", binascii.crc_hqx(body, 0))


# The device loses the selection of components with its power: kSave is "the ONLY command that causes the device to
# save information" (TRAX p. 46), and it is never sent. Question and answer have 57 bytes, 15 ms at 38400 baud.
PniDialogue = functools.partial(
    PollDialogue,
    frame(_GET_DATA),
    "kGetData",
    period_s=0.1,
    set_up=frame(_SET_COMPONENTS, bytes((8, _HEADING, _PITCH, _ROLL, _DISTORTION, _CALIBRATED, *_MAG))),
)
