"""The link from the ground: a ground station's heartbeat, commands, and the parameters of one component.

It is the same link as the aircraft's, from the other side; signed where there is a key.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.parameters.wire import REAL32, same_float32
from companion.errors import LinkError
from companion.ground.heard import Ack, Heard, Target, sender_of
from companion.links.mavlink.link import MavlinkLink, Message
from companion.links.mavlink.signing import Signing
from companion.links.mavlink.transport import run_transport
from companion.links.system.listeners import Listeners
from companion.links.system.waiting import comes

OWN: Final = Target(245, mavlink.MAV_COMP_ID_MISSIONPLANNER)
"""Not 255: an ArduPilot would take us for the ground station whose loss is a failsafe."""
HEARTBEAT_S: Final = 1.0
ANSWER_S: Final = 1.0
"""How long a parameter is waited for; the companion answers at once, the rest is for the radio."""
TRIES: Final = 3
LIST_TRIES: Final = 10
"""Of a component that has begun to answer; each asks for the whole list: what one has lost the next one brings."""


class GroundLink:
    """A ground station on an open link; made by `open_link`."""

    def __init__(self, link: MavlinkLink, heard: Heard) -> None:
        self.heard = heard
        self._link = link
        self.on_ack: Listeners[[Ack]] = Listeners()
        """Told of every COMMAND_ACK to us."""
        link.subscribe(mavlink.MAVLink_heartbeat_message, heard.hear_heartbeat)
        link.subscribe(mavlink.MAVLink_statustext_message, heard.hear_text)
        link.subscribe(mavlink.MAVLink_command_ack_message, self._take_ack)

    def unbelieved(self) -> str:
        """What was dropped because of its signature, for people; empty when nothing was."""
        doubted = {} if self._link.signing is None else self._link.signing.doubted
        if not doubted:
            return ""
        counts = ", ".join(f"{count} {reason}" for reason, count in doubted.items())
        return f"messages dropped because of their signature: {counts}"

    def send_command(self, target: Target, command: int, parameters: tuple[float, ...], confirmation: int) -> None:
        """Send COMMAND_LONG; a packet that cannot be sent is a lost packet."""
        self._link.send(mavlink.MAVLink_command_long_message(*target, command, confirmation, *parameters))

    async def parameters(self, target: Target) -> dict[str, float]:
        """All parameters of a component, as far as they come; empty when it does not answer."""
        found: dict[str, float] = {}
        arrived = asyncio.Event()
        count = 1

        def take(message: mavlink.MAVLink_param_value_message, _t_s: float) -> None:
            nonlocal count
            if sender_of(message) == target:
                found[message.param_id], count = message.param_value, message.param_count
                arrived.set()

        stop = self._link.subscribe(mavlink.MAVLink_param_value_message, take)
        try:
            for tries in range(LIST_TRIES):
                if tries == TRIES and not found:
                    break
                self._link.send(mavlink.MAVLink_param_request_list_message(*target))
                while len(found) < count and await comes(arrived, ANSWER_S):
                    arrived.clear()
                if len(found) >= count:
                    break
        finally:
            stop()
        return found

    async def get_parameter(self, target: Target, name: str) -> float | None:
        """One parameter; None when there is no answer, or no such parameter."""
        request = mavlink.MAVLink_param_request_read_message(*target, name.encode("ascii"), -1)
        return await self._ask(request, target, name)

    async def set_parameter(self, target: Target, name: str, value: float) -> str | None:
        """Set one parameter; returns why that did not work, or None."""
        request = mavlink.MAVLink_param_set_message(*target, name.encode("ascii"), value, REAL32)
        now = await self._ask(request, target, name, wanted=value)
        if now is None:
            return "no answer"
        return None if same_float32(now, value) else f"it stays {now:g}"

    async def _ask(self, request: Message, target: Target, name: str, *, wanted: float | None = None) -> float | None:
        """What is answered for a parameter; another value than the one wanted only where that one does not come."""
        found: list[float] = []
        arrived = asyncio.Event()

        def take(message: mavlink.MAVLink_param_value_message, _t_s: float) -> None:
            if sender_of(message) == target and message.param_id == name:
                found.append(message.param_value)
                if wanted is None or same_float32(message.param_value, wanted):
                    arrived.set()

        stop = self._link.subscribe(mavlink.MAVLink_param_value_message, take)
        try:
            for _ in range(TRIES):
                self._link.send(request)
                if await comes(arrived, ANSWER_S) or found:
                    break
        finally:
            stop()
        return found[-1] if found else None

    def _take_ack(self, ack: mavlink.MAVLink_command_ack_message, _t_s: float) -> None:
        if ack.target_system in (0, OWN.system_id) and ack.target_component in (0, OWN.component_id):
            self.on_ack.tell(Ack(sender_of(ack), ack.command, ack.result, ack.progress, ack.result_param2))


@asynccontextmanager
async def open_link(url: str, heard: Heard, key: bytes | None = None) -> AsyncIterator[GroundLink]:
    """Be a ground station on a link; `heard` learns what comes; with a key, only what is signed with it.

    Raises:
        LinkError: the port cannot be opened.
    """
    link = MavlinkLink(system_id=OWN.system_id, component_id=OWN.component_id)
    if key is not None:
        link.signing = Signing(required=True, key=key)
    opened: asyncio.Future[str] = asyncio.get_running_loop().create_future()

    def on_state(connected: bool, words: str) -> None:  # noqa: FBT001 - as a transport tells it
        if not opened.done():
            opened.set_result("" if connected else words.partition(": ")[2])

    carrying = asyncio.create_task(run_transport(link, url, on_state=on_state), name="ground link")
    beating: asyncio.Task[None] | None = None
    try:
        if why := await opened:
            hint = "; another ground station has it: docs/ground_stations.md" if "in use" in why else ""
            raise LinkError(f"{url} cannot be opened: {why}{hint}")
        beating = asyncio.create_task(_beat(link), name="ground heartbeat")
        yield GroundLink(link, heard)
    finally:
        tasks = [task for task in (carrying, beating) if task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)


async def _beat(link: MavlinkLink) -> None:
    """So that an autopilot sends here what is for us."""
    beat = (mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3)
    while True:
        link.send(mavlink.MAVLink_heartbeat_message(*beat))
        await asyncio.sleep(HEARTBEAT_S)
