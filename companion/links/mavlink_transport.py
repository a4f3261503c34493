"""Carries a MAVLink link's bytes: UDP, TCP or a serial line, for as long as it takes.

Urls as in the configuration: `udpin:HOST:PORT` (listen, answer whoever speaks), `udpout:HOST:PORT` (speak first),
`tcp:HOST:PORT` (connect) and `serial:PATH:BAUD`. All come back by themselves; the link is attached only while there
is somebody, or at least somewhere, to send to.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import re
from collections.abc import Callable, Iterable
from typing import Any, Protocol, cast

from companion.errors import LinkError
from companion.links import telemetry_socket
from companion.links.backoff import Backoff
from companion.links.bytestream import ByteLink, PortSettings
from companion.links.mavlink import MavlinkLink

logger = logging.getLogger(__name__)

PEER_SILENCE_S = 10.0
MAX_PEERS = 8
"""Newcomers beyond these are heard but not answered: a scan of our port must not push out the autopilot."""
OUT_BUFFER_BYTES = 65536
MOST_DATAGRAM_BYTES = 65536
"""UDP carries no more; asyncio makes room for four times that, afresh for every datagram, which costs more than all the
rest of its reading: so much memory is got from the kernel, and given back, page by page."""
RESOLVE_DEADLINE_S = 5.0
"""For the host's name; without a network a resolver takes its time."""
_TURN_S = 1.0
_URL = re.compile(r"(?P<kind>udpin|udpout|tcp|serial):(?P<where>.+):(?P<number>\d+)")
# The target's host is up but nobody listens yet (or it restarts): keep sending, it will come.
_PASSING_ERRORS = frozenset({errno.ECONNREFUSED, errno.ENOBUFS, errno.EAGAIN})

OnState = Callable[[bool, str], None]


async def run_transport(link: MavlinkLink, url: str, *, on_state: OnState | None = None) -> None:
    """Keep `link` connected through `url` until cancelled.

    `on_state(connected, words)` tells of every change; for UDP the words hold the local address.

    Raises:
        LinkError: the url is none of ours. A peer that is not there is no error.
    """
    kind, where, number = parse_url(url)
    if kind in ("udpin", "udpout"):
        await _run_udp(link, url, (where, number), listen=kind == "udpin", on_state=on_state)
        return
    settings = PortSettings(f"tcp://{where}:{number}", 0) if kind == "tcp" else PortSettings(where, number)

    def state(connected: bool, words: str) -> None:  # noqa: FBT001 - ByteLink's own signature
        link.attach(stream.write if connected else None)
        if on_state is not None:
            on_state(connected, words)

    stream = ByteLink(settings, link.receive, name="mavlink", on_state=state)
    stream.on_beat = link.on_beat
    await stream.run()


def parse_url(url: str) -> tuple[str, str, int]:
    """Kind ("udpin", "udpout", "tcp", "serial"), host or path, and port or baud rate of a MAVLink url.

    Raises:
        LinkError: it is none; says what is allowed.
    """
    match = _URL.fullmatch(url)
    if match is None or (match["kind"] != "serial" and int(match["number"]) > 65535):
        raise LinkError(
            f"MAVLink url {url!r}: allowed are udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT and serial:PATH:BAUD"
        )
    return match["kind"], match["where"], int(match["number"])


async def _run_udp(
    link: MavlinkLink, url: str, address: tuple[str, int], *, listen: bool, on_state: OnState | None
) -> None:
    """Open the socket again with back-off whenever it fails or its local address is gone."""
    loop = asyncio.get_running_loop()
    backoff = Backoff()
    warned = False
    said: tuple[bool, str] | None = None

    def say(words: str, *, connected: bool) -> None:
        nonlocal said
        if on_state is not None and (connected, words) != said:
            said = (connected, words)
            on_state(connected, words)

    def factory() -> _Udp:
        return _Listener(link) if listen else _Speaker(link)

    while True:
        link.on_beat()
        try:
            async with asyncio.timeout(RESOLVE_DEADLINE_S):
                if listen:
                    transport, udp = await loop.create_datagram_endpoint(factory, local_addr=address)
                else:
                    transport, udp = await loop.create_datagram_endpoint(factory, remote_addr=address)
        except TimeoutError:
            reason = f"{url}: the name is not resolved within {RESOLVE_DEADLINE_S:g} s"
        except (OSError, UnicodeError) as error:
            reason = f"{url}: {getattr(error, 'strerror', None) or error}"
        else:
            host, port = transport.get_extra_info("sockname")[:2]
            logger.info("mavlink: %s is open at %s:%s", url, host, port)
            say(f"{url} is open at {host}:{port}", connected=True)
            warned = False
            since_s = loop.time()
            try:
                reason = f"{url}: {await udp.run()}"
            finally:
                transport.abort()
                link.attach(None)
                await udp.closed
            if loop.time() - since_s > _TURN_S:
                backoff.reset()
        logger.log(logging.DEBUG if warned else logging.WARNING, "mavlink: %s", reason)
        warned = True
        say(reason, connected=False)
        await asyncio.sleep(backoff.next_s())


class _DatagramOut(Protocol):
    """What every event loop's datagram transport can, though asyncio's own type does not say so."""

    def sendto(self, data: bytes, addr: tuple[Any, ...] | None = None) -> None: ...

    def get_write_buffer_size(self) -> int: ...


