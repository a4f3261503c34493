"""Devices that answer one question with one line: they are asked again and again while they do not speak by themselves.

A question leaves no trace, so it is used even for a device that could be told to stream: an HMR3000 keeps the rates of
its sentences in EEPROM (HMR3000 manual, 3.8), a Jewell tiltmeter its output settings (Tuff Tilt Digital manual, p. 15).
"""

from __future__ import annotations

from typing import ClassVar, Final

from companion.protocols.decoding.dialogue import SILENT_S, Dialogue

ANSWER_S: Final = 1.0
"""So long an answer is waited for before the question is asked again."""
AGAIN_S: Final = 5.0
"""The same after `PATIENCE` questions that nobody has answered."""
PATIENCE: Final = 3


class PollDialogue(Dialogue):
    """Asks a silent device; stops as soon as it says more than it was asked."""

    QUESTION: ClassVar[bytes]
    PERIOD_S: ClassVar[float]
    """From one question to the next while answers come."""

    def __init__(self) -> None:
        self._ask_at_s = 0.0
        self._asked_s: float | None = None
        """When the question was last asked; None while listening."""
        self._lines = 0
        """Line ends since then."""
        self._unanswered = 0
        self._words = ""

    def opened(self, t_s: float) -> None:  # noqa: D102 - as in the base class
        self._listen(t_s)
        self._unanswered = 0

    def _listen(self, t_s: float) -> None:
        self._ask_at_s, self._asked_s = t_s + SILENT_S, None

    def heard(self, data: bytes, samples: int, t_s: float) -> None:  # noqa: D102
        if self._asked_s is None:
            self._listen(t_s)
            return
        self._lines += data.count(b"\n")
        if self._lines > 1:
            self._listen(t_s)
            self._words = f"polled with {self._question}, until it spoke by itself"
        elif self._lines:
            self._unanswered = 0
            self._ask_at_s = max(self._asked_s + self.PERIOD_S, t_s)

    def due(self, t_s: float) -> bytes:  # noqa: D102
        if t_s < self._ask_at_s:
            return b""
        if self._asked_s is not None and not self._lines:
            self._unanswered += 1
        self._asked_s, self._lines = t_s, 0
        self._ask_at_s = t_s + (ANSWER_S if self._unanswered < PATIENCE else AGAIN_S)
        answers = "" if not self._unanswered else ", no answer yet"
        self._words = f"silent: polled with {self._question}{answers}"
        return self.QUESTION

    @property
    def _question(self) -> str:
        return self.QUESTION.decode().strip()

    @property
    def words(self) -> str:  # noqa: D102
        return self._words


class Hmr3000Dialogue(PollDialogue):
    """`$PTNT,HPR*78` to an HMR3000, which comes with all its sentences switched off; to others an unknown sentence.

    It measures 13.75 times a second (HMR3000 manual, p. 8).
    """

    QUESTION = b"$PTNT,HPR*78\r\n"
    PERIOD_S = 0.1


class JewellDialogue(PollDialogue):
    """`*9900XY` to a Jewell tiltmeter: one reading in the format that is set, from whichever target it is (99)."""

    QUESTION = b"*9900XY\r\n"
    PERIOD_S = 0.2
