"""One command to the companion and all its answers, over a radio that loses some of them.

MAVLink's command protocol, from the asking side: repeat with a counted-up `confirmation` until the first answer, then
follow IN_PROGRESS to the one final answer. When progress falls silent the final answer may have been lost: the same
request again brings it back for as long as the companion remembers it (`component.commands`), and later than that
must not be sent, since it would count as a new one.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.commands import REMEMBER_FINAL_S
from companion.ground.heard import Address, Fields, whole
from companion.links.system.waiting import comes

if TYPE_CHECKING:
    from companion.ground.link import GroundLink

ANSWER_WITHIN_S: Final = (0.6, 0.6, 0.6, 0.6, 1.6)
"""Timeout of each attempt: 0.3 s for the companion, the rest for the radio. All attempts end while the companion
remembers the end of the first; else the last could start another calibration."""
REPEAT_AFTER_S: Final = (1.2, 1.5, 1.8, 2.1, 2.4)
"""Seconds without an answer after which progress is asked for again: two ACKs may be lost in a row before. The last
leaves the radio the rest of the time for which the companion remembers its final answer."""
assert max(REPEAT_AFTER_S[-1], sum(ANSWER_WITHIN_S[:-1])) < REMEMBER_FINAL_S - 0.5
ENDED_AFTER_S: Final = 5.0
"""Silence, while heartbeats show no work, after which the end counts as missed."""
LOST_AFTER_S: Final = 20.0
_TICK_S: Final = 0.25


class Exchange:
    """A request; `run` it once, then read its end.

    `busy`: whether the companion is at work, by a heartbeat later than a time; None: there was none. `on_progress` is
    told how far it is and for how long nothing has come, several times a second.
    """

    def __init__(
        self,
        link: GroundLink,
        target: Address,
        command: int,
        *parameters: float,
        busy: Callable[[float], bool | None],
        on_progress: Callable[[int, float], None] = lambda percent, silent_s: None,
    ) -> None:
        self._link, self._target, self._command = link, target, command
        self._busy, self._on_progress = busy, on_progress
        self._parameters = (*parameters, *(0.0,) * (7 - len(parameters)))
        self.result: int | None = None
        """MAV_RESULT of the final answer; None: none came."""
        self.detail = 0
        """`result_param2` of the final answer."""
        self.unanswered = False
        """No answer came to any attempt."""
        self._answered = asyncio.Event()
        self._heard_s = 0.0
        self._confirmation = 0
        self.percent = 0

    async def run(self) -> None:
        """Ask and wait for the end; without an answer or a heartbeat at most 20 s."""
        stop_watching = self._link.on_ack.add(self._on_ack)
        try:
            self.unanswered = not await self._begin()
            while not self.unanswered and self.result is None and await self._follow():
                pass
        finally:
            stop_watching()

    async def _begin(self) -> bool:
        for within_s in ANSWER_WITHIN_S:
            self._send()
            if await self._hears(within_s):
                return True
        return False

    async def _follow(self) -> bool:
        """Wait for one more answer; False when there is no use in waiting on."""
        loop = asyncio.get_running_loop()
        repeats = list(REPEAT_AFTER_S)
        while not await self._hears(_TICK_S):
            silent_s = loop.time() - self._heard_s
            self._on_progress(self.percent, silent_s)
            if repeats and silent_s >= repeats[0]:
                del repeats[0]
                self._send()
            busy = self._busy(max(self._heard_s + ENDED_AFTER_S / 2, loop.time() - LOST_AFTER_S))
            if (busy is False and silent_s >= ENDED_AFTER_S) or (busy is None and silent_s >= LOST_AFTER_S):
                return False
        self._on_progress(self.percent, 0.0)
        return True

    def _send(self) -> None:
        self._link.send_command(self._target, self._command, self._parameters, min(self._confirmation, 255))
        self._confirmation += 1

    async def _hears(self, within_s: float) -> bool:
        if not await comes(self._answered, within_s):
            return False
        self._answered.clear()
        return True

    def _on_ack(self, source: Address, ack: Fields) -> None:
        if source != self._target or whole(ack, "command") != self._command or self.result is not None:
            return
        self._heard_s = asyncio.get_running_loop().time()
        result, progress = whole(ack, "result"), whole(ack, "progress")
        if result != mavlink.MAV_RESULT_IN_PROGRESS:
            self.result, self.detail = result, whole(ack, "result_param2")
        elif progress <= 100:
            self.percent = max(self.percent, progress)
        self._answered.set()