class _Udp(asyncio.DatagramProtocol):
    """What both kinds of UDP share: receiving, a bounded way out, and an end."""

    def __init__(self, link: MavlinkLink) -> None:
        self.link = link
        loop = asyncio.get_running_loop()
        self.now_s = loop.time
        self.closed: asyncio.Future[None] = loop.create_future()
        self._failed: asyncio.Future[str] = loop.create_future()
        self._transport: _DatagramOut | None = None

    async def run(self) -> str:
        """Serve until the socket fails; returns why."""
        while not self._failed.done():
            self.link.on_beat()
            await asyncio.wait([self._failed], timeout=_TURN_S)
            self._turn()
        return self._failed.result()

    def _turn(self) -> None:
        """What is due once a second."""

    def connection_made(self, transport: asyncio.DatagramTransport) -> None:  # type: ignore[override]
        self._transport = cast("_DatagramOut", transport)
        if hasattr(transport, "max_size"):
            transport.max_size = MOST_DATAGRAM_BYTES

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        if not self.closed.done():
            self.closed.set_result(None)
        self._fail(exc)

    def error_received(self, exc: Exception) -> None:
        # Anything else (the network is down, our address is gone) may be for ever for a socket that is bound to it.
        if not (isinstance(exc, OSError) and exc.errno in _PASSING_ERRORS):
            self._fail(exc)

    def send_to(self, data: bytes, peer: tuple[Any, ...] | None) -> bool:
        """Send one datagram; False when the socket is gone or its buffer full (then the newest is what is dropped)."""
        transport = self._transport
        if transport is None or transport.get_write_buffer_size() + len(data) > OUT_BUFFER_BYTES:
            return False
        transport.sendto(data, peer)
        return True

    def _fail(self, error: Exception | None) -> None:
        if not self._failed.done():
            self._failed.set_result(str(getattr(error, "strerror", None) or error or "closed"))


class _Speaker(_Udp):
    """udpout: one target, from which alone we hear."""

    def connection_made(self, transport: asyncio.DatagramTransport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.link.attach(lambda data: self.send_to(data, None))

    def datagram_received(self, data: bytes, addr: tuple[Any, ...]) -> None:
        self.link.arrived(data, self.now_s())


class _Listener(_Udp):
    """udpin: sends to every peer heard lately; with no such peer the link counts as not connected."""

    def __init__(self, link: MavlinkLink) -> None:
        super().__init__(link)
        self._heard_s: dict[tuple[Any, ...], float] = {}
        self._telemetry: _Telemetry | None = None

    def connection_made(self, transport: asyncio.DatagramTransport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._telemetry = _Telemetry(transport.get_extra_info("socket"), self)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._telemetry is not None:
            self._telemetry.close()
        super().connection_lost(exc)

    def datagram_received(self, data: bytes, addr: tuple[Any, ...]) -> None:
        now_s = self.now_s()
        self.hear(addr, now_s)
        self.link.arrived(data, now_s)

    def hear(self, peer: tuple[Any, ...], t_s: float) -> None:
        """A peer spoke."""
        if peer in self._heard_s or len(self._heard_s) < MAX_PEERS:
            self._heard_s[peer] = t_s
            if not self.link.connected:
                self.link.attach(self._send_to_all)

    def error_received(self, exc: Exception) -> None:
        # One peer that cannot be reached is its own trouble; it is forgotten once silent.
        return

    def _send_to_all(self, data: bytes) -> bool:
        sent = [self.send_to(data, peer) for peer in self._heard_s]
        return any(sent)

    def _turn(self) -> None:
        now_s = self.now_s()
        self._heard_s = {peer: heard_s for peer, heard_s in self._heard_s.items() if now_s - heard_s <= PEER_SILENCE_S}
        if not self._heard_s:
            self.link.attach(None)


class _Telemetry:
    """The sockets beside a listener's own, opened as soon as a fast stream drives: telemetry is read with that."""

    def __init__(self, beside: telemetry_socket.Endpoint, listener: _Listener) -> None:
        self._beside, self._listener, self._link = beside, listener, listener.link
        self._loop = asyncio.get_running_loop()
        self._pair: telemetry_socket.Pair | None = None
        self._tried = False
        self._leave = self._link.together.join(self)

    def take(self) -> None:
        if self._pair is not None:
            self._receive(self._pair.drain(self._listener.now_s()))

    def _asked(self) -> None:
        """Questions have come: answer them ahead of telemetry where that may be, else behind it."""
        assert self._pair is not None
        together = self._link.together
        if together.driven and (asked := self._pair.ahead(self._listener.now_s())):
            self._receive(asked)
        else:
            together.take()

    def _receive(self, datagrams: Iterable[tuple[bytes, tuple[Any, ...], float]]) -> None:
        heard: tuple[Any, ...] | None = None
        for data, peer, t_s in datagrams:
            if peer != heard:
                heard = peer
                self._listener.hear(peer, t_s)
            self._link.receive(data, t_s)

    def listen(self, *, at_once: bool) -> None:
        if not at_once and not self._tried:
            self._open()
        if self._pair is None:
            return
        if at_once:
            self._loop.add_reader(self._pair.telemetry, self._link.together.take)
        else:
            self._loop.remove_reader(self._pair.telemetry)

    def _open(self) -> None:
        self._tried = True
        self._pair = telemetry_socket.beside(self._beside)
        if self._pair is not None:
            self._loop.add_reader(self._pair.questions, self._asked)
            for data, peer in telemetry_socket.left_in(self._beside):
                self._listener.datagram_received(data, peer)

    def close(self) -> None:
        self._tried = True
        self._leave()
        if self._pair is not None:
            self._loop.remove_reader(self._pair.questions)
            self._pair.close()
