"""MAVLink signing in the daemon: the key, the signature timestamp across restarts, and refused senders."""

from __future__ import annotations

import asyncio
import logging
import math
from collections import Counter
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.vehicle import Vehicle
from companion.component.statustext import Say, Severity, Weight
from companion.config.sections import Config
from companion.daemon.core import Offload
from companion.errors import LinkError, StorageError
from companion.links.mavlink.link import MavlinkLink
from companion.links.mavlink.signing import EARLIEST_S, TICKS_PER_S, Reason, Signing, read_key, ticks_of, uptime_s
from companion.messages import message
from companion.storage.records import SIGNING_FILE, SigningTime, signing_time_in, this_boot

logger = logging.getLogger(__name__)

PERIOD_S: Final = 1.0
AHEAD_S: Final = 30.0
"""Range of signature timestamps reserved by one write to disk, hence the largest jump ahead after a power cut. The
specification refuses new senders that are more than a minute behind, so the jump stays well below that."""
RESERVE_BEFORE_TICKS: Final = 5 * TICKS_PER_S
UNANSWERED: Final = 3
"""Tolerated TIMESYNC requests in a row without answer, one a second; more show that the autopilot wants signatures."""
ASK_AGAIN_S: Final = 30.0  # Pause after an answer of the autopilot before the next request
AFTER_S: Final = 3.0
"""Time without a verified message of the autopilot before a fault is reported; a change of the key takes less."""
AHEAD_OF_CLOCK_S: Final = 86400.0
"""Lead of the signature timestamp over the system clock that proves a wrong clock, not merely a power cut."""

_COUNTED: Final[tuple[Reason, ...]] = ("other key", "unsigned", "old")
_FAULTS: Final = {
    "required": "the autopilot wants signatures: give the companion its key (signing_key_file)",
    "other key": "the autopilot signs with another key: give both the same one",
    "unsigned": "the autopilot does not sign on this link: give it the companion's key",
    "old": "the autopilot's signatures are too old, rejected: wait some seconds, or restart it",
    "ahead": f"signing time far ahead of this board's clock: stop the companion, delete {SIGNING_FILE}, start it",
}
_SENDERS: Final[dict[Reason, str]] = {
    "unsigned": "does not sign",
    "other key": "signs with another key",
    "old": "repeats old messages",
}


