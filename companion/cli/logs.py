"""How the daemon's log looks: for people on a terminal, with priorities in the journal, and never a flood.

Much of what is logged, somebody on the link can cause as often as he likes. Each place of the program has so many lines
a minute; the rest is counted, and the count is said.
"""

from __future__ import annotations

import copy
import dataclasses
import logging
import os
import sys
import time
from collections.abc import Callable
from typing import Final, TextIO

from companion.links.system.budget import Budget
from companion.printable import printable

# The journal reads the level from "<N>" at the beginning of a line, so that `journalctl -p warning` finds it.
_PRIORITIES: Final = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}

LINES_PER_S: Final = 0.1
BURST: Final = 10.0
"""The most lines of each place in the program: more than a day at the flight line makes at once."""
SAID_AFTER_S: Final = 60.0
"""How long after the last suppressed line their count is added to the next line of any place."""


@dataclasses.dataclass(slots=True)
class _Place:
    """A line of the program that logs."""

    budget: Budget = dataclasses.field(default_factory=lambda: Budget(LINES_PER_S, BURST))
    left_out: int = 0
    since_s: float = 0.0
    last: tuple[logging.LogRecord, float] | None = None
    """The latest that was left out, and when."""


class LimitedHandler(logging.StreamHandler[TextIO]):
    """Writes what the budgets allow.

    Args:
        stream: where to.
        clock: in seconds, never goes back.
    """

    def __init__(self, stream: TextIO, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(stream)
        self._clock = clock
        self._places: dict[tuple[str, int, int], _Place] = {}

    def emit(self, record: logging.LogRecord) -> None:
        """Write the record, or count it."""
        now_s = self._clock()
        here = self._places.setdefault((record.pathname, record.lineno, record.levelno), _Place())
        for place in self._places.values():
            if place is not here and place.last is not None and now_s - place.last[1] >= SAID_AFTER_S:
                self._say_left_out(place, place.last[0], place.left_out - 1, now_s)
        if here.budget.left(now_s) < 1.0:
            here.since_s = here.since_s if here.left_out else now_s
            here.left_out, here.last = here.left_out + 1, (record, now_s)
            return
        here.budget.take(1, now_s)
        if here.left_out:
            self._say_left_out(here, record, here.left_out, now_s)
        else:
            super().emit(record)

    def close(self) -> None:
        """Say what has been left out and not been said."""
        for place in self._places.values():
            if place.last is not None:
                self._say_left_out(place, place.last[0], place.left_out - 1, self._clock())
        super().close()

    def _say_left_out(self, place: _Place, record: logging.LogRecord, others: int, now_s: float) -> None:
        if others:
            record = copy.copy(record)
            words = f"{record.getMessage()} (and {others} more like this in the last {now_s - place.since_s:.0f} s)"
            record.msg, record.args = words, ()
        place.left_out, place.last = 0, None
        super().emit(record)


class OneLineFormatter(logging.Formatter):
    """A message is one line, whatever has come over a wire into it; only a traceback has more."""

    def format(self, record: logging.LogRecord) -> str:
        """Whoever reads the log on a terminal sees what it would obey."""
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
    """Log to stderr from a level on.

    Args:
        level: debug, info, warning or error.
    """
    handler = LimitedHandler(sys.stderr)
    if goes_to_journal(sys.stderr):
        handler.setFormatter(JournalFormatter("%(levelname)s %(message)s"))
    else:
        handler.setFormatter(OneLineFormatter("%(asctime)s %(levelname)s %(message)s"))
    logging.basicConfig(level=level.upper(), handlers=[handler])


def goes_to_journal(stream: TextIO) -> bool:
    """Whether a stream is the one that JOURNAL_STREAM names; the variable alone is inherited by whoever redirects."""
    named = os.environ.get("JOURNAL_STREAM")
    if named is None:
        return False
    try:
        status = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return named == f"{status.st_dev}:{status.st_ino}"
