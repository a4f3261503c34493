"""How one of our own sensors does: its port and its stream together, counted, and said once per change."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from typing import Final

from companion.links.serial.bytestream import ByteLink
from companion.links.system.listeners import Listeners
from companion.protocols.decoding.base import Decoder
from companion.protocols.stream_health import SILENT, SILENT_AFTER_S, StreamHealth, Trouble

logger = logging.getLogger(__name__)

ABSENT: Final = "absent"
FLOOD: Final = "flood"
FLOOD_S: Final = 1.0
RENEW_AFTER_S: Final = 2.5
"""How long a connection may be silent before it is made anew: a sensor that streams says something every second."""
RENEW_POLLED_AFTER_S: Final = 6.0
"""The same for a sensor that must be asked: time to be asked, and to answer."""
GOOD_AFTER_S: Final = 1.0
AGAIN_S: Final = 60.0
"""How soon after its last line the same trouble goes to the detailed log only: a loose wire must not fill the other."""


class SensorHealth:
    """What is wrong with one sensor now, and how often what has been; `polled`: it speaks only when it is asked."""

    def __init__(self, link: ByteLink, protocol: str, decoder: Decoder, *, polled: bool) -> None:
        self.link, self.protocol = link, protocol
        self.stream = StreamHealth(protocol, decoder)
        self.counts: Counter[str] = Counter()
        """How often each trouble has begun, and each event happened."""
        self._stuck: Trouble | None = None
        self.on_implausible: Listeners[Trouble] = Listeners()
        """Told, as often as the log, when its readings begin to look good without being so."""
        self._renew_after_s = RENEW_POLLED_AFTER_S if polled else RENEW_AFTER_S
        self._opened_s = self._grace_since_s = 0.0
        self._renewed = False
        self._said: str | None = None
        self._began_s = 0.0
        self._good_since_s: float | None = None
        self._told_s: dict[str, float] = {}
        self._received = (0.0, 0)
        self._bytes_per_s = 0.0

    def opened(self) -> None:
        """The port was opened (again)."""
        self._opened_s = asyncio.get_running_loop().time()
        if not self._renewed:
            self._grace_since_s = self._opened_s
        self._renewed = False
        self.stream.opened()

    def trouble(self, now_s: float) -> Trouble | None:
        """What is wrong with it, worst first; None while good samples come."""
        if not self.link.connected:
            words = self.link.last_error or f"{self.link.settings.url}: not open yet"
            return Trouble(SILENT if self._renewed else ABSENT, words)
        found = self._flood(now_s) or self.stream.trouble(now_s) or self._stuck
        if found is None:
            return None
        return Trouble(found.key, f"{self.link.settings}: {found.words}", found.implausible)

    def _is_flooded(self, now_s: float) -> bool:
        budget = self.link.budget
        return budget is not None and budget.exceeded_s is not None and now_s - budget.exceeded_s < FLOOD_S

    def _flood(self, now_s: float) -> Trouble | None:
        if not self._is_flooded(now_s):
            return None
        rate = f"{self._bytes_per_s / 1e3:.0f} kB/s" if self._bytes_per_s else "too much"
        return Trouble(FLOOD, f"floods us ({rate}); the surplus is thrown away: another device, or a loop-back?")

    def update(self, now_s: float, stuck: Trouble | None = None) -> Trouble | None:
        """See how it does, count and say what has changed, and ask a silent peer anew; called about twice a second.

        `stuck`: its reading stays while the aircraft does not, as who sees the other sensors too has found.
        """
        self._stuck = stuck
        since_s, before = self._received
        if now_s - since_s >= 1.0:
            self._bytes_per_s = (self.link.bytes_received - before) / (now_s - since_s) if since_s else 0.0
            self._received = (now_s, self.link.bytes_received)
        for event in self.stream.events:
            self.counts[event.key] += 1
            self._tell(event, now_s)
        self.stream.events.clear()
        if self._is_flooded(now_s):
            # What of its frames is damaged is damaged by what was thrown away; two looks fall into FLOOD_S.
            self.stream.excuse()
        found = self.trouble(now_s)
        if found is None:
            # Whatever is open and speaks as configured is the right one.
            self.link.confirm()
        self._say(found, now_s)
        self._renew(now_s)
        return found

    def _say(self, found: Trouble | None, now_s: float) -> None:
        if found is None:
            if self._said is None:
                return
            if self._good_since_s is None:
                self._good_since_s = now_s
            if now_s - self._good_since_s >= GOOD_AFTER_S:
                logger.info("%s: good again after %.0f s", self.link.name, self._good_since_s - self._began_s)
                self._said = None
            return
        self._good_since_s = None
        if found.key == self._said:
            return
        if found.key == ABSENT or (now_s - self._grace_since_s < SILENT_AFTER_S and not found.implausible):
            return  # the port says itself that it is gone; and what was just opened has a moment to begin
        if self._said is None:
            self._began_s = now_s
        self._said = found.key
        self.counts[found.key] += 1
        if self._tell(found, now_s) and found.implausible:
            self.on_implausible.tell(found)

    def _tell(self, what: Trouble, now_s: float) -> bool:
        """In the log; whether in the ordinary one."""
        told_s = self._told_s.get(what.key)
        again = told_s is not None and now_s - told_s < AGAIN_S
        self._told_s[what.key] = now_s
        logger.log(
            logging.DEBUG if again else logging.WARNING, "%s: %s (%d so far)", self.link.name, what.words,
            self.counts[what.key],
        )  # fmt: skip
        return not again

    def _renew(self, now_s: float) -> None:
        """A peer behind tcp:// that vanished without a word, or that accepts and says nothing."""
        if not self.link.settings.is_tcp or not self.link.connected:
            return
        heard_s = max(self._opened_s, self.link.last_byte_s or 0.0)
        if now_s - heard_s >= self._renew_after_s:
            self.counts["renewed"] += 1
            self._renewed = True
            self.link.renew(f"silent for {now_s - heard_s:.1f} s, asked anew")

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
