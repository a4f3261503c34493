r"""Fluid gradienters that send `X=...` and `Y=...` as two lines: MEAS DPG2 and P-series, BEI INC and AGS.

    X=+00.430\r\nY=-00.084\r\n      degrees; two decimals on the 30 degree models
    X=+++++++\r\n                   over range (or X=-------)

Sources: MEAS DPG2 manual p. 10, P-series manual p. 13, BEI INC manual p. 10. Serial settings differ: DPG2 9600 8N1,
P-series 2400 8N1, BEI 9600 8E1. There is no checksum. A reading is a pair of adjacent lines, X first. Commands are
single letters that the device echoes; an echo in front of a line is skipped.
"""

from __future__ import annotations

import functools
import re
from typing import ClassVar, Literal

from companion.protocols.decoding.base import DAMAGED, LineDecoder, RejectedError
from companion.protocols.decoding.dialogue import PollDialogue
from companion.samples import TiltSample

_LAST_AXIS = re.compile(rb".*([XY])=", re.DOTALL)
_DEGREES = re.compile(rb"[+-]\d\d\.(\d{2,3})")
_SENTINEL = re.compile(rb"\+{3,}|-{3,}")
_SINGLE_AXIS = re.compile(rb"[+-]\d\d\.\d{2,3}")
_ECHO = re.compile(rb"[A-Za-z*]{1,8}")
_SURE = 4  # readings in a row with fewer decimals that redefine the format; a shorter run has lost digits

_SPOILED: Literal["spoiled"] = "spoiled"


class InclinometerXyDecoder(LineDecoder):
    """Decoder of `X=.../Y=...` line pairs into `TiltSample`, timed at the end of the Y line."""

    LIMIT: ClassVar[int] = 64
    _x_deg: float | Literal["spoiled"] | None = None
    """X reading that waits for its Y, deg; "spoiled": X was rejected, so its Y is rejected too."""
    _decimals = _fewer_running = 0

    def interrupted(self) -> None:
        super().interrupted()
        self._drop_x()

    def _drop_x(self) -> None:
        if isinstance(self._x_deg, float):
            self.rejected["orphan"] += 1
        self._x_deg = None

    def _line(self, line: bytes, t_s: float, *, cut: bool) -> TiltSample | None:
        if not cut and not line.strip(b"\r"):
            return None
        match = _LAST_AXIS.match(line)
        if match is None:
            self._drop_x()
            raise RejectedError(self._why_no_axis(line, cut=cut))
        before = line[: match.start(1)]
        if cut or before:
            self._pass_over(before, cut=cut)
        axis, text = match[1], line[match.end() :]
        if axis == b"Y":
            return self._y(text, t_s)
        self._x(text)
        self._earlier_bytes = len(line) + 1
        return None

    def _why_no_axis(self, line: bytes, *, cut: bool) -> str:
        if DAMAGED.search(line):
            return "parity"
        if cut:
            return "too long"
        return "single axis" if _SINGLE_AXIS.fullmatch(line.strip(b"\r")) else "not a measurement"

    def _pass_over(self, before: bytes, *, cut: bool) -> None:
        if not cut and _ECHO.fullmatch(before):
            return
        self.rejected["parity" if DAMAGED.search(before) else "too long" if cut else "cut short"] += 1
        self._drop_x()

    def _x(self, text: bytes) -> None:
        self._drop_x()
        try:
            self._x_deg = self._degrees(text)
        except RejectedError:
            self._x_deg = _SPOILED
            raise

    def _y(self, text: bytes, t_s: float) -> TiltSample | None:
        x_deg, self._x_deg = self._x_deg, None
        if x_deg == _SPOILED:
            return None  # the pair was counted as rejected with its X
        y_deg = self._degrees(text)
        if not isinstance(x_deg, float):
            raise RejectedError("orphan")
        return TiltSample(t_s, x_deg, y_deg)

    def _degrees(self, text: bytes) -> float:
        if DAMAGED.search(text):
            raise RejectedError("parity")
        value = text.removesuffix(b"\r")
        if value == text:
            raise RejectedError("line end")
        if _SENTINEL.fullmatch(value):
            raise RejectedError("over range")
        match = _DEGREES.fullmatch(value)
        if match is None:
            raise RejectedError("not a measurement")
        self._check_decimals(len(match[1]))
        degrees = float(value)
        if abs(degrees) > 90.0:
            raise RejectedError("out of range")
        return degrees

    def _check_decimals(self, decimals: int) -> None:
        """Reject a lost digit: a device prints a fixed number of decimals, so `+00.30` after `+00.430` is damaged."""
        if decimals < self._decimals:
            self._fewer_running += 1
            if self._fewer_running < _SURE:
                raise RejectedError("shape changed")
        self._decimals, self._fewer_running = decimals, 0


# Command for one reading; all models answer it while their stream is stopped (DPG2 p. 11, BEI p. 12). The letter that
# starts the stream differs, and a BEI in its setup level would store it.
InclinometerXyDialogue = functools.partial(PollDialogue, b"R", "R", period_s=0.2)
