"""What is said to a Honeywell HMR3300 or HMR3200 that keeps silent.

`*S` toggles the stream and so is never sent blind: it would stop a device that streams behind a bad contact. `*Q` asks
for one line and is obeyed only while the stream is stopped (Honeywell's HMR3200/HMR3300 data sheet). So a device that
has been silent is asked for one line; that line, alone, proves that it is there and stopped, and only then does `*S`
follow.
"""

from __future__ import annotations

import re
from typing import Final

from companion.protocols.decoding.dialogue import SILENT_S, Dialogue

ANSWER_S: Final = 1.0
"""So long an answer is waited for; it has no documented delay."""
ALONE_S: Final = 0.4
"""So long after the answer no other line may come: three periods of the stream (8 lines a second, HMR3200: 15)."""
AGAIN_S: Final = 5.0
"""Between two questions that nobody has answered as expected."""

_ONE_LINE: Final = re.compile(rb"[-+0-9][-+0-9., ]{0,38}\r\n")
_MOST: Final = 80
"""Bytes of an answer that are kept: two lines and more are no answer."""


class Hmr3300Dialogue(Dialogue):
    """Starts a stopped stream; says nothing to a device that streams."""

    def __init__(self) -> None:
        self._ask_at_s = 0.0
        self._asked_s: float | None = None
        self._heard_s: float | None = None
        self._answer = b""
        """What came since the question."""
        self._words = ""

    def opened(self, t_s: float) -> None:  # noqa: D102 - as in the base class
        self._ask_at_s, self._asked_s = t_s + SILENT_S, None

    def heard(self, data: bytes, samples: int, t_s: float) -> None:  # noqa: D102
        if self._asked_s is None:
            # Whatever it says, even what cannot be read: it is no device that keeps silent.
            self._ask_at_s = t_s + SILENT_S
        else:
            self._answer, self._heard_s = (self._answer + data)[:_MOST], t_s

    def due(self, t_s: float) -> bytes:  # noqa: D102
        if self._asked_s is None:
            if t_s < self._ask_at_s:
                return b""
            self._asked_s, self._heard_s, self._answer = t_s, None, b""
            self._words = "silent: asked for one line with *Q"
            return b"*Q\r\n"
        if t_s < (self._asked_s + ANSWER_S if self._heard_s is None else self._heard_s + ALONE_S):
            return b""
        self._asked_s = None
        if _ONE_LINE.fullmatch(self._answer):
            self._ask_at_s = t_s + SILENT_S
            self._words = "it was stopped: stream started with *S"
            return b"*S\r\n"
        self._ask_at_s = t_s + AGAIN_S
        return b""

    @property
    def words(self) -> str:  # noqa: D102
        return self._words
