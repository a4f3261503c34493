"""The double on UDP, as a real autopilot's telemetry port or SITL's `--serial0 udpclient:` appears to a companion."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Protocol, cast

MAX_QUEUED_BYTES = 65536
"""More than this in the send buffer and packets are dropped, newest first."""


class End(Protocol):
    """What can be put on UDP: the double, its `ground`."""

    def attach(self, transmit: Callable[[bytes], None] | None) -> None:
        """Take the function that sends."""

    def receive(self, data: bytes, t_s: float) -> None:
        """Take what came."""


class UdpEnd(asyncio.DatagramProtocol):
    """Joins an `End` to a socket: sends to a fixed target, or to whoever spoke last."""

    def __init__(self, end: End, target: tuple[str, int] | None) -> None:
        self._end, self._target, self._peer = end, target, target
        self._transport: asyncio.DatagramTransport | None = None
        self.dropped = 0
        self.local: tuple[str, int] = ("", 0)
        """The address the socket has."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Plug the end in."""
        self._transport = cast("asyncio.DatagramTransport", transport)
        self.local = transport.get_extra_info("sockname")[:2]
        self._end.attach(self._send)

    def connection_lost(self, exc: Exception | None) -> None:
        """Pull the end out."""
        self._end.attach(None)
        self._transport = None

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        """Give bytes to the end."""
        if self._target is None:
            self._peer = addr
        self._end.receive(data, asyncio.get_running_loop().time())

    def error_received(self, exc: Exception) -> None:
        """Nobody listens yet: go on sending."""

    def close(self) -> None:
        """Close the socket."""
        if self._transport is not None:
            self._transport.close()

    def _send(self, data: bytes) -> None:
        if self._transport is None or self._peer is None:
            return
        writing = cast("asyncio.WriteTransport", self._transport)  # typeshed forgot the method on datagrams
        if writing.get_write_buffer_size() > MAX_QUEUED_BYTES:
            self.dropped += 1
            return
        self._transport.sendto(data, self._peer)


async def open_udp(end: End, *, target: tuple[str, int] | None = None, listen: tuple[str, int] | None = None) -> UdpEnd:
    """Put an end on UDP: send to `target` from any free port, or listen and answer whoever spoke last."""
    if (target is None) == (listen is None):
        raise ValueError("give either a target to send to or an address to listen on")
    loop = asyncio.get_running_loop()
    local = listen if listen is not None else ("127.0.0.1" if target and target[0] == "127.0.0.1" else "0.0.0.0", 0)  # noqa: S104
    _, protocol = await loop.create_datagram_endpoint(lambda: UdpEnd(end, target), local_addr=local)
    return protocol