class LinkSigning:
    """Signs and verifies one link; reports whether the autopilot and the companion accept each other's messages.

    An autopilot that signs while the companion has no key may still accept unsigned messages. The answer to a TIMESYNC
    request shows that it does: both firmwares answer at once, armed or not (autopilots.md sections 2 and 4.5).
    """

    def __init__(self, config: Config, link: MavlinkLink, vehicle: Vehicle, say: Say, offload: Offload) -> None:
        self._config, self._link, self._vehicle, self._say, self._offload = config, link, vehicle, say, offload
        self.mode = config.mavlink.signing_mode
        self.signing: Signing | None = None
        self.trouble = ""
        self._stored = signing_time_in(config.storage.path)
        self._reserved = 0
        self._write_failed = False
        self._named: set[Reason] = set()  # Reasons already reported of a sender other than the autopilot
        self.warning: str | None = None  # Present fault of the autopilot's signatures, with its remedy
        self._refused: Counter[Reason] = Counter()
        """Number of refused messages with the autopilot's ids since its last verified one, by reason."""
        self._verified = False
        self._bad_since_s: float | None = None
        self._asked = self._unanswered = 0
        self._ask_s = -math.inf
        if self.mode == "off":
            link.subscribe(mavlink.MAVLink_timesync_message, self._on_timesync)
        else:
            # Signing applies from the first byte on: messages before the key is read are refused too.
            self.signing = link.signing = Signing(required=self.mode == "require")
            self.signing.on_verified, self.signing.on_refused = self._on_verified, self._on_refused

    def load(self) -> None:
        if self.signing is None:
            return
        ticks, in_this_boot = 0, False
        if (stored := self._stored.load()) is not None:
            boot, now_s = this_boot(), uptime_s()
            in_this_boot = bool(boot) and boot == stored.boot_id and now_s >= stored.uptime_s
            ticks = stored.ticks + int((now_s - stored.uptime_s) * TICKS_PER_S) if in_this_boot else stored.reserved
            ticks += 1
        self.signing.clock.resume(ticks, is_set=in_this_boot and ticks >= ticks_of(EARLIEST_S))
        self._read_key(self.signing)

    async def run(self) -> None:
        signing = self.signing
        try:
            while True:
                if signing is not None and signing.key is None:
                    self._read_key(signing)
                elif signing is not None and signing.clock.now() > self._reserved - RESERVE_BEFORE_TICKS:
                    await self._reserve(signing, AHEAD_S)
                self._update(asyncio.get_running_loop().time())
                await asyncio.sleep(PERIOD_S)
        finally:
            # At an orderly end no time is reserved: the next start continues from this time.
            if signing is not None and signing.key is not None:
                await asyncio.shield(self._reserve(signing, 0.0))

    def _read_key(self, signing: Signing) -> None:
        path = self._config.mavlink.signing_key_path
        assert path is not None  # a rule of the configuration
        try:
            signing.key = read_key(path)
        except LinkError as error:
            if str(error) != self.trouble:
                logger.warning("mavlink: %s", error)
            self.trouble = str(error)
            return
        self.trouble = ""
        signing.doubted.clear()
        logger.info("mavlink: sent messages are signed, unsigned ones are %s", self._fate)

    @property
    def _fate(self) -> str:
        return "dropped" if self.mode == "require" else "accepted"

    async def _reserve(self, signing: Signing, ahead_s: float) -> None:
        now = signing.clock.now()
        self._reserved = now + int(ahead_s * TICKS_PER_S)
        try:
            await self._offload(self._stored.write, SigningTime(now, self._reserved, uptime_s(), this_boot()))
            self._write_failed = False
        except StorageError as error:
            level = logging.DEBUG if self._write_failed else logging.WARNING
            logger.log(level, "%s", message("signing_time_not_saved", reason=error))
            self._write_failed = True

    def _is_autopilot(self, system: int, component: int) -> bool:
        return component == self._vehicle.component_id and self._vehicle.system_id in (None, system)

    def _on_verified(self, system: int, component: int) -> None:
        self._verified = self._verified or self._is_autopilot(system, component)

    def _on_refused(self, reason: Reason, system: int, component: int) -> None:
        if reason == "no key":
            return
        if self._is_autopilot(system, component):
            self._refused[reason] += 1
            return
        if reason in self._named:
            return
        self._named.add(reason)
        sender = f"{system}/{component}"
        words = message("sender_not_verified", sender=sender, fault=_SENDERS[reason], fate=self._fate)
        logger.warning("%s", words)
        if self.mode == "require":
            self._say(Severity.WARNING, words, Weight.NEWS)

    def _on_timesync(self, message: mavlink.MAVLink_timesync_message, _t_s: float) -> None:
        if message.tc1 and message.ts1 == self._asked and self._vehicle.sent(message):
            self._unanswered, self._ask_s = 0, asyncio.get_running_loop().time() + ASK_AGAIN_S

    def _update(self, now_s: float) -> None:
        found = self._refused_by_autopilot(now_s) if self.signing is None else self._refuses(self.signing, now_s)
        if found == self.warning:
            return
        self.warning = found
        if found is not None:
            logger.warning("mavlink: %s", found)
            self._say(Severity.WARNING, found, Weight.NEWS)
        elif self.signing is not None or self._vehicle.alive:
            logger.info("mavlink: %s", message("signing_fault_over"))
            self._say(Severity.NOTICE, message("signing_fault_over"), Weight.NEWS)

    def _refused_by_autopilot(self, now_s: float) -> str | None:
        if not self._vehicle.alive or not self._vehicle.signs:
            self._unanswered, self._ask_s = 0, -math.inf
        elif now_s >= self._ask_s:
            self._asked, self._unanswered = round(now_s * 1e9), self._unanswered + 1
            self._link.send(mavlink.MAVLink_timesync_message(0, self._asked))
        return _FAULTS["required"] if self._unanswered > UNANSWERED else None

    def _refuses(self, signing: Signing, now_s: float) -> str | None:
        if self._verified:
            self._verified = False
            self._refused.clear()
        # If signatures are not required, an autopilot without a key is no fault.
        counted = _COUNTED if signing.required else _COUNTED[:1]
        found = max(counted, key=lambda reason: self._refused[reason])
        if not self._refused[found]:
            self._bad_since_s = None
            return None
        if self._bad_since_s is None:
            self._bad_since_s = now_s
        if now_s - self._bad_since_s < AFTER_S:
            return self.warning
        return _fault_of(signing, found)

    @property
    def rejecting(self) -> str | None:
        """Signing fault that keeps the companion from finding the autopilot although messages arrive, or None."""
        if self.signing is None or not self.signing.required:
            return None
        if self.trouble:
            return self.trouble
        if not self._refused or self._vehicle.alive:
            return None
        found = max(_COUNTED, key=lambda reason: self._refused[reason])
        fault = _fault_of(self.signing, found)
        return message("autopilot_messages_dropped", count=self._refused[found], fault=fault)

    def status(self) -> dict[str, Any] | None:
        if self.signing is None and self.warning is None:
            return None
        signing = self.signing or Signing(required=False)
        fault = self.rejecting or self.trouble or self.warning
        counts = f"{signing.verified} messages checked"
        if doubted := signing.doubted.total():
            counts += f", {doubted} {'dropped' if signing.required else 'not signed with our key'}"
        return {
            "good": not fault,
            "mode": self.mode,
            "summary": fault or counts,
            "verified": signing.verified,
            "doubted": dict(signing.doubted),
        }


def _fault_of(signing: Signing, reason: Reason) -> str:
    is_ahead = reason == "old" and signing.clock.ahead_of_wall_s > AHEAD_OF_CLOCK_S
    return _FAULTS["ahead" if is_ahead else reason]
