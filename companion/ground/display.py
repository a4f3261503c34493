"""Progress for people, on stderr: a bar and what is said on a terminal, plain lines anywhere else."""

from __future__ import annotations

import os
import sys
from typing import Final

from companion.printable import printable

_BAR: Final = 30


class Display:
    """Draws the bar anew in its line; what is said goes above it. `close` takes it off the terminal."""

    def __init__(self) -> None:
        self._redraws = sys.stderr.isatty() and os.environ.get("TERM", "dumb") != "dumb"
        self._shown = ""

    def progress(self, percent: int, text: str) -> None:
        """How far it is."""
        text = printable(text)
        if self._redraws:
            self._shown = f"[{'#' * (percent * _BAR // 100):.<{_BAR}}] {percent:3d} % {text}"
            self._write(self._shown)
        elif text != self._shown:
            self._shown = text
            self._write(f"[{percent:3d} %] {text}\n")

    def text(self, text: str, *, urgent: bool) -> None:
        """What the companion says."""
        text = printable(text)
        if not self._redraws:
            self._write(f"{text}\n")
        else:
            self._write(f"\x1b[1m{text}\x1b[0m\n" if urgent else f"{text}\n")
            self._write(self._shown)

    def close(self) -> None:
        """It has ended."""
        self._write("")

    def _write(self, text: str) -> None:
        sys.stderr.write(f"\r\x1b[K{text}" if self._redraws else text)
        sys.stderr.flush()
