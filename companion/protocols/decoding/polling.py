"""Asking a device that speaks only when it is asked."""

from __future__ import annotations

from typing import ClassVar, Final

from companion.protocols.decoding.dialogue import SILENT_S, Dialogue

ANSWER_S: Final = 1.0
"""So long an answer is waited for before the device is asked again; none of those asked here documents a delay."""


class PollDialogue(Dialogue):
    """Asks for one reading after another, each only after the answer to the last; silent while the device speaks.

    What the device says without having been asked ends the asking, until it has been silent for `SILENT_S` again.
    """

    QUESTION: ClassVar[bytes]
    SET_UP: ClassVar[bytes] = b""
    """Said before the first question, and before the one after a question in vain: it may have been without power."""
    PERIOD_S: ClassVar[float]
    NAME: ClassVar[str]

    def __init__(self) -> None:
        self._quiet_until_s = 0.0
        self._asked_s: float | None = None
        """When the question was put that has not been answered yet."""
        self._next_s = 0.0
        self._set_up = False
        self._words = ""

    def opened(self, t_s: float) -> None:  # noqa: D102 - as in the base class
        self._quiet_until_s = t_s + SILENT_S
        self._asked_s = None
        self._set_up = False

    def heard(self, data: bytes, samples: int, t_s: float) -> None:  # noqa: D102
        if not data:
            return
        if self._asked_s is None:
            self._quiet_until_s = t_s + SILENT_S
        elif samples:
            self._asked_s = None

    def due(self, t_s: float) -> bytes:  # noqa: D102
        if self._asked_s is not None:
            if t_s - self._asked_s < ANSWER_S:
                return b""
            self._asked_s, self._set_up = None, False
        if t_s < max(self._quiet_until_s, self._next_s):
            return b""
        self._asked_s, self._next_s = t_s, t_s + self.PERIOD_S
        self._words = f"asked {1.0 / self.PERIOD_S:.0f} times a second with {self.NAME}"
        set_up, self._set_up = self._set_up, True
        return self.QUESTION if set_up else self.SET_UP + self.QUESTION

    @property
    def words(self) -> str:  # noqa: D102
        return self._words
