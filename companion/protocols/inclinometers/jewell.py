r"""Jewell Instruments (Applied Geomechanics) electrolytic tiltmeters: Tuff Tilt Digital, MD900-T, D700 series.

    $-00.619,000.023,018.910,N0000\r\n                                    SIM (default): X, Y, temperature, serial
    $YXXDR,A,000.034,D,N,A,-00.625,D,E,C,021.651,C,T-N0000*47\r\n         XDR: Y (N, north) first, then X (E, east)
    $PASHS,XDR,A,004.261,D,N,A,004.280,D,E,C,021.288,C,T-N1346\r\n        ASH: as XDR, without a checksum
    $P-00.907R002.186*1C\r\n                                              TCM: pitch is Y, roll is X

Sources: Tuff Tilt Digital manual B-06-1006 rev. E, p. 12 and 15; D700 manual B-03-1006 rev. K, p. 14. Tilts are degrees
(unit D) or microradians (M) in XDR and ASH. SIM has no unit and is read as degrees, the default: a device set to
microradians must send XDR.

A line without a checksum must have a uniform format: all its numbers are padded with zeros, or none.
"""

from __future__ import annotations

import functools
import math
import re
from typing import ClassVar, Final

from companion.protocols.decoding.base import (
    DAMAGED,
    TEMPERATURE_LIMIT_DEGC,
    LineDecoder,
    RejectedError,
    body_of_sentence,
)
from companion.protocols.decoding.dialogue import PollDialogue
from companion.samples import TiltSample

_PADDED: Final = rb"([-+0-9]\d\d\.\d{3})"
_PLAIN: Final = rb"([-+]?(?:0|[1-9]\d{0,2})\.\d{3})"
_MICRORADIANS: Final = rb"([-+]?\d{1,6}\.\d{3})"
_SERIAL: Final = rb"N\d{1,5}"

_SIM: Final = tuple(re.compile(rb"\$%b,%b,%b,%b" % (number, number, number, _SERIAL)) for number in (_PADDED, _PLAIN))
_XDR: Final = re.compile(
    rb"\$(YXXDR|PASHS,XDR),A,([-+.0-9]+),([DM]),N,A,([-+.0-9]+),([DM]),E,C,%b,C,T-%b(?:\*..)?" % (_PADDED, _SERIAL)
)
_TCM: Final = re.compile(rb"\$P%bR%b\*.." % (_PADDED, _PADDED))
_TILTS: Final = {b"D": re.compile(rb"%b|%b" % (_PADDED, _PLAIN)), b"M": re.compile(_MICRORADIANS)}

_START: Final = re.compile(rb".*(?=\$)", re.DOTALL)


class JewellDecoder(LineDecoder):
    """Decoder of Jewell lines in the formats SIM, XDR, ASH and TCM into `TiltSample`."""

    LIMIT: ClassVar[int] = 90

    def _line(self, line: bytes, t_s: float, *, cut: bool) -> TiltSample | None:
        text = line.removesuffix(b"\r")
        if text.rfind(b"$") == 0 and not cut:  # usual case
            return _reading(text, t_s)
        if not cut and not text:
            return None
        match = _START.match(text)
        if match is None:
            raise RejectedError(_why(text, cut=cut))
        if match.end() or cut:  # bytes before the "$": an earlier line without its line end
            self.rejected[_why(text[: match.end()], cut=cut)] += 1
        return _reading(text[match.end() :], t_s)


def _why(text: bytes, *, cut: bool) -> str:
    if DAMAGED.search(text):
        return "parity"
    if cut:
        return "too long"
    if text.startswith(b"ERR "):
        return "command refused"
    return "cut short" if text.startswith(b"$") else "not a measurement"


def _reading(text: bytes, t_s: float) -> TiltSample:
    if DAMAGED.search(text):
        raise RejectedError("parity")
    if b"\r" in text:
        raise RejectedError("line end")
    if b",A," not in text and (match := _SIM[0].fullmatch(text) or _SIM[1].fullmatch(text)):
        x, y, temperature = match.groups()
        return _sample(t_s, float(x), float(y), float(temperature))
    if match := _XDR.fullmatch(text):
        head, y, y_unit, x, x_unit, temperature = match.groups()
        if head == b"YXXDR":
            body_of_sentence(text)
        elif b"*" in text:
            raise RejectedError("not a measurement")
        return _sample(t_s, _degrees(x, x_unit), _degrees(y, y_unit), float(temperature))
    if match := _TCM.fullmatch(text):
        body_of_sentence(text)
        return _sample(t_s, float(match[2]), float(match[1]), None)
    raise RejectedError("not a measurement")


def _degrees(field: bytes, unit: bytes) -> float:
    if _TILTS[unit].fullmatch(field) is None:
        raise RejectedError("not a measurement")
    return float(field) if unit == b"D" else math.degrees(float(field) * 1e-6)


def _sample(t_s: float, x_deg: float, y_deg: float, temperature_degc: float | None) -> TiltSample:
    if max(abs(x_deg), abs(y_deg)) > 90.0 or abs(temperature_degc or 0.0) > TEMPERATURE_LIMIT_DEGC:
        raise RejectedError("out of range")
    return TiltSample(t_s, x_deg, y_deg, temperature_degc)


# Command for one reading in the current format, to any address (99). A command to stream exists, but the device would
# store it as an output setting (Tuff Tilt Digital manual, p. 15).
JewellDialogue = functools.partial(PollDialogue, b"*9900XY\r\n", "*9900XY", period_s=0.2)
