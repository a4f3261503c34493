"""A bare MAVLink station that remembers everything: for tests of the simulator and for trying things by hand."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TypeVar

from pymavlink.dialects.v20 import ardupilotmega as mavlink

M = TypeVar("M", bound=mavlink.MAVLink_message)


class Station:
    """An `End`: sends what it is told to, keeps every message with its time. It has no opinion and no retries."""

    def __init__(self, system_id: int = 255, component_id: int = 190) -> None:
        self.heard: list[tuple[float, mavlink.MAVLink_message]] = []
        self._codec = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=component_id)
        self._codec.robust_parsing = True
        self._transmit: Callable[[bytes], None] | None = None

    def attach(self, transmit: Callable[[bytes], None] | None) -> None:
        """Plug in, or out."""
        self._transmit = transmit

    def receive(self, data: bytes, t_s: float) -> None:
        """Remember what came."""
        for message in self._codec.parse_buffer(data) or ():
            self.heard.append((t_s, message))

    def send(self, message: mavlink.MAVLink_message) -> None:
        """Send now."""
        data = message.pack(self._codec)
        self._codec.seq = (self._codec.seq + 1) % 256
        if self._transmit is not None:
            self._transmit(data)

    def all(self, kind: type[M], *, since_s: float = 0.0) -> list[M]:
        """Messages of a kind, oldest first."""
        return [message for t_s, message in self.heard if t_s >= since_s and isinstance(message, kind)]

    def timed(self, kind: type[M], *, since_s: float = 0.0) -> list[tuple[float, M]]:
        """The same with times."""
        return [(t_s, message) for t_s, message in self.heard if t_s >= since_s and isinstance(message, kind)]

    def texts(self) -> list[str]:
        """STATUSTEXT, chunk by chunk."""
        return [message.text for message in self.all(mavlink.MAVLink_statustext_message)]

    def heartbeat(self, kind: int = mavlink.MAV_TYPE_ONBOARD_CONTROLLER) -> None:
        """Show that we are here, as an onboard controller or (MAV_TYPE_GCS) a ground station."""
        self.send(
            mavlink.MAVLink_heartbeat_message(kind, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3)
        )

    async def command(self, number: int, *params: float, target: tuple[int, int] = (1, 1), wait_s: float = 2.0) -> int:
        """Send COMMAND_LONG and return the first result; -1 when none comes in time."""
        loop = asyncio.get_running_loop()
        begun = len(self.heard)
        seven = [*params, *[0.0] * (7 - len(params))]
        self.send(mavlink.MAVLink_command_long_message(*target, number, 0, *seven))
        until_s = loop.time() + wait_s
        while loop.time() < until_s:
            for _, message in self.heard[begun:]:
                if isinstance(message, mavlink.MAVLink_command_ack_message) and message.command == number:
                    return int(message.result)
            await asyncio.sleep(0.002)
        return -1

    async def set_parameter(
        self,
        name: str,
        value: float,
        *,
        target: tuple[int, int] = (1, 1),
        kind: int = mavlink.MAV_PARAM_TYPE_REAL32,
    ) -> list[float]:
        """PARAM_SET; returns the values of that name that come back within 0.1 s, as they are in the message."""
        begun = len(self.heard)
        self.send(mavlink.MAVLink_param_set_message(*target, name.encode(), value, kind))
        await asyncio.sleep(0.1)
        return self._values(name, begun)

    async def read_parameter(self, name: str, *, target: tuple[int, int] = (1, 1)) -> list[float]:
        """PARAM_REQUEST_READ by name; returns the values that come back within 0.1 s."""
        begun = len(self.heard)
        self.send(mavlink.MAVLink_param_request_read_message(*target, name.encode(), -1))
        await asyncio.sleep(0.1)
        return self._values(name, begun)

    def _values(self, name: str, begun: int) -> list[float]:
        return [
            message.param_value
            for _, message in self.heard[begun:]
            if isinstance(message, mavlink.MAVLink_param_value_message) and message.param_id == name
        ]
