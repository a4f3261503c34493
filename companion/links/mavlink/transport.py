"""Transports of a MAVLink link over UDP, TCP or a serial line; each reconnects by itself.

The MAVLink link has a transport only while a peer, or at least an address to send to, is known.
"""

from __future__ import annotations

import asyncio
import errno
import re
import socket
from typing import Any

from companion.errors import LinkError
from companion.links.mavlink.link import MavlinkLink, Sender
from companion.links.serial.bytestream import ByteLink, PortSettings
from companion.links.system.connection import OnState, Reconnection
from companion.messages import message

PEER_SILENCE_S = 10.0
MAX_PEERS = 8
"""Maximum number of peers that get our messages; later peers can only send. The autopilot may replace a peer."""
MOST_WAITING = 1024
"""Maximum number of datagrams in one reading, before any write; the kernel buffers some 300."""
MOST_DATAGRAM_BYTES = 65536
"""Largest UDP datagram, and size of our read buffer. asyncio allocates four times as much for every datagram. To get
that memory from the kernel page by page, and return it, costs more than the rest of a read."""
RESOLVE_DEADLINE_S = 5.0
_TURN_S = 1.0
_URL = re.compile(r"(?P<kind>udpin|udpout|tcp|serial):(?P<where>.+):(?P<number>\d+)")
# The target's host is up, but no program listens yet (or it restarts): keep sending.
_PASSING_ERRORS = frozenset({errno.ECONNREFUSED, errno.ENOBUFS})

Peer = tuple[Any, ...]


async def run_transport(link: MavlinkLink, url: str, *, on_state: OnState | None = None) -> None:
    """Keep `link` connected through `url` until cancelled; raise LinkError for an invalid url."""
    kind, where, number = parse_url(url)

    def note(connected: bool, words: str) -> None:  # noqa: FBT001 - signature of `OnState`
        link.fault = None if connected else words
        if on_state is not None:
            on_state(connected, words)

    if kind in ("udpin", "udpout"):
        await _run_udp(link, url, (where, number), listen=kind == "udpin", on_state=note)
        return
    settings = PortSettings(f"tcp://{where}:{number}", 0) if kind == "tcp" else PortSettings(where, number)

    def state(connected: bool, words: str) -> None:  # noqa: FBT001 - signature of `OnState`
        link.attach(stream.write if connected else None, stream.settled)
        note(connected, words)

    stream = ByteLink(settings, link.receive, name="mavlink", on_state=state, on_turn=link.turn)
    await stream.run()


def parse_url(url: str) -> tuple[str, str, int]:
    """Return kind, host or path, and port or baud rate of a MAVLink url; raise LinkError for any other text."""
    match = _URL.fullmatch(url)
    if match is None or (match["kind"] != "serial" and int(match["number"]) > 65535):
        raise LinkError(
            f"MAVLink url {url!r}: allowed are udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT and serial:PATH:BAUD"
        )
    return match["kind"], match["where"], int(match["number"])


async def _run_udp(
    link: MavlinkLink, url: str, address: tuple[str, int], *, listen: bool, on_state: OnState | None
) -> None:
    reconnection = Reconnection("mavlink", worth_s=_TURN_S, on_state=on_state)

    async def once() -> str:
        link.turn()
        kind, end = (_Listener, {"local_addr": address}) if listen else (_Speaker, {"remote_addr": address})
        try:
            async with asyncio.timeout(RESOLVE_DEADLINE_S):
                transport, udp = await asyncio.get_running_loop().create_datagram_endpoint(lambda: kind(link), **end)  # type: ignore[arg-type]
        except TimeoutError:
            return message("no_connection", url=url, reason=f"host name unknown after {RESOLVE_DEADLINE_S:g} s")
        except (OSError, UnicodeError) as error:
            return message("no_connection", url=url, reason=getattr(error, "strerror", None) or error)
        host, port = transport.get_extra_info("sockname")[:2]
        reconnection.up(f"{url} is open at {host}:{port}")
        try:
            return message("no_connection", url=url, reason=await udp.run())
        finally:
            transport.abort()
            link.attach(None)
            await udp.closed

    await reconnection.keep(once)


