"""Commands to the autopilot, one at a time, and the wait for their COMMAND_ACK.

An ACK names the command but not its parameters, so the ACKs of two SET_MESSAGE_INTERVAL could not be distinguished.
Therefore each command has one request in flight, and further ones queue. A missing answer gives the result None, so
that no caller hangs: an autopilot may send its ACKs late or never.
"""

from __future__ import annotations

import asyncio
import dataclasses
import math
from collections import Counter, deque
from collections.abc import Callable
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.parameters.change import FirmwareName
from companion.links.mavlink.link import MavlinkLink, Message

_COPY_S: Final = 0.5
_TWICE_S: Final = 0.1
"""Pause after a refusal. A request that arrives over two routes is answered twice, and the second refusal must not
count for the next request."""
MAX_WAITING: Final = 16  # most queued requests of one command; a further one is dropped with the result None


_Answer = asyncio.Future[int | None]
_Request = tuple[tuple[float, ...], float, _Answer]  # parameters, timeout, answer


def _settle(answer: _Answer, result: int | None) -> None:
    if not answer.done():
        answer.set_result(result)


class Commands:
    """Sends COMMAND_LONG to one autopilot; `target` returns its system and component id, None while unknown."""

    def __init__(self, link: MavlinkLink, target: Callable[[], tuple[int, int] | None]) -> None:
        self.results: Counter[str] = Counter()  # counts by name of the result, "no answer" or "dropped" (never sent)
        self._link = link
        self._target = target
        self._queues: dict[int, deque[_Request]] = {}
        self._in_flight: dict[int, _Request] = {}
        self._timers: dict[int, asyncio.TimerHandle] = {}
        """Timers by command: timeout of the request in flight, or end of the pause after a refusal."""
        self._last_ack = (0, 0, 0, -math.inf)
        link.subscribe(mavlink.MAVLink_command_ack_message, self._on_ack)

    def send(self, command: int, *parameters: float, timeout_s: float = 0.5) -> _Answer:
        """Queue a request; the future gets the MAV_RESULT, or None after the timeout.

        The timeout runs from the sending; IN_PROGRESS restarts it. The future never gets an exception and may be
        ignored.
        """
        answer: _Answer = asyncio.get_running_loop().create_future()
        queue = self._queues.setdefault(command, deque())
        if len(queue) >= MAX_WAITING:
            self.results["dropped"] += 1
            answer.set_result(None)
        else:
            queue.append((parameters, timeout_s, answer))
            self._next(command)
        return answer

    def request_message_interval(self, message_id: int, rate_hz: float) -> _Answer:
        return self.send(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, round(1e6 / rate_hz))

    def request_message(self, message_id: int) -> _Answer:
        return self.send(mavlink.MAV_CMD_REQUEST_MESSAGE, message_id)

    def close(self) -> None:
        for timer in self._timers.values():
            timer.cancel()
        self._timers.clear()
        for _, _, answer in [*self._in_flight.values(), *(each for queue in self._queues.values() for each in queue)]:
            _settle(answer, None)
        self._in_flight.clear()
        self._queues.clear()

    def _next(self, command: int) -> None:
        queue = self._queues.get(command)
        target = self._target()
        while queue and command not in self._timers:
            request = queue.popleft()
            parameters, _, answer = request
            if answer.done():  # the caller has cancelled it
                continue
            if target is None:
                answer.set_result(None)
                continue
            padded = (*parameters, *(0.0,) * (7 - len(parameters)))
            self._link.send(mavlink.MAVLink_command_long_message(*target, command, 0, *padded))
            self._in_flight[command] = request
            self._arm_timer(command)

    def _arm_timer(self, command: int) -> None:
        if command in self._timers:
            self._timers[command].cancel()
        loop, (_, timeout_s, _) = asyncio.get_running_loop(), self._in_flight[command]
        self._timers[command] = loop.call_later(timeout_s, self._finish, command, None)

    def _finish(self, command: int, result: int | None) -> None:
        self._timers.pop(command).cancel()
        _, _, answer = self._in_flight.pop(command)
        self.results["no answer" if result is None else result_name(result)] += 1
        _settle(answer, result)
        if result in (None, mavlink.MAV_RESULT_ACCEPTED):
            self._next(command)
        else:
            self._timers[command] = asyncio.get_running_loop().call_later(_TWICE_S, self._go_on, command)

    def _go_on(self, command: int) -> None:
        del self._timers[command]
        self._next(command)

    def _on_ack(self, message: mavlink.MAVLink_command_ack_message, t_s: float) -> None:
        sender = (message.get_srcSystem(), message.get_srcComponent())
        if message.command not in self._in_flight or sender != self._target():
            return
        if not self._link.is_for_us(message):
            return
        # A packet may arrive over two routes; its copy must not count for the next request of the same command.
        copy = (message.command, message.get_seq(), message.result)
        if copy == self._last_ack[:3] and t_s - self._last_ack[3] < _COPY_S:
            return
        self._last_ack = (*copy, t_s)
        if message.result == mavlink.MAV_RESULT_IN_PROGRESS:
            self._arm_timer(message.command)
        else:
            self._finish(message.command, message.result)


def result_name(result: int) -> str:
    known = mavlink.enums["MAV_RESULT"].get(result)
    return known.name if known is not None else str(result)


FIRST_PAUSE_S: Final = 3.0
LONGEST_PAUSE_S: Final = 30.0


@dataclasses.dataclass(slots=True)
class _Wanted:
    message: type[Message]
    rate_hz: float | None  # None: requested once, and again after a restart
    of: FirmwareName | None
    heard_s: float = -math.inf
    asked_s: float = -math.inf
    pause_s: float = FIRST_PAUSE_S


class StandingRequests:
    """Requests messages at an interval; repeats a request less and less often while its message does not arrive."""

    def __init__(self, commands: Commands) -> None:
        self._commands = commands
        self._wanted: list[_Wanted] = []

    def add(self, message: type[Message], rate_hz: float | None, of: FirmwareName | None = None) -> None:
        """Request a message of firmware `of` (None: any) from now on; without `rate_hz` once, and once per restart."""
        self._wanted.append(_Wanted(message, rate_hz, of))

    def heard(self, message: Message, t_s: float) -> None:
        for wanted in self._wanted:
            if wanted.message.msgname == message.get_type():
                wanted.heard_s, wanted.pause_s = t_s, FIRST_PAUSE_S

    def forget_asking(self) -> None:
        """Make all requests due again, because an autopilot that restarted while it was lost has ended its streams."""
        for wanted in self._wanted:
            wanted.asked_s, wanted.pause_s = -math.inf, FIRST_PAUSE_S
            if wanted.rate_hz is None:
                wanted.heard_s = -math.inf

    def ask_for_missing(self, now_s: float, firmware: FirmwareName | None) -> None:
        for wanted in self._wanted:
            if wanted.of not in (None, firmware):
                continue
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
