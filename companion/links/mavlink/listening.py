"""Listening on a UDP port for MAVLink, without a word: which autopilot sends there, itself or by a router."""

from __future__ import annotations

import asyncio
import ipaddress
from dataclasses import dataclass
from typing import Any, Final

from companion.errors import LinkError
from companion.links.system.waiting import comes
from companion.protocols.heartbeat import Heartbeat, heartbeats

USUAL_PORTS: Final = (14540, 14550, 14551)
"""PX4's for companions, the ground stations', and the second one that routers are usually given."""
LISTEN_S: Final = 3.0
LISTEN_TURNS: Final = 30
"""Turns of the loop in that time, each of which reads what has arrived: a process that gets little of the processor
listens longer."""


@dataclass(frozen=True, slots=True)
class HeardUdp:
    """Messages heard on a UDP port."""

    port: int
    senders: tuple[Heartbeat, ...]
    datagrams: int
    from_here: bool

    @property
    def autopilot(self) -> Heartbeat | None:
        """The first one that speaks there."""
        return next((one for one in self.senders if one.is_autopilot), None)


async def listen_udp(port: int) -> HeardUdp:
    """Receive until an autopilot is heard or time is over; raise LinkError where the port cannot be opened."""
    heard = _Heard()
    try:
        transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
            lambda: heard,
            local_addr=("0.0.0.0", port),  # noqa: S104
        )
    except OSError as error:
        raise LinkError(f"UDP {port}: {error.strerror or error}") from None
    try:
        for _ in range(LISTEN_TURNS):
            if await comes(heard.enough, LISTEN_S / LISTEN_TURNS):
                break
    finally:
        transport.close()
    return HeardUdp(
        port, tuple(sorted(heard.senders, key=lambda one: not one.is_autopilot)), heard.datagrams, heard.from_here
    )


class _Heard(asyncio.DatagramProtocol):
    def __init__(self) -> None:
        self.enough = asyncio.Event()
        self.senders: dict[Heartbeat, None] = {}
        self.datagrams = 0
        self.from_here = True

    def datagram_received(self, data: bytes, addr: tuple[Any, ...]) -> None:
        self.datagrams += 1
        self.from_here &= ipaddress.ip_address(addr[0]).is_loopback
        self.senders |= dict.fromkeys(heartbeats(data))
        if any(one.is_autopilot for one in self.senders):
            self.enough.set()
