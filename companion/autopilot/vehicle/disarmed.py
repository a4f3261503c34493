"""Proof that the autopilot is disarmed, by a question and its answer; the only module that decides this.

A heartbeat may be old: it may have waited in a radio, in the kernel, or here while our process was stopped. So the
question is a TIMESYNC with a random number. Both firmwares return the number at once, armed or not
(docs/reference/autopilots 2, 4.5). A heartbeat that arrives after the answer was sent after the question. No clock is
compared with another one, and no wall clock is read.

On an unsigned link anybody who receives the question can answer it. There the proof needs two things. Some sender with
the autopilot's ids reported "disarmed" after the question. None reported "armed" within 3 s, nor within the time of the
slowest recent answer. On a signed link the autopilot itself has reported "disarmed".
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

PROOF_HOLDS_S: Final = 1.5  # time from the question to the write; some heartbeats come only once a second

LONGEST_PAUSE_S: Final = 0.1
"""Longest pause of our event loop; a longer one voids earlier questions, because messages may have waited."""

ASK_AGAIN_S: Final = 0.3
GIVE_UP_S: Final = 8.0  # with a fifth of packets lost both ways, 26 questions stay unanswered once in 10^11

_LONGEST_WAIT_S: Final = 0.75  # longest wait for slow answers, so that a proof holds for a while afterwards
_PULSE_S: Final = 0.02  # interval of checks for pauses of our own loop during a wait
_REMEMBERED: Final = 8  # number of questions, and of answer times, that are remembered


class DisarmedProof:
    """Decides from the autopilot's answers whether it is disarmed. Pure logic: numbers and times are arguments."""

    def __init__(self) -> None:
        self._asked_s: dict[int, float] = {}
        self._answers_s: deque[float] = deque(maxlen=_REMEMBERED)
        """Times from question to answer, s, also of a second answer to the same question."""
        self._begun_s = self._awake_s = math.inf
        self._answered_s = self._proven_s = -math.inf
        """Times of two questions: the latest answered, and the latest with an answer and then a disarmed heartbeat."""

    @property
    def slowest_s(self) -> float:
        """Longest recent time to an answer. A forger may answer before the autopilot, so the slower answer counts."""
        return min(max(self._answers_s, default=0.0), _LONGEST_WAIT_S)

    def begin(self, now_s: float) -> None:
        """Start a new proof: earlier questions do not count."""
        self._begun_s = self._awake_s = now_s
        self._answered_s = self._proven_s = -math.inf

    def awake(self, now_s: float) -> bool:
        """Note that our event loop runs; False after a long pause: earlier questions no longer count."""
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
        """Check that a disarmed heartbeat followed a recent question, and no armed one within the time answers need."""
        return self.awake(now_s) and self.slowest_s <= now_s - self._proven_s <= PROOF_HOLDS_S


class DisarmedCheck:
    """Asks one autopilot for its arm state before each action that requires it to be disarmed.

    `state` returns the arm state from heartbeats, `name` the autopilot's name for messages.
    """

    def __init__(
        self, link: MavlinkLink, commands: Commands, state: Callable[[], ArmState], name: Callable[[], str]
    ) -> None:
        self._link, self._commands, self._state, self._name = link, commands, state, name
        self._proof = DisarmedProof()
        self._news = asyncio.Event()

    async def ensure(self) -> None:
        """Return at the moment when the autopilot is surely disarmed; the caller must act before the next await.

        Raises:
            NotDisarmedError: it is armed, two senders use its ids, or nothing proves that it is disarmed.
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
                request.cancel()  # otherwise unanswered requests would queue up before the next one

    def proven(self) -> bool:
        """Check that all received messages prove the autopilot disarmed; the link calls this just before it sends."""
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
