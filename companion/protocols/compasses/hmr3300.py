r"""Honeywell HMR3300 (three axes) and HMR3200 (two): lines of numbers, no checksum and no start mark.

    123.4, 18.6, -0.5\r\n      heading, pitch, roll in degrees (HMR3300, mode *H)
    235.6\r\n                  heading only (HMR3200, mode *H)
    1256, -234, -1894\r\n      magnetometer counts (mode *M): no decimal point in any field
    #I\r\n                     the answer to an unknown command

Source: Honeywell's HMR3200/HMR3300 data sheet: 19200 baud 8N1, 8 lines/s. Nothing marks a line's start. So a line is
accepted only after a whole line end, because the end of a cut line, "3.4, 18.6, -0.5", looks like a valid line.
"""

from __future__ import annotations

import functools
import re
from typing import ClassVar

from companion.protocols.decoding.base import DAMAGED, LineDecoder, RejectedError
from companion.protocols.decoding.dialogue import PollDialogue
from companion.samples import CompassSample, MagSample, Sample

_DEGREES = re.compile(rb"[+-]?\d{1,3}\.\d{1,3}")
_COUNTS = re.compile(rb"[+-]?\d{1,6}")
_FRAGMENT = re.compile(rb"[-+0-9., ]+")
_COUNTS_LIMIT = 32768
_SURE = 3
"""Consecutive lines of three numbers that settle the format; as many consecutive lines of one number change it."""


class Hmr3300Decoder(LineDecoder):
    """Decoder of HMR3300 and HMR3200 lines into `CompassSample`, or `MagSample` with counts in mode *M."""

    LIMIT: ClassVar[int] = 40
    _follows_line_end = True
    _triples = _singles = 0

    def interrupted(self) -> None:
        super().interrupted()
        self._follows_line_end = False

    def _line(self, line: bytes, t_s: float, *, cut: bool) -> Sample | None:
        follows_line_end, self._follows_line_end = self._follows_line_end, True
        if cut:
            raise RejectedError("too long")
        if not line.strip(b"\r"):
            # A bare line feed in mid-stream may be a damaged first digit; after a gap it is the end of a CR LF.
            self._follows_line_end = bool(line) or not follows_line_end
            return None
        if DAMAGED.search(line):
            raise RejectedError("parity")
        text = line.removesuffix(b"\r")
        if text == line or b"\r" in text:
            # If damage changes a digit into a line end, the remainder looks like a whole line.
            self._follows_line_end = _FRAGMENT.fullmatch(line) is None
            raise RejectedError("line end")
        if not follows_line_end:
            raise RejectedError("cut short")
        return self._measurement(text, t_s)

    def _measurement(self, text: bytes, t_s: float) -> Sample:
        if text.startswith(b"#"):
            raise RejectedError("command refused")
        fields = [field.strip(b" ") for field in text.split(b",")]
        if len(fields) == 4 and fields[3] == b"C":
            raise RejectedError("calibrating")
        degrees = all(map(_DEGREES.fullmatch, fields))
        if not degrees and not all(map(_COUNTS.fullmatch, fields)):
            raise RejectedError("not a measurement")  # the banner after power-on, or damage
        if len(fields) != 3 and not (degrees and len(fields) == 1):
            raise RejectedError("field count")
        if degrees:
            return self._heading([float(field) for field in fields], t_s)
        x, y, z = (int(field) for field in fields)
        if max(abs(x), abs(y), abs(z)) > _COUNTS_LIMIT:
            raise RejectedError("out of range")
        return MagSample(t_s, counts=(x, y, z))

    def _heading(self, values: list[float], t_s: float) -> CompassSample:
        heading_deg, *tilt_deg = values
        if not 0.0 <= heading_deg < 360.0 or any(abs(angle) > 90.0 for angle in tilt_deg):
            raise RejectedError("out of range")
        if tilt_deg:
            self._triples, self._singles = min(self._triples + 1, _SURE), 0
            return CompassSample(t_s, heading_deg, tilt_deg[0], tilt_deg[1])
        self._singles = min(self._singles + 1, _SURE)
        if self._triples == _SURE and self._singles < _SURE:
            raise RejectedError("shape changed")
        self._triples = 0
        return CompassSample(t_s, heading_deg)


# One line, while the stream is stopped. `*S` would start the stream, but toggles it, so it is never sent.
Hmr3300Dialogue = functools.partial(PollDialogue, b"*Q\r\n", "*Q", period_s=0.125)
