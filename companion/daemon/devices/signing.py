"""Signing in the daemon: the key, the time that outlives restarts, and words for people about who is not believed.

The key is read again and again until it can be: what was mended is found without a restart. Until then nothing is
believed where a signature is required.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections import Counter
from typing import Any, Final, Literal

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.vehicle import Vehicle
from companion.component.statustext import Say, Severity, Weight
from companion.config.sections import Config
from companion.daemon.core import Offload
from companion.errors import LinkError, StorageError
from companion.links.mavlink.link import MavlinkLink
from companion.links.mavlink.signing import (
    EARLIEST_S,
    TICKS_PER_S,
    Reason,
    Signing,
    read_key,
    ticks_of,
    uptime_s,
)
from companion.storage.learned import SIGNING_FILE, SigningTime, signing_time_in, this_boot

logger = logging.getLogger(__name__)

LOOK_S: Final = 1.0
AHEAD_S: Final = 30.0
"""So much time is reserved at once: one write in nearly that time, and so far ahead after a power cut. Senders more
than a minute behind are not believed at first (specification), so it stays well below that."""
RESERVE_BEFORE_S: Final = 5.0
KEY_AGAIN_S: Final = 10.0

_WHY: Final[dict[Reason, str]] = {
    "unsigned": "does not sign",
    "other key": "signs with another key",
    "old": "sends what is older than before",
    "no key": "cannot be checked without the key",
}

AFTER_S: Final = 3.0
"""How long nothing of it is right before that is said: somebody else's packet is not it, nor a key being changed."""
UNANSWERED: Final = 3
"""Unanswered questions in a row, one a second, after which the autopilot is taken to want signatures."""
ASK_AGAIN_S: Final = 30.0
"""Pause before an autopilot that has answered is asked again."""
AGAIN_S: Final = 60.0
"""The least time between two messages about what changes to and fro."""

AHEAD_OF_CLOCK_S: Final = 86400.0
"""Signing time so far ahead of the system's clock comes from a wrong clock, not from a board that was without power."""

_Doubt = Literal["other key", "unsigned", "old"]
_Kind = Literal["wants ours", "other key", "unsigned", "old", "ahead"]

_WORDS: Final[dict[_Kind, str]] = {
    "wants ours": "the autopilot wants signatures: give the companion its key (signing_key_file)",
    "other key": "the autopilot signs with another key: give both the same one",
    "unsigned": "the autopilot does not sign and is not believed: give it the companion's key",
    "old": "the autopilot's signatures are old, not believed: wait some seconds, or restart it",
    "ahead": f"signing time far ahead of this board's clock: stop the companion, delete {SIGNING_FILE}, start it",
}


_TELLING: Final[dict[bool, tuple[_Doubt, ...]]] = {True: ("other key", "unsigned", "old"), False: ("other key",)}
"""By whether signatures are required: where they are not, an autopilot may still be without a key."""


