"""Messages that are wanted all the time, and asked for again whenever they stay away."""

from __future__ import annotations

import dataclasses
import math
from typing import Final

from companion.autopilot.vehicle.commands import Commands
from companion.links.mavlink.link import Message

FIRST_PAUSE_S: Final = 3.0
LONGEST_PAUSE_S: Final = 30.0


@dataclasses.dataclass(slots=True)
class _Wanted:
    message: type[Message]
    rate_hz: float | None
    """None: wanted once, and again after a restart."""
    heard_s: float = -math.inf
    asked_s: float = -math.inf
    pause_s: float = FIRST_PAUSE_S


class StandingRequests:
    """Asks for messages by interval; less and less often where they never come."""

    def __init__(self, commands: Commands) -> None:
        self._commands = commands
        self._wanted: list[_Wanted] = []

    def add(self, message: type[Message], rate_hz: float | None) -> None:
        """Want a message from now on; without a rate, only once after every `forget_asking`."""
        self._wanted.append(_Wanted(message, rate_hz))

    def heard(self, message: Message, t_s: float) -> None:
        """One has come."""
        for wanted in self._wanted:
            if wanted.message.msgname == message.get_type():
                wanted.heard_s, wanted.pause_s = t_s, FIRST_PAUSE_S

    def forget_asking(self) -> None:
        """Ask at once for whatever is missing: what was streamed before a loss is gone after a restart."""
        for wanted in self._wanted:
            wanted.asked_s, wanted.pause_s = -math.inf, FIRST_PAUSE_S
            if wanted.rate_hz is None:
                wanted.heard_s = -math.inf

    def ask_for_missing(self, now_s: float) -> None:
        """Ask for what has stayed away, unless it was asked for a short time ago."""
        for wanted in self._wanted:
            age_s = now_s - wanted.heard_s
            silent = age_s == math.inf if wanted.rate_hz is None else age_s > 2.5 / wanted.rate_hz
            if silent and now_s - wanted.asked_s > wanted.pause_s:
                if wanted.asked_s > -math.inf:
                    wanted.pause_s = min(2 * wanted.pause_s, LONGEST_PAUSE_S)
                wanted.asked_s = now_s
                if wanted.rate_hz is None:
                    self._commands.request_message(wanted.message.id)
                else:
                    self._commands.request_message_interval(wanted.message.id, wanted.rate_hz)
