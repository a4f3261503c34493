"""Detects autopilots on serial and UDP ports, and devices on serial ports, by listening without sending."""

from __future__ import annotations

import asyncio
import ipaddress
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from companion.errors import LinkError
from companion.links.mavlink.transport import parse_url
from companion.links.serial.listening import Heard, listen_to_all
from companion.links.serial.ports import ROOT, find_udp_holders, how_to_free, in_use, resolve
from companion.links.system.events import comes
from companion.protocols.guess import Heartbeat, Line, heartbeats
from companion.protocols.registry import Kind, main_kind

AUTOPILOT_LINES: Final = tuple(Line(baud, "none") for baud in (57600, 921600, 115200))
"""Baud rates to try first on a serial port: ArduPilot's default, PX4's for TELEM 2, and one that owners often set."""
Believed = Mapping[str, Line]
"""Line settings of the configured ports, tried first: a USB device without a UART can be read at any baud rate."""
USUAL_PORTS: Final = (14540, 14550, 14551)
"""Usual UDP ports: PX4's for companion computers, that of ground stations, and the second one of MAVLink routers."""
LISTEN_S: Final = 3.0
LISTEN_TURNS: Final = 30
"""Number of turns of the event loop into which `LISTEN_S` is divided. Each turn reads the messages that have arrived,
so a process that gets little processor time listens longer."""


class HeardUdp(asyncio.DatagramProtocol):
    """Heartbeats received on a UDP port, by sender."""

    def __init__(self, senders: Iterable[Heartbeat] = (), *, from_here: bool = True) -> None:
        self.senders = dict.fromkeys(senders)
        self.from_here = from_here
        self.datagrams = 0
        self.enough = asyncio.Event()

    @property
    def autopilot(self) -> Heartbeat | None:
        return next((one for one in self.senders if one.is_autopilot), None)

    def datagram_received(self, data: bytes, addr: tuple[Any, ...]) -> None:
        self.datagrams += 1
        self.from_here &= ipaddress.ip_address(addr[0]).is_loopback
        self.senders |= dict.fromkeys(heartbeats(data))
        if self.autopilot is not None:
            self.enough.set()


async def listen_udp(port: int) -> HeardUdp:
    """Listen on a UDP port until an autopilot is detected, for at most 3 s; raise LinkError if it cannot be opened."""
    try:
        transport, heard = await asyncio.get_running_loop().create_datagram_endpoint(
            HeardUdp,
            local_addr=("0.0.0.0", port),  # noqa: S104
        )
    except OSError as error:
        if holders := find_udp_holders(port):
            raise LinkError(f"{in_use(f'UDP {port}', holders)}: {how_to_free(holders[0])}") from None
        raise LinkError(f"UDP {port}: {error.strerror or error}") from None
    try:
        for _ in range(LISTEN_TURNS):
            if await comes(heard.enough, LISTEN_S / LISTEN_TURNS):
                break
    finally:
        transport.close()
    return heard


@dataclass(frozen=True, slots=True)
class Survey:
    """Result of the set-up's scan: for each port, the devices detected there, or the reason why it was not scanned."""

    serial: dict[str, Heard | str]
    udp: dict[int, HeardUdp | str]

    @property
    def autopilots(self) -> list[str]:
        wired = [
            f"serial:{port}:{heard.line.baud}"
            for port, heard in self.serial.items()
            if not isinstance(heard, str) and heard.heartbeat is not None and heard.line is not None
        ]
        return wired + [
            f"udpin:{'127.0.0.1' if heard.from_here else '0.0.0.0'}:{port}"  # noqa: S104
            for port, heard in self.udp.items()
            if not isinstance(heard, str) and heard.autopilot is not None
        ]

    def devices(self, kind: Kind) -> list[tuple[str, str, Line]]:
        """List the detected devices whose main use is `kind`, each with port, protocol and line settings."""
        return [
            (port, heard.candidate.protocol, heard.line)
            for port, heard in self.serial.items()
            if not isinstance(heard, str) and heard.candidate is not None and heard.line is not None
            if main_kind(heard.candidate.protocol) == kind
        ]

    def checked(self, port: str) -> bool:
        """Return True if a serial port was scanned or is absent, False if it could not be opened."""
        if port.startswith("/") and not os.path.exists(port):
            return True
        heard = [found for name, found in self.serial.items() if same_port(name, port)]
        return any(not isinstance(found, str) for found in heard)

    def checked_url(self, url: str) -> bool:
        kind, where, number = parse_url(url)
        if kind == "serial":
            return self.checked(where)
        return kind == "udpin" and isinstance(self.udp.get(number), HeardUdp)


def same_port(one: str, other: str) -> bool:
    return resolve(ROOT, one) == resolve(ROOT, other)


def same_url(one: str, other: str) -> bool:
    """Return True if two MAVLink urls mean the same endpoint; for udpin only the port number counts."""
    (kind, where, number), theirs = parse_url(one), parse_url(other)
    if kind == "udpin":
        return theirs[::2] == (kind, number)
    return theirs[::2] == (kind, number) and (same_port(where, theirs[1]) if kind == "serial" else where == theirs[1])


Tell = Callable[[str, str], None]


async def survey(ports: Sequence[str], udp: Sequence[int], tell: Tell, believed: Believed) -> Survey:
    async def one(port: int) -> HeardUdp | str:
        found: HeardUdp | str
        try:
            found = await listen_udp(port)
        except LinkError as error:
            found = str(error)
        tell(f"UDP {port}", in_words(f"UDP {port}", found))
        return found

    def first(port: str) -> list[Line]:
        return [*(line for name, line in believed.items() if same_port(name, port)), *AUTOPILOT_LINES]

    serial, datagrams = await asyncio.gather(
        listen_to_all(ports, first, lambda port, found: tell(port, in_words(port, found))),
        asyncio.gather(*(one(port) for port in udp)),
    )
    return Survey(serial, dict(zip(udp, datagrams, strict=True)))


def in_words(place: str, found: Heard | HeardUdp | str) -> str:
    if isinstance(found, str):
        return f"left alone: {found.removeprefix(f'{place}: ')}"
    if isinstance(found, HeardUdp):
        if found.senders:
            return "; ".join(map(str, sorted(found.senders, key=lambda one: not one.is_autopilot)))
        return "silent" if not found.datagrams else "something that is no MAVLink"
    if found.heartbeat is not None:
        return f"{found.heartbeat} ({found.line})"
    if found.candidate is not None:
        return f"{found.candidate.protocol}, a device for {main_kind(found.candidate.protocol)} ({found.line})"
    if found.stranger is not None:
        return found.stranger
    return (
        "silent (power? wires? some devices only answer)" if not found.bytes_heard else "nothing known; levels? wires?"
    )
