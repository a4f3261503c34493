"""How the daemon's log looks: for people on a terminal, with priorities in the journal."""

from __future__ import annotations

import copy
import logging
import os
import sys
from typing import Final, TextIO

from companion.printable import printable

# The journal reads the level from "<N>" at the beginning of a line, so that `journalctl -p warning` finds it.
_PRIORITIES: Final = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}


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
    handler = logging.StreamHandler(sys.stderr)
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
