"""Polls, and commands that start a stopped stream. Pure: the caller passes the time and sends the bytes.

No command is sent that a device stores or that toggles a mode, none while it streams, none with `read_only = true`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Final

from companion.messages import message

SILENT_S: Final = 2.0  # silence of a streaming device before anything is sent to it
ANSWER_S: Final = 1.0  # wait for an answer before the next question; no polled device documents a delay
PATIENCE: Final = 3
AGAIN_S: Final = 5.0
LONGEST_PAUSE_S: Final = 64.0


class Dialogue(ABC):
    """Requests and commands to one device; the dialogue starts anew when the port is opened again."""

    words = ""

    @abstractmethod
    def opened(self, t_s: float) -> None:
        """Reset the dialogue: the port was opened (again)."""

    @abstractmethod
    def heard(self, data: bytes, samples: int, t_s: float) -> None:
        """Record received bytes and the number of samples decoded from them; call this after decoding."""

    @abstractmethod
    def due(self, t_s: float) -> bytes:
        """Return the bytes to send now, or none. The caller asks every 20 ms or so, and after every `heard`."""


class PollDialogue(Dialogue):
    """Polls single readings: each request follows an answer; no request while the device streams by itself."""

    def __init__(self, question: bytes, name: str, *, period_s: float, set_up: bytes = b"") -> None:
        self.period_s = period_s
        self._question, self._name = question, name
        self._first = set_up + question
        """First request, with set-up; also sent after an unanswered request, as the device may have lost its power."""
        self._quiet_until_s = self._next_s = 0.0
        self._asked_s: float | None = None  # Time of the pending question; None: answered
        self._since_asked = self._unanswered = 0
        self._set_up = False

    def opened(self, t_s: float) -> None:
        self._quiet_until_s, self._asked_s, self._set_up, self._unanswered = t_s + SILENT_S, None, False, 0

    def heard(self, data: bytes, samples: int, t_s: float) -> None:
        if not data.strip(b"\r\n"):  # line end of an answer that was already decoded
            return
        if self._asked_s is None:
            self._quiet_until_s = t_s + SILENT_S
        elif samples:
            self._asked_s, self._unanswered = None, 0
        self._since_asked += len(data)

    def due(self, t_s: float) -> bytes:
        if self._asked_s is not None:
            if t_s - self._asked_s < (ANSWER_S if self._unanswered < PATIENCE else AGAIN_S):
                return b""
            self._asked_s, self._set_up = None, False
            self._unanswered += 1
            if self._since_asked > len(self._first):  # more than an echo: the device sends, though no answer
                self._quiet_until_s = t_s + SILENT_S
        if t_s < max(self._quiet_until_s, self._next_s):
            return b""
        self._asked_s, self._next_s, self._since_asked = t_s, t_s + self.period_s, 0
        answers = ", no answer yet" if self._unanswered else ""
        rate = f"{1.0 / self.period_s:.0f}"
        self.words = message("sensor_polled", rate=rate, command=self._name, answers=answers)
        set_up, self._set_up = self._set_up, True
        return self._question if set_up else self._first


class WakeDialogue(Dialogue):
    """Wakes a silent device by commands in turn, with doubling pauses; sends none while the device sends anything."""

    SAYINGS: ClassVar[tuple[tuple[bytes, str], ...]]
    _quiet_since_s: float | None = None
    _pause_s = SILENT_S
    _next = 0

    def opened(self, t_s: float) -> None:
        self._quiet_since_s, self._pause_s, self._next, self.words = t_s, SILENT_S, 0, ""

    def heard(self, data: bytes, samples: int, t_s: float) -> None:
        if data:
            self._quiet_since_s = t_s
        if samples:
            self._pause_s, self._next = SILENT_S, 0

    def due(self, t_s: float) -> bytes:
        if self._quiet_since_s is None or t_s - self._quiet_since_s < self._pause_s:
            return b""
        saying, self.words = self.SAYINGS[self._next]
        self._next += 1
        if self._next == len(self.SAYINGS):
            self._next, self._pause_s = 0, min(2.0 * self._pause_s, LONGEST_PAUSE_S)
        self._quiet_since_s = t_s
        return saying
