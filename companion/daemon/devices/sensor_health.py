"""Health of one of our own sensors: its port and its stream together, counted, and logged once per change."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from typing import Final

from companion.links.serial.bytestream import ByteLink
from companion.protocols.decoding.base import Decoder
from companion.protocols.stream_health import SILENT_AFTER_S, StreamHealth, Trouble

logger = logging.getLogger(__name__)

ABSENT: Final = "absent"
FLOOD: Final = "flood"
RESTARTED: Final = "restarted"
FLOOD_S: Final = 1.0
GOOD_AFTER_S: Final = 1.0
AGAIN_S: Final = 60.0
"""Shortest time between two warnings of one trouble; others go to the detailed log, as a loose wire would fill it."""


class SensorHealth:
    """Present trouble of one sensor, and how often each trouble has begun."""

    def __init__(self, link: ByteLink, protocol: str, decoder: Decoder) -> None:
        self.link, self.protocol, self._decoder = link, protocol, decoder
        self.stream = StreamHealth(protocol, decoder)
        self.counts: Counter[str] = Counter()
        self._breaks = 0
        self._stuck: Trouble | None = None
        self._opened_s = 0.0
        self._reported: str | None = None
        self._began_s = 0.0
        self._good_since_s: float | None = None
        self._warned_s: dict[str, float] = {}
        self._received = (0.0, 0)
        self._bytes_per_s = 0.0

    def opened(self) -> None:
        """Forget the stream of before: the port was opened (again)."""
        self._opened_s = asyncio.get_running_loop().time()
        self.stream.opened()

    def trouble(self, now_s: float) -> Trouble | None:
        """Return what is wrong with it, worst first; None while good samples come."""
        if not self.link.connected:
            return Trouble(ABSENT, self.link.last_error or f"{self.link.settings.url}: not open yet")
        found = self._flood(now_s) or self.stream.trouble(now_s) or self._stuck
        if found is None:
            return None
        return Trouble(found.key, f"{self.link.settings}: {found.words}", found.implausible)

    def _flood(self, now_s: float) -> Trouble | None:
        budget = self.link.budget
        if budget is None or budget.exceeded_s is None or now_s - budget.exceeded_s >= FLOOD_S:
            return None
        rate = f"{self._bytes_per_s / 1e3:.0f} kB/s" if self._bytes_per_s else "too much"
        return Trouble(FLOOD, f"floods us ({rate}); the surplus is thrown away: another device, or a loop-back?")

    def update(self, now_s: float, stuck: Trouble | None = None) -> tuple[Trouble | None, bool]:
        """Count and log changes, twice a second; return the trouble, and whether it was logged as a warning now."""
        self._stuck = stuck
        since_s, before = self._received
        if now_s - since_s >= 1.0:
            self._bytes_per_s = (self.link.bytes_received - before) / (now_s - since_s) if since_s else 0.0
            self._received = (now_s, self.link.bytes_received)
        if (breaks := self._decoder.times.clock.breaks) != self._breaks:
            self.counts[RESTARTED] += breaks - self._breaks
            self._breaks = breaks
            self._warn(Trouble(RESTARTED, "the device restarted, or its clock jumped; measuring afresh"), now_s)
        found = self.trouble(now_s)
        if found is not None and found.key == FLOOD:
            # What was thrown away has damaged its frames; two calls fall into FLOOD_S.
            self.stream.excuse()
        return found, self._report(found, now_s)

    def _report(self, found: Trouble | None, now_s: float) -> bool:
        if found is None:
            if self._reported is None:
                return False
            if self._good_since_s is None:
                self._good_since_s = now_s
            if now_s - self._good_since_s >= GOOD_AFTER_S:
                logger.info("%s: good again after %.0f s", self.link.name, self._good_since_s - self._began_s)
                self._reported = None
            return False
        self._good_since_s = None
        if found.key == self._reported:
            return False
        if found.key == ABSENT or (now_s - self._opened_s < SILENT_AFTER_S and not found.implausible):
            return False  # the port reports itself that it is gone; what was just opened has a moment to begin
        if self._reported is None:
            self._began_s = now_s
        self._reported = found.key
        self.counts[found.key] += 1
        return self._warn(found, now_s)

    def _warn(self, what: Trouble, now_s: float) -> bool:
        again = now_s - self._warned_s.get(what.key, -AGAIN_S) < AGAIN_S
        self._warned_s[what.key] = now_s
        level = logging.DEBUG if again else logging.WARNING
        logger.log(level, "%s: %s (%d so far)", self.link.name, what.words, self.counts[what.key])
        return not again

    def status(self) -> dict[str, object]:
        """For `companion status` and `check`."""
        found = self.trouble(asyncio.get_running_loop().time())
        return {
            "trouble": found.key if found is not None else None,
            "counts": dict(self.counts),
            "protocol": self.protocol,
            "speaks": self.stream.speaks,
            "port": self.link.settings.url,
        }
