"""The transports on real sockets and a pseudo terminal: loopback only, ports given by the system."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, suppress

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.errors import LinkError
from companion.links.mavlink import transport as mavlink_transport
from companion.links.mavlink.link import MavlinkLink
from companion.links.mavlink.signing import Signing
from companion.links.mavlink.transport import MAX_PEERS, run_transport

pytestmark = pytest.mark.sockets

HEARTBEAT = mavlink.MAVLink_heartbeat_message
DEADLINE_S = 5.0


def packet(mode: int = 0, *, system: int = 1, component: int = 1) -> bytes:
    return HEARTBEAT(2, 3, 0, mode, 4, 3).pack(mavlink.MAVLink(None, srcSystem=system, srcComponent=component))


async def until(condition: Callable[[], bool]) -> None:
    """Wait for something that real sockets bring."""
    async with asyncio.timeout(DEADLINE_S):
        while not condition():
            await asyncio.sleep(0.002)


class States:
    def __init__(self) -> None:
        self.all: list[tuple[bool, str]] = []

    def __call__(self, connected: bool, words: str) -> None:
        self.all.append((connected, words))

    @property
    def connected(self) -> bool:
        return bool(self.all) and self.all[-1][0]

    @property
    def port(self) -> int:
        return int(self.all[-1][1].rsplit(":", 1)[1])


@asynccontextmanager
async def transport(link: MavlinkLink, url: str) -> AsyncIterator[States]:
    states = States()
    task = asyncio.create_task(run_transport(link, url, on_state=states))
    try:
        yield states
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
        assert not link.connected, "a transport that has ended is detached"


@pytest.fixture
def peer() -> Iterator[socket.socket]:
    endpoint = udp_socket()
    yield endpoint
    endpoint.close()


@pytest.fixture
def speakers(monkeypatch: pytest.MonkeyPatch) -> list[mavlink_transport._Speaker]:
    """Every udpout socket that is opened."""
    opened: list[mavlink_transport._Speaker] = []

    class Recorded(mavlink_transport._Speaker):
        def __init__(self, link: MavlinkLink) -> None:
            super().__init__(link)
            opened.append(self)

    monkeypatch.setattr(mavlink_transport, "_Speaker", Recorded)
    return opened


def udp_socket(port: int = 0) -> socket.socket:
    endpoint = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    endpoint.setblocking(False)
    endpoint.bind(("127.0.0.1", port))
    return endpoint


async def receive(endpoint: socket.socket) -> bytes:
    async with asyncio.timeout(DEADLINE_S):
        return await asyncio.get_running_loop().sock_recv(endpoint, 2048)


class TestUdpIn:
    async def test_answers_whoever_speaks_and_counts_as_connected_only_then(self, peer: socket.socket) -> None:
        link = MavlinkLink()
        async with transport(link, "udpin:127.0.0.1:0") as states:
            await until(lambda: states.connected)
            assert not link.connected
            peer.sendto(packet(), ("127.0.0.1", states.port))
            await until(lambda: link.connected)
            assert link.received["HEARTBEAT"] == 1
            other = udp_socket()
            other.sendto(packet(), ("127.0.0.1", states.port))
            await until(lambda: link.received["HEARTBEAT"] == 2)
            assert link.send(HEARTBEAT(18, 8, 0, 0, 4, 3))
            assert await receive(peer) == await receive(other)
            other.close()

    async def test_forgets_peers_that_went_silent(self, peer: socket.socket, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(mavlink_transport, "PEER_SILENCE_S", 0.2)
        monkeypatch.setattr(mavlink_transport, "_TURN_S", 0.02)
        link = MavlinkLink()
        async with transport(link, "udpin:127.0.0.1:0") as states:
            await until(lambda: states.connected)
            for _ in range(2):
                peer.sendto(packet(), ("127.0.0.1", states.port))
                await until(lambda: link.connected)
                await until(lambda: not link.connected)

    async def test_a_scan_cannot_push_out_who_was_there_first(self, peer: socket.socket) -> None:
        link = MavlinkLink()
        async with transport(link, "udpin:127.0.0.1:0") as states:
            await until(lambda: states.connected)
            peer.sendto(packet(), ("127.0.0.1", states.port))
            await until(lambda: link.connected)
            scanners = [udp_socket() for _ in range(3 * MAX_PEERS)]
            for scanner in scanners:
                scanner.sendto(packet(system=200), ("127.0.0.1", states.port))
            await until(lambda: link.received["HEARTBEAT"] == 1 + len(scanners))
            link.send(HEARTBEAT(18, 8, 0, 0, 4, 3))
            await receive(peer)
            await asyncio.sleep(0.05)
            answered = 0
            for scanner in scanners:
                with suppress(BlockingIOError):
                    scanner.recv(2048)
                    answered += 1
                scanner.close()
            assert answered == MAX_PEERS - 1

    async def test_bytes_that_are_no_message_get_no_place(self, peer: socket.socket) -> None:
        link = MavlinkLink()
        async with transport(link, "udpin:127.0.0.1:0") as states:
            await until(lambda: states.connected)
            strangers = [udp_socket() for _ in range(MAX_PEERS)]
            radio = mavlink.MAVLink_radio_status_message(7, 0, 0, 0, 0, 0, 0).pack(mavlink.MAVLink(None))
            for stranger in strangers:
                for data in (b"x", packet()[:-1], packet()[:-1] + b"\0", radio):
                    stranger.sendto(data, ("127.0.0.1", states.port))
            await until(lambda: link.received["RADIO_STATUS"] == MAX_PEERS)
            assert not link.connected
            peer.sendto(packet(), ("127.0.0.1", states.port))
            await until(lambda: link.connected)
            assert link.send(HEARTBEAT(18, 8, 0, 0, 4, 3))
            await receive(peer)
            for stranger in strangers:
                stranger.close()

    async def test_who_is_not_believed_gets_no_place(self, peer: socket.socket) -> None:
        link = MavlinkLink()
        link.signing = Signing(required=True, key=bytes(32))
        async with transport(link, "udpin:127.0.0.1:0") as states:
            await until(lambda: states.connected)
            peer.sendto(packet(), ("127.0.0.1", states.port))
            await until(lambda: link.signing is not None and link.signing.doubted["unsigned"] == 1)
            assert not link.connected

    async def test_the_autopilot_has_a_place_whoever_else_speaks_and_keeps_it_when_its_port_changes(
        self, peer: socket.socket
    ) -> None:
        link = MavlinkLink()
        link.join((1, 1))
        async with transport(link, "udpin:127.0.0.1:0") as states:
            await until(lambda: states.connected)
            stations = [udp_socket() for _ in range(MAX_PEERS)]
            for number, station in enumerate(stations):
                station.sendto(packet(system=100 + number, component=190), ("127.0.0.1", states.port))
                await until(lambda number=number: link.received["HEARTBEAT"] == number + 1)  # type: ignore[misc]
            moved = udp_socket()
            for autopilot in (peer, moved):
                autopilot.sendto(packet(), ("127.0.0.1", states.port))
            await until(lambda: link.received["HEARTBEAT"] == MAX_PEERS + 2)
            link.send(HEARTBEAT(18, 8, 0, 0, 4, 3))
            for reached in (peer, moved, *stations[2:]):
                await receive(reached)
            for silent_for_longest in stations[:2]:
                with pytest.raises(BlockingIOError):
                    silent_for_longest.recv(2048)
            for endpoint in (moved, *stations):
                endpoint.close()

    @pytest.mark.parametrize(
        "cut_off", [b"\xfd\xff", b"\xfe\xff", packet()[:-1], bytes(range(1, 50)) + b"\xfd\xff\x00"]
    )
    async def test_a_datagram_is_whole_whoever_sent_the_one_before(self, peer: socket.socket, cut_off: bytes) -> None:
        link = MavlinkLink()
        async with transport(link, "udpin:127.0.0.1:0") as states:
            await until(lambda: states.connected)
            stranger = udp_socket()
            for number in range(20):
                stranger.sendto(cut_off, ("127.0.0.1", states.port))
                peer.sendto(packet(), ("127.0.0.1", states.port))
                await until(lambda number=number: link.received["HEARTBEAT"] == number + 1)  # type: ignore[misc]
            assert link.half_received == b""
            stranger.close()

    async def test_waits_for_a_port_that_is_taken(self, peer: socket.socket) -> None:
        link = MavlinkLink()
        taken = peer.getsockname()[1]
        async with transport(link, f"udpin:127.0.0.1:{taken}") as states:
            await until(lambda: bool(states.all))
            assert "in use" in states.all[0][1]
            peer.close()
            await until(lambda: states.connected)


class TestUdpOut:
    async def test_speaks_first_and_hears_the_answer(self, peer: socket.socket) -> None:
        link = MavlinkLink()
        async with transport(link, f"udpout:127.0.0.1:{peer.getsockname()[1]}") as states:
            await until(lambda: link.connected)
            link.send(HEARTBEAT(18, 8, 0, 0, 4, 3))
            assert (await receive(peer))[0] == 0xFD
            peer.sendto(packet(), ("127.0.0.1", states.port))
            await until(lambda: link.received["HEARTBEAT"] == 1)
            stranger = udp_socket()
            stranger.sendto(packet(), ("127.0.0.1", states.port))
            await asyncio.sleep(0.05)
            assert link.received["HEARTBEAT"] == 1
            stranger.close()

    async def test_survives_that_nobody_listens_yet(self) -> None:
        link = MavlinkLink()
        placeholder = udp_socket()
        port = placeholder.getsockname()[1]
        placeholder.close()
        async with transport(link, f"udpout:127.0.0.1:{port}") as states:
            await until(lambda: link.connected)
            for _ in range(20):
                link.send(HEARTBEAT(18, 8, 0, 0, 4, 3))
                await asyncio.sleep(0.002)
            assert states.all == [(True, states.all[0][1])]
            late = udp_socket(port)
            link.send(HEARTBEAT(18, 8, 0, 0, 4, 3))
            assert (await receive(late))[0] == 0xFD
            late.close()

    async def test_opens_again_after_the_network_was_gone(
        self, peer: socket.socket, speakers: list[mavlink_transport._Speaker]
    ) -> None:
        link = MavlinkLink()
        async with transport(link, f"udpout:127.0.0.1:{peer.getsockname()[1]}") as states:
            await until(lambda: bool(states.all))
            before = states.port
            speakers[0].error_received(OSError(101, "Network is unreachable"))
            await until(lambda: len(states.all) == 3)
            assert [connected for connected, _ in states.all] == [True, False, True]
            assert "Network is unreachable" in states.all[1][1]
            assert states.port != before
            link.send(HEARTBEAT(18, 8, 0, 0, 4, 3))
            await receive(peer)

    async def test_a_name_that_cannot_be_resolved_is_tried_again(self, monkeypatch: pytest.MonkeyPatch) -> None:
        link = MavlinkLink()
        loop = asyncio.get_running_loop()
        inner, tries = loop.create_datagram_endpoint, 0

        async def flaky(*args: object, **kwargs: object) -> object:
            nonlocal tries
            tries += 1
            if tries < 3:
                raise socket.gaierror(-2, "Name or service not known")
            return await inner(*args, **kwargs)  # type: ignore[arg-type]

        monkeypatch.setattr(loop, "create_datagram_endpoint", flaky)
        async with transport(link, "udpout:127.0.0.1:9") as states:
            await until(lambda: len(states.all) > 1)  # said a turn of the loop after it is connected
            assert tries == 3
            assert [connected for connected, _ in states.all] == [False, True]
            assert "Name or service not known" in states.all[0][1]

    async def test_what_finds_no_room_in_the_kernel_is_dropped_and_counted_and_never_leaves_later(
        self, speakers: list[mavlink_transport._Speaker]
    ) -> None:
        link = MavlinkLink()
        placeholder = udp_socket()
        async with transport(link, f"udpout:127.0.0.1:{placeholder.getsockname()[1]}"):
            await until(lambda: link.connected)
            ours, full = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
            ours.setblocking(False)
            real, speakers[0]._socket = speakers[0]._socket, ours
            while link.send(HEARTBEAT(18, 8, 0, 0, 4, 3)):
                pass
            sent = link.sent
            assert link.dropped == 1
            for _ in range(sent):
                full.recv(2048)
            await asyncio.sleep(0.05)
            full.setblocking(False)
            with pytest.raises(BlockingIOError):
                full.recv(2048)
            speakers[0]._socket = real
            ours.close()
            full.close()
        placeholder.close()

    async def test_all_that_waits_in_the_kernel_is_read_at_once_when_somebody_has_to_know(
        self, peer: socket.socket
    ) -> None:
        link = MavlinkLink()
        async with transport(link, f"udpout:127.0.0.1:{peer.getsockname()[1]}") as states:
            await until(lambda: link.connected)
            for _ in range(100):
                peer.sendto(packet(), ("127.0.0.1", states.port))
            assert link.received["HEARTBEAT"] == 0
            assert link.settled()
            assert link.received["HEARTBEAT"] == 100


class TestTcp:
    async def test_connects_comes_back_and_begins_each_time_with_a_new_packet(self) -> None:
        link = MavlinkLink()
        writers: list[asyncio.StreamWriter] = []
        heard: list[bytes] = []

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writers.append(writer)
            while data := await reader.read(100):
                heard.append(data)
            writer.close()

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        port = server.sockets[0].getsockname()[1]
        async with transport(link, f"tcp:127.0.0.1:{port}") as states:
            await until(lambda: link.connected and bool(writers))
            link.send(HEARTBEAT(18, 8, 0, 0, 4, 3))
            await until(lambda: bool(heard))
            writers[0].write(packet()[:9])
            await asyncio.sleep(0.02)
            writers[0].close()
            await until(lambda: not link.connected)
            await until(lambda: link.connected and len(writers) == 2)
            writers[1].write(packet())
            await until(lambda: link.received["HEARTBEAT"] == 1)
            assert link.received["bad"] == 0
            assert [connected for connected, _ in states.all] == [True, False, True]
        server.close()
        await server.wait_closed()
        for writer in writers:
            writer.close()


@pytest.mark.real_clock
@pytest.mark.parametrize(
    "url", ["", "udp:127.0.0.1:1", "udpin:127.0.0.1", "udpin:127.0.0.1:65536", "tcp:host:x", "serial:/dev/ttyX"]
)
def test_a_url_that_is_none_of_ours_is_refused_in_words(url: str) -> None:
    with pytest.raises(LinkError, match="udpin:HOST:PORT"):
        asyncio.run(run_transport(MavlinkLink(), url))
