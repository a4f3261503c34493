"""Who may have the component do something: as `mavlink.allow` says; reading is everybody's.

A sender's ids are what it says they are. Against impostors only signatures help (`links/mavlink/signing.py`).
"""

from __future__ import annotations

import logging
from collections import Counter
from typing import Final

from companion.config.sections import EVERYBODY, Senders

logger = logging.getLogger(__name__)

MAX_REMEMBERED: Final = 32


class Permission:
    """Judges and counts; says in the log once for each sender what it was refused."""

    def __init__(self, senders: Senders | None = None) -> None:
        self._senders = senders or Senders(EVERYBODY)
        self.refused: Counter[tuple[int, int]] = Counter()
        """By sender: the first 32."""

    def allow(self, senders: Senders) -> None:
        """From now on these may."""
        self._senders = senders

    def refuses(self, sender: tuple[int, int], what: str) -> str:
        """Why a sender (system, component) may not ask for this, in a few words; empty when it may."""
        if sender in self._senders:
            return ""
        system, component = sender
        if sender not in self.refused and len(self.refused) < MAX_REMEMBERED:
            logger.warning("mavlink: %s by %d/%d is refused: mavlink.allow does not name it", what, system, component)
            self.refused[sender] = 0
        if sender in self.refused:
            self.refused[sender] += 1
        return f"{system}/{component} not in mavlink.allow"