class _Udp(asyncio.DatagramProtocol):
    def __init__(self, link: MavlinkLink) -> None:
        self.link = link
        loop = asyncio.get_running_loop()
        self.now_s = loop.time
        self.closed: asyncio.Future[None] = loop.create_future()
        self._failed: asyncio.Future[str] = loop.create_future()
        self._socket: socket.socket | None = None
        """Duplicate of the transport's socket, for our own reads and writes. asyncio reads only one datagram per loop
        turn, and queues a datagram for which the kernel has no room."""

    async def run(self) -> str:
        while not self._failed.done():
            self.link.turn()
            await asyncio.wait([self._failed], timeout=_TURN_S)
            self._turn()
        return self._failed.result()

    def _turn(self) -> None:
        pass

    def connection_made(self, transport: asyncio.DatagramTransport) -> None:  # type: ignore[override]
        self._socket = transport.get_extra_info("socket").dup()
        if hasattr(transport, "max_size"):
            transport.max_size = MOST_DATAGRAM_BYTES

    def connection_lost(self, exc: Exception | None) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket = None
        self.closed.set_result(None)
        self._fail(exc)

    def error_received(self, exc: Exception) -> None:
        # Any other error (network down, address gone) may last for ever on a socket bound to that address.
        if not (isinstance(exc, OSError) and exc.errno in _PASSING_ERRORS):
            self._fail(exc)

    def settled(self) -> bool:
        """Receive all datagrams that wait in the kernel. Return False if more keep coming or the socket is gone."""
        for _ in range(MOST_WAITING):
            if self._socket is None:
                return False
            try:
                data, peer = self._socket.recvfrom(MOST_DATAGRAM_BYTES)
            except (BlockingIOError, InterruptedError):
                return True
            except OSError as error:
                self.error_received(error)
            else:
                self.datagram_received(data, peer)
        return False

    def send_to(self, data: bytes, peer: Peer | None) -> bool:
        if self._socket is None:
            return False
        try:
            self._socket.send(data) if peer is None else self._socket.sendto(data, peer)
        except (BlockingIOError, InterruptedError):
            return False
        except OSError as error:
            self.error_received(error)
            return False
        return True

    def _fail(self, error: Exception | None) -> None:
        if not self._failed.done():
            self._failed.set_result(str(getattr(error, "strerror", None) or error or "closed"))


class _Speaker(_Udp):
    def connection_made(self, transport: asyncio.DatagramTransport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.link.attach(lambda data: self.send_to(data, None), self.settled)

    def datagram_received(self, data: bytes, addr: tuple[Any, ...]) -> None:
        self.link.receive_datagram(data, self.now_s(), lambda sender: None)


class _Listener(_Udp):
    """Transport for udpin: sends to every registered peer; without one the link counts as not connected.

    A peer is registered once it has sent a message that may have an effect; bytes without a message do not count.
    """

    def __init__(self, link: MavlinkLink) -> None:
        super().__init__(link)
        self._heard_s: dict[Peer, float] = {}
        self._autopilots: set[Peer] = set()

    def datagram_received(self, data: bytes, addr: Peer) -> None:
        t_s = self.now_s()
        self.link.receive_datagram(data, t_s, lambda sender: self._hear(addr, sender, t_s))

    def _hear(self, peer: Peer, sender: Sender, t_s: float) -> None:
        autopilot = sender == self.link.autopilot
        if peer not in self._heard_s and len(self._heard_s) >= MAX_PEERS and not (autopilot and self._make_room()):
            return
        if autopilot:
            self._autopilots.add(peer)
        self._heard_s[peer] = t_s
        if not self.link.connected:
            self.link.attach(lambda data: sum(self.send_to(data, peer) for peer in self._heard_s) > 0, self.settled)

    def _make_room(self) -> bool:
        others = self._heard_s.keys() - self._autopilots
        if not others:
            return False
        del self._heard_s[min(others, key=self._heard_s.__getitem__)]
        return True

    def error_received(self, exc: Exception) -> None:
        # An unreachable peer does not concern the others; it is removed once silent.
        return

    def _turn(self) -> None:
        now_s = self.now_s()
        self._heard_s = {peer: heard_s for peer, heard_s in self._heard_s.items() if now_s - heard_s <= PEER_SILENCE_S}
        self._autopilots &= self._heard_s.keys()
        if not self._heard_s:
            self.link.attach(None)
