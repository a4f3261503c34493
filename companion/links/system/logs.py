"""The daemon's log: for people on a terminal, with priorities in the journal.

Each place of the program has so many lines a minute, as others can cause them at will; the rest is counted.
"""

from __future__ import annotations

import copy
import logging
import os
import sys
import time
from collections import Counter
from collections.abc import Callable
from typing import Final, TextIO

from companion.formats import printable
from companion.links.system.connection import Budget

# The journal reads the level from "<N>" at the beginning of a line, so that `journalctl -p warning` finds it.
_PRIORITIES: Final = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}

LINES_PER_S: Final = 0.1
BURST: Final = 10.0


class LimitedHandler(logging.StreamHandler[TextIO]):
    """Writes what the budgets allow; the clock is in seconds and never goes back."""

    def __init__(self, stream: TextIO, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(stream)
        self._clock = clock
        self._budgets: dict[tuple[str, int, int], Budget] = {}
        self._left_out: Counter[tuple[str, int, int]] = Counter()

    def emit(self, record: logging.LogRecord) -> None:
        """Write the record with the count of those left out before it, or count it."""
        now_s = self._clock()
        place = record.pathname, record.lineno, record.levelno
        budget = self._budgets.setdefault(place, Budget(LINES_PER_S, BURST))
        if budget.left(now_s) < 1.0:
            self._left_out[place] += 1
            return
        budget.spend(1, now_s)
        if left_out := self._left_out.pop(place, 0):
            record = copy.copy(record)
            record.msg = f"{record.getMessage()} (after {left_out} more like this, left out)"
            record.args = ()
        super().emit(record)


class OneLineFormatter(logging.Formatter):
    """A message is one line, whatever has come over a wire into it; only a traceback has more."""

    def format(self, record: logging.LogRecord) -> str:
        """Make control characters visible: a terminal would obey them."""
        said = copy.copy(record)
        said.msg, said.args = printable(record.getMessage()), None
        return "\n".join(map(printable, super().format(said).splitlines()))


class JournalFormatter(OneLineFormatter):
    """Lines as journald wants them; it stamps the time itself."""

    def format(self, record: logging.LogRecord) -> str:
        """Every line of a traceback gets the priority too."""
        prefix = f"<{_PRIORITIES.get(record.levelno, 6)}>"
        return "\n".join(prefix + line for line in super().format(record).splitlines() or [""])


def set_up(level: str) -> None:
    """Log to stderr from a level on: debug, info, warning or error."""
    handler = LimitedHandler(sys.stderr)
    if goes_to_journal(sys.stderr):
        handler.setFormatter(JournalFormatter("%(levelname)s %(message)s"))
    else:
        handler.setFormatter(OneLineFormatter("%(asctime)s %(levelname)s %(message)s"))
    logging.basicConfig(level=level.upper(), handlers=[handler])


def goes_to_journal(stream: TextIO) -> bool:
    """Return whether JOURNAL_STREAM names this stream; the variable alone is inherited by any redirection."""
    named = os.environ.get("JOURNAL_STREAM")
    if named is None:
        return False
    try:
        status = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return named == f"{status.st_dev}:{status.st_ino}"
