"""The link from the ground: the companion's own MAVLink stack as a ground station, and a parameter client.

It beats as a ground station does, so that the autopilot learns where it is and forwards to it.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.errors import LinkError
from companion.ground.heard import Ack, Heard, Target, source_of
from companion.links.mavlink.link import MavlinkLink
from companion.links.mavlink.signing import Signing
from companion.links.mavlink.transport import run_transport
from companion.links.system.listeners import Listeners
from companion.links.system.waiting import comes

OWN: Final = Target(245, mavlink.MAV_COMP_ID_MISSIONPLANNER)
"""No ground station whose loss is an autopilot's failsafe: those are 255 where nobody has changed it."""
BEAT_S: Final = 1.0
TRIES: Final = 5
ANSWER_S: Final = 0.6

Values = dict[str, float]


class GroundLink:
    """A ground station on an open link; made by `open_link`."""

    def __init__(self, heard: Heard, key: bytes | None = None) -> None:
        self.heard = heard
        self.link = MavlinkLink(system_id=OWN.system_id, component_id=OWN.component_id)
        self._signing = Signing(required=key is not None, key=key)
        if key is not None:
            self.link.signing = self._signing
        self.on_ack: Listeners[[Ack]] = Listeners()
        """Told of every COMMAND_ACK to us."""
        self.link.subscribe(mavlink.MAVLink_heartbeat_message, heard.heartbeat)
        self.link.subscribe(mavlink.MAVLink_statustext_message, heard.statustext)
        self.link.subscribe(mavlink.MAVLink_command_ack_message, self._on_ack)

    def unbelieved(self) -> str:
        """What was dropped because of its signature, for people; empty when nothing was."""
        if not self._signing.doubted:
            return ""
        counts = ", ".join(f"{count} {reason}" for reason, count in self._signing.doubted.most_common())
        return f"messages dropped because of their signature: {counts}"

    def send_command(self, target: Target, command: int, parameters: tuple[float, ...], confirmation: int) -> None:
        """Send COMMAND_LONG; a packet that cannot be sent is a lost packet."""
        self.link.send(mavlink.MAVLink_command_long_message(*target, command, confirmation, *parameters))

    async def parameters(self, target: Target) -> Values:
        """All parameters of a component; empty when it does not answer."""
        ask = mavlink.MAVLink_param_request_list_message(*target)
        return await self._values(target, ask, lambda found, count: len(found) >= count)

    async def get_parameter(self, target: Target, name: str) -> float | None:
        """One parameter; None when there is no answer, or no such parameter."""
        ask = mavlink.MAVLink_param_request_read_message(*target, name.encode("ascii"), -1)
        return (await self._values(target, ask, lambda found, _: name in found)).get(name)

    async def set_parameter(self, target: Target, name: str, value: float) -> str | None:
        """Set one parameter; returns why that did not work, or None."""
        ask = mavlink.MAVLink_param_set_message(*target, name.encode("ascii"), value, mavlink.MAV_PARAM_TYPE_REAL32)
        kept = (await self._values(target, ask, lambda found, _: name in found)).get(name)
        if kept is None:
            return "no answer"
        return None if abs(kept - value) <= 1e-6 * abs(value) else f"it stays {kept:g}"

    async def _values(
        self, target: Target, ask: mavlink.MAVLink_message, enough: Callable[[Values, int], bool]
    ) -> Values:
        """What the component tells of its parameters until that is `enough`, being asked again in between."""
        found: Values = {}
        told = asyncio.Event()

        def take(message: mavlink.MAVLink_param_value_message, _t_s: float) -> None:
            if source_of(message) == target:
                found[message.param_id] = message.param_value
                if enough(found, message.param_count):
                    told.set()

        unsubscribe = self.link.subscribe(mavlink.MAVLink_param_value_message, take)
        try:
            for _ in range(TRIES):
                self.link.send(ask)
                if await comes(told, ANSWER_S):
                    break
        finally:
            unsubscribe()
        return found

    def _on_ack(self, message: mavlink.MAVLink_command_ack_message, _t_s: float) -> None:
        if message.target_system in (0, OWN.system_id) and message.target_component in (0, OWN.component_id):
            self.on_ack.tell(
                Ack(source_of(message), message.command, message.result, message.progress, message.result_param2)
            )

    async def beat(self) -> None:
        """Be seen, until cancelled."""
        while True:
            self.link.send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
                )
            )
            await asyncio.sleep(BEAT_S)


@asynccontextmanager
async def open_link(url: str, heard: Heard, key: bytes | None = None) -> AsyncIterator[GroundLink]:
    """Be a ground station on a link; `heard` learns what comes; with a key, only what is signed with it.

    Raises:
        LinkError: the port cannot be opened. What is lost later comes back by itself.
    """
    ground = GroundLink(heard, key)
    opened: asyncio.Future[str] = asyncio.get_running_loop().create_future()

    def state(connected: bool, words: str) -> None:  # noqa: FBT001 - the transport's own signature
        if not opened.done():
            opened.set_result("" if connected else words)

    logging.disable(logging.WARNING)  # the error says it
    carrying = asyncio.create_task(run_transport(ground.link, url, on_state=state), name="ground link")
    beating = asyncio.create_task(ground.beat(), name="ground heartbeat")
    try:
        if wrong := await opened:
            busy = os.strerror(errno.EADDRINUSE) in wrong
            hint = "; another ground station has it: docs/ground_stations.md" if busy else ""
            raise LinkError(f"{wrong}{hint}")
        logging.disable(logging.NOTSET)
        yield ground
    finally:
        logging.disable(logging.NOTSET)
        for task in (carrying, beating):
            task.cancel()
        await asyncio.gather(carrying, beating, return_exceptions=True)