class SignatureWatch:
    """Whether the autopilot and we believe each other: who signs, with which key; what to do where that does not fit.

    Nobody has to be asking the autopilot for anything: a signature that is not right shows in all that it sends. Only
    an autopilot that signs while we have no key has to be asked, for it may take unsigned messages all the same. It is
    asked by TIMESYNC, which both firmwares answer at once, armed or not (autopilots 2, 4.5).
    """

    def __init__(self, link: MavlinkLink, vehicle: Vehicle, signing: Signing | None, say: Say) -> None:
        self._link, self._vehicle, self._signing, self._say = link, vehicle, signing, say
        self._kind: _Kind | None = None
        self._told_s: dict[_Kind, float] = {}
        self._was_told = False
        self._seen: Counter[Reason] = Counter()
        self._believed = 0
        self._bad_since_s: float | None = None
        self.dropped: Counter[Reason] = Counter()
        """Of the autopilot, or of who claims to be one: what was not right since the last that was."""
        self._asked: int | None = None
        self._unanswered = 0
        self._ask_s = -math.inf
        if signing is None:
            link.subscribe(mavlink.MAVLink_timesync_message, self._on_timesync)

    @property
    def warning(self) -> str | None:
        """What does not fit, and what to do; None while all does, or nobody is heard."""
        return None if self._kind is None else _WORDS[self._kind]

    def update(self, now_s: float) -> None:
        """See how it is now, and say what has changed."""
        found = self._unheard(now_s) if self._signing is None else self._unbelieved(self._signing, now_s)
        if found == self._kind:
            return
        before, self._kind = self._kind, found
        if found is not None:
            told_s = self._told_s.get(found, -math.inf)
            if now_s - told_s >= AGAIN_S:
                self._told_s[found], self._was_told = now_s, True
                logger.warning("mavlink: %s", _WORDS[found])
                self._say(Severity.WARNING, _WORDS[found], Weight.NEWS)
        elif before is not None and self._was_told and (self._signing is not None or self._vehicle.alive):
            self._was_told = False
            words = "Autopilot answers again" if self._signing is None else "Autopilot's signatures are right again"
            logger.info("mavlink: %s", words)
            self._say(Severity.NOTICE, words, Weight.NEWS)

    # --- we judge

    def _unbelieved(self, signing: Signing, now_s: float) -> _Kind | None:
        vehicle = self._vehicle
        seen: Counter[Reason] = Counter()
        for (reason, system, component), number in signing.strangers.items():
            # Before it is known which autopilot is ours: whoever claims to be one.
            if component == vehicle.component_id and vehicle.system_id in (None, system):
                seen[reason] += number
        believed = signing.believed[vehicle.system_id or 0, vehicle.component_id]
        if believed > self._believed:
            self.dropped.clear()
        else:
            self.dropped += seen - self._seen
        self._seen, self._believed = seen, believed
        found = max(_TELLING[signing.required], key=lambda reason: self.dropped[reason])
        if not self.dropped[found]:
            self._bad_since_s = None
            return None
        if self._bad_since_s is None:
            self._bad_since_s = now_s
        if now_s - self._bad_since_s < AFTER_S:
            return self._kind
        return "ahead" if found == "old" and signing.clock.ahead_of_wall_s > AHEAD_OF_CLOCK_S else found

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


