"""Whether the autopilot and we believe each other: who signs, with which key; what to do where that does not fit.

Nobody has to be asking the autopilot for anything: a signature that is not right shows in all that it sends. Only an
autopilot that signs while we have no key has to be asked, for it may take unsigned messages all the same. It is asked
by TIMESYNC, which both firmwares answer at once, armed or not (autopilots 2, 4.5).
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections import Counter
from typing import Final, Literal

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.vehicle import Vehicle
from companion.component.statustext import Say, Severity, Weight
from companion.links.mavlink.link import MavlinkLink
from companion.links.mavlink.signing import Reason, Signing

logger = logging.getLogger(__name__)

AFTER_S: Final = 3.0
"""So long nothing of it is right before that is said: somebody else's packet is not it, nor a key being changed."""
UNANSWERED: Final = 3
"""So many questions in a row, one a second."""
ASK_AGAIN_S: Final = 30.0
"""One that has answered is asked again after so long."""
AGAIN_S: Final = 60.0
"""What changes to and fro is said no more often than this."""

_Doubt = Literal["other key", "unsigned", "old"]
_Kind = Literal["wants ours", "other key", "unsigned", "old"]

_WORDS: Final[dict[_Kind, tuple[str, str]]] = {
    "wants ours": (
        "the autopilot signs, and answers nothing that is not signed: give the companion its key (signing_key_file)",
        "Autopilot wants signatures: give us its key",
    ),
    "other key": (
        "the autopilot signs with another key than the companion: give both the same one",
        "Autopilot signs with another key: give both one",
    ),
    "unsigned": (
        "the autopilot does not sign on this link and is not believed: give it the companion's key",
        "Autopilot does not sign: give it our key",
    ),
    "old": (
        "the autopilot's signatures are older than before and not believed: wait some seconds, or restart it",
        "Autopilot's signatures are old: wait, or restart it",
    ),
}
"""In full, and in one line of STATUSTEXT."""


_TELLING: Final[dict[bool, tuple[_Doubt, ...]]] = {True: ("other key", "unsigned", "old"), False: ("other key",)}
"""By whether signatures are required: where they are not, an autopilot may still be without a key."""


class SignatureWatch:
    """Looks once a second; call `look`.

    Args:
        link: to ask over.
        vehicle: the autopilot.
        signing: of the link; None while nothing is signed or judged.
        say: tells people at the ground stations.
    """

    def __init__(
        self,
        link: MavlinkLink,
        vehicle: Vehicle,
        signing: Signing | None,
        say: Say,
    ) -> None:
        self._link, self._vehicle, self._signing, self._say = link, vehicle, signing, say
        self._kind: _Kind | None = None
        self._told_s: dict[_Kind, float] = {}
        self._was_told = False
        self._seen: Counter[Reason] = Counter()
        self._believed = 0
        self._bad_since_s: float | None = None
        self._dropped: Counter[Reason] = Counter()
        self._asked: int | None = None
        self._unanswered = 0
        self._ask_s = -math.inf
        if signing is None:
            link.subscribe(mavlink.MAVLink_timesync_message, self._on_timesync)

    @property
    def warning(self) -> str | None:
        """What does not fit, and what to do; None while all does, or nobody is heard."""
        return None if self._kind is None else _WORDS[self._kind][0]

    def dropped(self) -> Counter[Reason]:
        """Of the autopilot, or of who claims to be one: what was not right since the last that was."""
        self._count()
        return self._dropped

    def look(self, now_s: float) -> None:
        """See how it is now, and say what has changed."""
        found = self._unheard(now_s) if self._signing is None else self._unbelieved(self._signing, now_s)
        if found == self._kind:
            return
        before, self._kind = self._kind, found
        if found is not None:
            told_s = self._told_s.get(found, -math.inf)
            if now_s - told_s >= AGAIN_S:
                self._told_s[found], self._was_told = now_s, True
                words, line = _WORDS[found]
                logger.warning("mavlink: %s", words)
                self._say(Severity.WARNING, line, Weight.NEWS)
        elif before is not None and self._was_told and (self._signing is not None or self._vehicle.alive):
            self._was_told = False
            words = "Autopilot answers again" if self._signing is None else "Autopilot's signatures are right again"
            logger.info("mavlink: %s", words)
            self._say(Severity.NOTICE, words, Weight.NEWS)

    # --- we judge

    def _count(self) -> None:
        """Take note of what has come of it since the last look."""
        signing, vehicle = self._signing, self._vehicle
        if signing is None:
            return
        seen: Counter[Reason] = Counter()
        for (reason, system, component), number in signing.strangers.items():
            # Before it is known which autopilot is ours: whoever claims to be one.
            if component == vehicle.component_id and vehicle.system_id in (None, system):
                seen[reason] += number
        believed = signing.believed[vehicle.system_id or 0, vehicle.component_id]
        if believed > self._believed:
            self._dropped.clear()
        else:
            self._dropped += seen - self._seen
        self._seen, self._believed = seen, believed

    def _unbelieved(self, signing: Signing, now_s: float) -> _Kind | None:
        self._count()
        found = max(_TELLING[signing.required], key=lambda reason: self._dropped[reason])
        if not self._dropped[found]:
            self._bad_since_s = None
            return None
        if self._bad_since_s is None:
            self._bad_since_s = now_s
        return found if now_s - self._bad_since_s >= AFTER_S else self._kind

    # --- we are judged

    def _unheard(self, now_s: float) -> _Kind | None:
        if not self._vehicle.alive or not self._vehicle.signs:
            self._asked, self._unanswered, self._ask_s = None, 0, -math.inf
            return None
        if self._asked is not None:
            self._unanswered += 1
        if now_s >= self._ask_s:
            self._asked = round(now_s * 1e9)
            self._link.send(mavlink.MAVLink_timesync_message(0, self._asked))
        return "wants ours" if self._unanswered >= UNANSWERED else None

    def _on_timesync(self, message: mavlink.MAVLink_timesync_message, _t_s: float) -> None:
        if message.tc1 and message.ts1 == self._asked and self._vehicle.sent(message):
            self._asked, self._unanswered = None, 0
            self._ask_s = asyncio.get_running_loop().time() + ASK_AGAIN_S
