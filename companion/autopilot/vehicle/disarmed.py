"""The one place that decides whether the autopilot is surely disarmed: it is asked, and its answer is waited for.

A heartbeat tells the past: it may have waited in a radio, in the kernel, or here while our process stood still. So the
question is a TIMESYNC with a number that nobody can know beforehand. Both firmwares send it back at once, armed or not
(autopilots 2, 4.5). A heartbeat that comes behind that answer was sent after the question left. No clock is compared
with another one, and no wall clock is read.

On an unsigned link whoever hears the question can answer it. What is proven there: some sender under the autopilot's
ids said "disarmed" after the question, and none said "armed" within 3 s, nor in the time that the slowest answers of
late have taken. On a signed link the autopilot itself has said so.
"""

from __future__ import annotations

import asyncio
import math
import os
from collections import deque
from collections.abc import Callable
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.commands import Commands
from companion.autopilot.vehicle.heartbeats import ArmState
from companion.errors import NotDisarmedError
from companion.links.mavlink.link import MavlinkLink
from companion.links.system.events import comes
from companion.messages import message

PROOF_HOLDS_S: Final = 1.5  # from the question to the write: some heartbeats come once a second only

LONGEST_PAUSE_S: Final = 0.1
"""After a longer pause of our own loop no earlier question counts: what is read then may have waited for that long."""

ASK_AGAIN_S: Final = 0.3
GIVE_UP_S: Final = 8.0  # with a fifth lost both ways 26 questions stay unanswered once in 10^11 times

_LONGEST_WAIT_S: Final = 0.75  # slower answers are not waited for, so that a proof holds for a while
_PULSE_S: Final = 0.02  # our own loop is checked while an answer is awaited
_REMEMBERED: Final = 8  # questions whose answers are still known, and answers whose times are


class DisarmedProof:
    """Judges answers to our questions. Pure: numbers and times come in."""

    def __init__(self) -> None:
        self._asked_s: dict[int, float] = {}
        self._answers_s: deque[float] = deque(maxlen=_REMEMBERED)
        """Times from question to answer, also of a second answer to the same question."""
        self._begun_s = self._awake_s = math.inf
        self._answered_s = self._proven_s = -math.inf
        """When the latest question was asked that has an answer; and that has a disarmed heartbeat behind it."""

    @property
    def slowest_s(self) -> float:
        """The longest time of a recent answer. A forger may be nearer than the autopilot: wait for both."""
        return min(max(self._answers_s, default=0.0), _LONGEST_WAIT_S)

    def begin(self, now_s: float) -> None:
        """Only questions from here on count."""
        self._begun_s = self._awake_s = now_s
        self._answered_s = self._proven_s = -math.inf

    def awake(self, now_s: float) -> bool:
        """Note that our own loop runs; False after a pause, which takes the worth from all earlier questions."""
        paused = now_s - self._awake_s > LONGEST_PAUSE_S
        if paused:
            self._asked_s.clear()
            self.begin(now_s)
        self._awake_s = now_s
        return not paused

    def asked(self, number: int, now_s: float) -> None:
        self._asked_s[number] = now_s
        if len(self._asked_s) > _REMEMBERED:
            del self._asked_s[next(iter(self._asked_s))]

    def answered(self, number: int, now_s: float) -> None:
        asked_s = self._asked_s.get(number)
        if asked_s is not None:
            self._answers_s.append(now_s - asked_s)
            if asked_s >= self._begun_s:
                self._answered_s = max(self._answered_s, asked_s)

    def heard(self, *, armed: bool) -> None:
        if armed:
            self._answered_s = -math.inf
        self._proven_s = self._answered_s

    def holds(self, now_s: float) -> bool:
        """Tell whether it was disarmed after a question, and nobody said "armed" in the time that answers take."""
        return self.awake(now_s) and self.slowest_s <= now_s - self._proven_s <= PROOF_HOLDS_S


class DisarmedCheck:
    """Asks one autopilot, before each thing that may only be done to it while it is disarmed.

    `state`: what its heartbeats say; `name`: of the autopilot, for people.
    """

    def __init__(
        self, link: MavlinkLink, commands: Commands, state: Callable[[], ArmState], name: Callable[[], str]
    ) -> None:
        self._link, self._commands, self._state, self._name = link, commands, state, name
        self._proof = DisarmedProof()
        self._news = asyncio.Event()

    async def ensure(self) -> None:
        """Return in the moment in which it is surely disarmed; whoever asked acts before anything else runs.

        Raises:
            NotDisarmedError: it is armed, two speak in its name, or nothing proves that it is disarmed.
        """
        loop = asyncio.get_running_loop()
        begun_s = ask_s = loop.time()
        self._proof.begin(begun_s)
        request: asyncio.Future[int | None] | None = None
        try:
            while not (self._link.settled() and self.proven()):
                now_s = loop.time()
                state = self._state()
                if state is ArmState.ARMED or (now_s - begun_s > GIVE_UP_S and state is ArmState.UNKNOWN):
                    raise NotDisarmedError(state.why_not_written)
                if now_s - begun_s > GIVE_UP_S:
                    words = message("arm_question_not_answered", autopilot=self._name(), seconds=f"{GIVE_UP_S:g}")
                    raise NotDisarmedError(words)
                if now_s >= ask_s:
                    ask_s = now_s + max(ASK_AGAIN_S, self._proof.slowest_s)
                    request = self._ask(now_s)
                self._news.clear()
                await comes(self._news, _PULSE_S)
                if not self._proof.awake(loop.time()):
                    ask_s = -math.inf
        finally:
            if request is not None:
                request.cancel()  # or unanswered ones would queue up before the next

    def proven(self) -> bool:
        """Tell whether it is surely disarmed, by all that has been received; asked again before the bytes leave."""
        return self._state() is ArmState.DISARMED and self._proof.holds(asyncio.get_running_loop().time())

    def answered(self, number: int) -> None:
        self._proof.answered(number, asyncio.get_running_loop().time())
        self._news.set()

    def heard(self, *, armed: bool) -> None:
        self._proof.heard(armed=armed)
        self._news.set()

    def _ask(self, now_s: float) -> asyncio.Future[int | None]:
        number = int.from_bytes(os.urandom(7), "big") + 1
        self._proof.asked(number, now_s)
        self._link.send(mavlink.MAVLink_timesync_message(0, number))
        return self._commands.request_message(mavlink.MAVLINK_MSG_ID_HEARTBEAT)
