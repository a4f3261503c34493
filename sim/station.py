"""A bare MAVLink station that remembers everything, and UDP for it and the doubles.

A double on UDP looks as a real autopilot's telemetry port or SITL's `--serial0 udpclient:` does to a companion.
"""

from __future__ import annotations

import asyncio
from bisect import bisect_left
from collections.abc import Callable
from typing import Protocol, TypeVar, cast

from pymavlink.dialects.v20 import ardupilotmega as mavlink

MAX_QUEUED_BYTES = 65536
"""Maximum number of bytes in the send buffer; further packets are dropped."""


class End(Protocol):
    """One end of a UDP link, such as a double or its port `ground`."""

    def attach(self, transmit: Callable[[bytes], None] | None) -> None:
        """Set the function that sends."""

    def receive(self, data: bytes, t_s: float) -> None:
        """Handle received bytes."""


class UdpEnd(asyncio.DatagramProtocol):
    """Joins an `End` to a socket: sends to a fixed target, or to whoever spoke last."""

    def __init__(self, end: End, target: tuple[str, int] | None) -> None:
        self._end, self._target, self._peer = end, target, target
        self._transport: asyncio.DatagramTransport | None = None
        self.local: tuple[str, int] = ("", 0)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.DatagramTransport", transport)
        self.local = transport.get_extra_info("sockname")[:2]
        self._end.attach(self._send)

    def connection_lost(self, exc: Exception | None) -> None:
        self._end.attach(None)
        self._transport = None

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        if self._target is None:
            self._peer = addr
        self._end.receive(data, asyncio.get_running_loop().time())

    def error_received(self, exc: Exception) -> None:
        """Ignore the error and go on sending: nobody listens yet."""

    def close(self) -> None:
        if self._transport is not None:
            self._transport.close()

    def _send(self, data: bytes) -> None:
        if self._transport is None or self._peer is None:
            return
        writing = cast("asyncio.WriteTransport", self._transport)  # typeshed forgot the method on datagrams
        if writing.get_write_buffer_size() > MAX_QUEUED_BYTES:
            return
        self._transport.sendto(data, self._peer)


async def open_udp(end: End, *, target: tuple[str, int] | None = None, listen: tuple[str, int] | None = None) -> UdpEnd:
    """Open UDP for an end: send to `target` from any free port, or listen and answer the last sender."""
    if (target is None) == (listen is None):
        raise ValueError("give either a target to send to or an address to listen on")
    loop = asyncio.get_running_loop()
    local = listen if listen is not None else ("127.0.0.1" if target and target[0] == "127.0.0.1" else "0.0.0.0", 0)  # noqa: S104
    _, protocol = await loop.create_datagram_endpoint(lambda: UdpEnd(end, target), local_addr=local)
    return protocol


M = TypeVar("M", bound=mavlink.MAVLink_message)


class Station:
    """An `End` that sends given messages and keeps every received one with its time, without retries."""

    def __init__(self, system_id: int = 255, component_id: int = 190, vehicle: int = 1) -> None:
        self.vehicle = vehicle  # System id of the autopilot
        self.heard: list[tuple[float, mavlink.MAVLink_message]] = []
        self._codec = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=component_id)
        self._codec.robust_parsing = True
        self._transmit: Callable[[bytes], None] | None = None

    def attach(self, transmit: Callable[[bytes], None] | None) -> None:
        self._transmit = transmit

    def receive(self, data: bytes, t_s: float) -> None:
        for message in self._codec.parse_buffer(data) or ():
            self.heard.append((t_s, message))

    def send(self, message: mavlink.MAVLink_message) -> None:
        data = message.pack(self._codec)
        self._codec.seq = (self._codec.seq + 1) % 256
        if self._transmit is not None:
            self._transmit(data)

    def timed(self, kind: type[M], *, since_s: float = 0.0) -> list[tuple[float, M]]:
        """Return the messages of a kind with their times, oldest first."""
        first = bisect_left(self.heard, since_s, key=lambda entry: entry[0])
        return [(t_s, message) for t_s, message in self.heard[first:] if isinstance(message, kind)]

    def all(self, kind: type[M], *, since_s: float = 0.0) -> list[M]:
        return [message for _, message in self.timed(kind, since_s=since_s)]

    def texts(self) -> list[str]:
        """Return the received STATUSTEXT, chunk by chunk."""
        return [message.text for message in self.all(mavlink.MAVLink_statustext_message)]

    def heartbeat(self, kind: int = mavlink.MAV_TYPE_ONBOARD_CONTROLLER) -> None:
        """Send one heartbeat as an onboard controller or (MAV_TYPE_GCS) a ground station."""
        self.send(
            mavlink.MAVLink_heartbeat_message(kind, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3)
        )

    async def command(
        self, number: int, *params: float, target: tuple[int, int] | None = None, wait_s: float = 2.0
    ) -> int:
        """Send COMMAND_LONG, without a target to the autopilot; return the first result, -1: none came in time."""
        loop = asyncio.get_running_loop()
        begun = len(self.heard)
        seven = [*params, *[0.0] * (7 - len(params))]
        self.send(mavlink.MAVLink_command_long_message(*(target or (self.vehicle, 1)), number, 0, *seven))
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
        """Send PARAM_SET; return the values of that name received within 0.1 s, as they are in the message."""
        begun = len(self.heard)
        self.send(mavlink.MAVLink_param_set_message(*target, name.encode(), value, kind))
        await asyncio.sleep(0.1)
        return self._values(name, begun)

    async def read_parameter(self, name: str, *, target: tuple[int, int] = (1, 1)) -> list[float]:
        """Send PARAM_REQUEST_READ by name; return the values received within 0.1 s."""
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
