"""What is said to an `X=.../Y=...` gradienter that keeps silent; all of it holds only until it is switched off.

`F` starts the stream of a BEI INC or AGS, `S` that of a MEAS DPG2. But in a BEI's setup level `F` is stored in EEPROM
(BEI manual, p. 12), so it is asked for its level first with `*`: "U" and a letter is the user level, "S" and a letter
the setup level (p. 11). A MEAS in its user level does not react to that, nor to any other letter that it does not know
(DPG2 manual, p. 11); it is asked for one reading with `R`, which it gives only while stopped, and then gets its `S`.
Its setup level, which somebody would have to have typed "fima" for within the last ten minutes, has no such question.
"""

from __future__ import annotations

import re
from typing import Final, Literal

from companion.protocols.decoding.dialogue import SILENT_S, Dialogue

LEVEL_S: Final = 0.5
"""So long the answer to `*` is waited for: three characters, 13 ms at 2400 baud."""
READING_S: Final = 1.0
"""So long after `R` that no second reading comes from a device that was stopped: it streams 10 a second."""
AGAIN_S: Final = 5.0
SETUP_S: Final = 60.0
"""Until a device in its setup level is asked again."""

_USER: Final = re.compile(rb"\*?U[A-Z](?:\r\n)?")
_SETUP: Final = re.compile(rb"\*?S[A-Z](?:\r\n)?")
_READING: Final = re.compile(rb"R?X=[-+]+[0-9.]*\r\nY=[-+]+[0-9.]*\r\n")
_MOST: Final = 64
"""Bytes of an answer that are kept: two readings and more are no answer."""


class InclinometerXyDialogue(Dialogue):
    """Starts a stopped stream; says nothing to a device that streams, nor to one that is being set up."""

    def __init__(self) -> None:
        self._next_s = 0.0
        self._asked: Literal["", "level", "reading"] = ""
        self._answer = b""
        self._words = ""

    def opened(self, t_s: float) -> None:  # noqa: D102 - as in the base class
        self._listen(t_s + SILENT_S)

    def _listen(self, until_s: float) -> None:
        self._asked, self._next_s = "", until_s

    def heard(self, data: bytes, samples: int, t_s: float) -> None:  # noqa: D102
        if self._asked:
            self._answer = (self._answer + data)[:_MOST]
        else:
            self._next_s = max(self._next_s, t_s + SILENT_S)

    def due(self, t_s: float) -> bytes:  # noqa: D102
        if t_s < self._next_s:
            return b""
        if self._asked == "level":
            return self._after_level(t_s)
        if self._asked == "reading":
            return self._after_reading(t_s)
        return self._ask("level", b"*", t_s + LEVEL_S)

    def _ask(self, what: Literal["level", "reading"], question: bytes, until_s: float) -> bytes:
        self._asked, self._next_s, self._answer = what, until_s, b""
        self._words = f"silent: asked with {question.decode()}"
        return question

    def _after_level(self, t_s: float) -> bytes:
        if not self._answer:
            return self._ask("reading", b"R", t_s + READING_S)
        if _SETUP.fullmatch(self._answer):
            self._listen(t_s + SETUP_S)
            self._words = "it is in its setup level: switch it off and on"
            return b""
        self._listen(t_s + SILENT_S)
        return self._start(b"F") if _USER.fullmatch(self._answer) else b""

    def _after_reading(self, t_s: float) -> bytes:
        if _READING.fullmatch(self._answer):
            self._listen(t_s + SILENT_S)
            return self._start(b"S")
        self._listen(t_s + AGAIN_S)
        return b""

    def _start(self, letter: bytes) -> bytes:
        self._words = f"it was stopped: stream started with {letter.decode()}"
        return letter

    @property
    def words(self) -> str:  # noqa: D102
        return self._words