class LinkSigning:
    """Looks after the signing of one link."""

    def __init__(self, config: Config, link: MavlinkLink, vehicle: Vehicle, say: Say, offload: Offload) -> None:
        self._config, self._vehicle, self._say, self._offload = config, vehicle, say, offload
        self.mode = config.mavlink.signing_mode
        self.signing: Signing | None = None
        self.trouble = ""
        """Why there is no key; empty when there is one."""
        self._kept = signing_time_in(config.storage.path)
        self._reserved = 0
        self._unwritable = self._setup_told = self._jump_told = False
        self._told: set[tuple[Reason, int, int]] = set()
        if self.mode != "off":
            # From the first byte on: what comes before the key is read is not believed either.
            self.signing = Signing(required=self.mode == "require")
            link.signing = self.signing
        self.watch = SignatureWatch(link, vehicle, self.signing, say)
        link.subscribe(mavlink.MAVLink_setup_signing_message, self._on_setup)

    def load(self) -> None:
        """Read time and key, before anything is sent; a key that cannot be read is tried again in `run`."""
        if self.signing is not None:
            ticks, in_this_boot = _go_on_from(self._kept.load(), uptime_s(), this_boot())
            self.signing.clock.resume(ticks, is_set=in_this_boot and ticks >= ticks_of(EARLIEST_S))
            self._take_key(self.signing)

    async def run(self) -> None:
        """Keep the time and tell of strangers, until cancelled."""
        signing = self.signing
        if signing is None:
            while True:
                await asyncio.sleep(LOOK_S)
                self.watch.update(asyncio.get_running_loop().time())
        while signing.key is None:
            await asyncio.sleep(KEY_AGAIN_S)
            self._take_key(signing)
        try:
            while True:
                if signing.clock.now() > self._reserved - int(RESERVE_BEFORE_S * TICKS_PER_S):
                    await self._keep(signing, AHEAD_S)
                self._tell(signing)
                self._tell_of_jump(signing.clock.refused_s)
                self.watch.update(asyncio.get_running_loop().time())
                await asyncio.sleep(LOOK_S)
        finally:
            # An orderly end reserves nothing: the next start goes on from here.
            await asyncio.shield(self._keep(signing, 0.0))

    def _take_key(self, signing: Signing) -> None:
        path = self._config.mavlink.signing_key_path
        assert path is not None  # the configuration's rules
        try:
            signing.take_key(read_key(path))
        except LinkError as error:
            if str(error) != self.trouble:
                logger.warning("mavlink: no signing: %s", error)
            self.trouble = str(error)
            return
        self.trouble = ""
        logger.info("mavlink: what is sent is signed, what comes unsigned is %s", self._fate)

    @property
    def _fate(self) -> str:
        return "dropped" if self.mode == "require" else "taken all the same"

    def _on_setup(self, message: mavlink.MAVLink_setup_signing_message, _t_s: float) -> None:
        """Nobody gives us a key over the wire; that somebody tries is worth a line."""
        if not self._setup_told:
            self._setup_told = True
            sender = f"{message.get_srcSystem()}/{message.get_srcComponent()}"
            logger.warning(
                "mavlink: %s sends a signing key over this link in the clear; it is ignored here. Set keys over USB",
                sender,
            )

    async def _keep(self, signing: Signing, ahead_s: float) -> None:
        now = signing.clock.now()
        reserved = now + int(ahead_s * TICKS_PER_S)
        try:
            await self._offload(self._kept.write, SigningTime(now, reserved, uptime_s(), this_boot()))
            self._unwritable = False
        except StorageError as error:
            level = logging.DEBUG if self._unwritable else logging.WARNING
            logger.log(level, "mavlink signing: after a restart its time may go back: %s", error)
            self._unwritable = True
        self._reserved = reserved

    def _tell(self, signing: Signing) -> None:
        """In the log and to the ground stations, once of each who is not believed."""
        for stranger in signing.strangers.keys() - self._told:
            self._told.add(stranger)
            reason, system, component = stranger
            logger.warning("mavlink: %d/%d %s: its messages are %s", system, component, _WHY[reason], self._fate)
            if signing.required:
                self._say(
                    Severity.WARNING,
                    f"Somebody {_WHY[reason]}, and is ignored: system {system}, component {component}",
                    Weight.NEWS,
                )

    def _tell_of_jump(self, refused_s: float) -> None:
        if refused_s and not self._jump_told:
            logger.info(
                "mavlink signing: the system's clock jumped %.1f days ahead: not followed until the board restarts",
                refused_s / 86400.0,
            )
        self._jump_told = refused_s > 0.0

    # --- words

    @property
    def rejecting(self) -> str | None:
        """Why the autopilot is not heard although something comes; None when signing is not why."""
        signing = self.signing
        if signing is None or not signing.required:
            return None
        if self.trouble:
            return self.trouble
        # Only who claims to be an autopilot explains why none is heard.
        ((reason, number),) = self.watch.dropped.most_common(1) or [("unsigned", 0)]
        if number == 0 or self._vehicle.alive:
            return None
        if self.watch.warning == _WORDS["ahead"]:
            return f"{number} messages dropped: {_WORDS['ahead']}"
        return {
            "unsigned": f"{number} unsigned messages dropped: the autopilot does not sign on this link",
            "other key": f"{number} messages dropped: the autopilot signs with another key",
            "old": f"{number} messages dropped: older than ones before, or the autopilot's clock is behind",
            "no key": f"{number} messages dropped: the signing key is still being read",
        }[reason]

    def status(self) -> dict[str, Any] | None:
        """For `companion status`; None while signing is off and nothing asks for it."""
        signing = self.signing
        if signing is None:
            if self.watch.warning is None:
                return None
            signing = Signing(required=False)  # nobody was checked
        doubted = sum(signing.doubted.values())
        summary = self.rejecting or self.trouble or self.watch.warning
        if not summary:
            summary = f"{signing.verified} messages checked"
            if doubted:
                summary += f", {doubted} {'dropped' if signing.required else 'not signed with our key'}"
        return {
            "good": self.rejecting is None and not self.trouble and self.watch.warning is None,
            "mode": self.mode,
            "summary": summary,
            "verified": signing.verified,
            "doubted": dict(signing.doubted),
            "strangers": [
                {"sender": f"{system}/{component}", "why": _WHY[reason], "messages": number}
                for (reason, system, component), number in signing.strangers.items()
            ],
        }


def _go_on_from(kept: SigningTime | None, now_s: float, boot_id: str) -> tuple[int, bool]:
    """Ticks later than any that was used, and whether they go on exactly, from earlier in this boot."""
    if kept is None:
        return 0, False
    if boot_id and boot_id == kept.boot_id and now_s >= kept.uptime_s:
        return kept.ticks + int((now_s - kept.uptime_s) * TICKS_PER_S) + 1, True
    return kept.reserved + 1, False
