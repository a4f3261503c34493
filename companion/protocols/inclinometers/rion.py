"""RION HCM compasses and HCA inclinometers: frames that begin with 0x68, angles in packed decimal digits.

    68 0D 00 84 | 00 10 50 | 10 10 05 | 01 04 01 | 1C      pitch +10.50, roll -10.05, heading 104.01

After 0x68 come the length (of all bytes but 0x68), address, command, data, and the low byte of the sum of all bytes
between 0x68 and the sum. An angle is a sign (0 or 1) and hundreds, then tens and units, then tenths and hundredths. The
8-bit sum is weak, but few byte values are valid digits of angles: noise passes at one offset in 10^16.

Sources: HCM370B/375B manual p. 11-12, HCM705B manual p. 12-17 (9600 8N1; "heading no negative"). The frame of 16 bytes
with two angles of seven digits is the HCA726's, known only from a public driver, which ignores the command byte. Its
answer is assumed to be 0x84 as for other models. No document of the SCA and ACA inclinometers was found; they
reportedly use the compass' frame, and are decoded so. Records of floats (0x94) are neither requested nor read.
"""

from __future__ import annotations

import functools
import re
from typing import Final

from companion.protocols.decoding.base import ECHO, NO_FRAME, Decoder, RejectedError
from companion.protocols.decoding.dialogue import PollDialogue
from companion.samples import CompassSample, Sample, TiltSample

LONGEST: Final = 51

_READ, _ANSWER, _REPLY_BIT = 0x04, 0x84, 0x80
_ANGLES_LENGTH, _LONG_ANGLES_LENGTH = 0x0D, 0x0F
_DOCUMENTED: Final = frozenset((*range(0x04, 0x10), 0x14, 0x2A, *range(0x41, 0x51)))
_LENGTHS: Final[dict[int, frozenset[int]]] = {
    **{code: frozenset(range(4, 9)) for code in (*_DOCUMENTED, *(code | _REPLY_BIT for code in _DOCUMENTED))},
    0x48: frozenset(range(6, 16)),
    0x94: frozenset(range(10, LONGEST, 5)),
    _ANSWER: frozenset((_ANGLES_LENGTH, _LONG_ANGLES_LENGTH)),
}
"""Allowed frame lengths by command byte. For most commands the documents give no length, but show short frames."""


class RionDecoder(Decoder):
    """Decoder of RION frames into `CompassSample`, or `TiltSample` for the longer frame of an inclinometer."""

    START = re.compile(b"\x68")

    def _size(self, buffer: bytes, at: int) -> int:
        length = buffer[at + 1]
        if not 4 <= length < LONGEST or length not in _LENGTHS.get(buffer[at + 3], ()):
            return NO_FRAME
        return 1 + length

    def _check(self, frame: bytes) -> None:
        if sum(frame[1:-1]) & 0xFF != frame[-1]:
            raise RejectedError("checksum")
        if frame[3] == _ANSWER:
            _measurement(frame, 0.0)  # without valid angles the sum is probably right by chance: no frame

    def _decode(self, frame: bytes, t_s: float) -> list[Sample]:
        if frame[3] != _ANSWER:
            raise RejectedError("reply" if frame[3] & _REPLY_BIT else ECHO)
        return [_measurement(frame, t_s)]


def _measurement(frame: bytes, t_s: float) -> Sample:
    data = frame[4:-1]
    if len(data) == 9:
        pitch_deg, roll_deg, heading_deg = (_degrees(data[at : at + 3], 100) for at in (0, 3, 6))
        if not 0.0 <= heading_deg < 360.0 or max(abs(pitch_deg), abs(roll_deg)) > 90.0:
            raise RejectedError("out of range")
        return CompassSample(t_s, heading_deg, pitch_deg, roll_deg)
    x_deg, y_deg = _degrees(data[0:4], 10_000), _degrees(data[4:8], 10_000)
    if max(abs(x_deg), abs(y_deg)) > 90.0:
        raise RejectedError("out of range")
    return TiltSample(t_s, x_deg, y_deg)


def _degrees(digits: bytes, per_degree: int) -> float:
    text = digits.hex()
    if not text.isdecimal() or text[0] not in "01":
        raise RejectedError("not a number")
    value = int(text[1:]) / per_degree
    return -value if text[0] == "1" else value


# Polling is the default mode (HCM370B p. 11, HCM705B p. 12). Question and answer: up to 21 bytes, 97 ms at 2400 baud.
RionDialogue = functools.partial(PollDialogue, bytes((0x68, 4, 0, _READ, 4 + _READ)), "68 04 00 04 08", period_s=0.2)
