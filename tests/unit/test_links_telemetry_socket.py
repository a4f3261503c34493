"""The kernel tells telemetry from questions: on loopback with real sockets, its program in a machine of ours."""

from __future__ import annotations

import asyncio
import dataclasses
import select
import socket
import struct
import time
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.links import telemetry_socket
from companion.links.mavlink import MavlinkLink
from companion.links.mavlink_frames import may_wait
from companion.links.mavlink_transport import run_transport
from companion.links.telemetry_socket import CUT_SHORT, QUESTIONS, TELEMETRY, Pair
from tests.unit.test_links_mavlink_transport import States, receive, udp_socket, until

CODEC = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
HEARTBEAT: bytes = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(CODEC)
TIMESYNC: bytes = mavlink.MAVLink_timesync_message(0, 77).pack(CODEC)
ATTITUDE: bytes = mavlink.MAVLink_attitude_message(7, 0.1, 0.2, 0.3, 0.0, 0.0, 0.0).pack(CODEC)
IMU: bytes = mavlink.MAVLink_scaled_imu_message(1, 2, 3, -1000, 5, 6, 7, 8, 9, 10).pack(CODEC)
ONE_CALL: bytes = mavlink.MAVLink_command_long_message(1, 191, 400, 0, *[0.0] * 7).pack(CODEC)
CHUNKS = (HEARTBEAT, TIMESYNC, ATTITUDE, IMU, ONE_CALL, b"\xfd", b"", ATTITUDE[:9], bytes(20), b"\xfe" + ATTITUDE)


@dataclasses.dataclass
class Port:
    """The sockets of one port."""

    first: socket.socket
    pair: Pair

    @property
    def address(self) -> tuple[str, int]:
        host, port = self.first.getsockname()
        return host, port

    @property
    def all(self) -> list[socket.socket]:
        return [self.first, self.pair.questions, self.pair.telemetry]

    def wait(self, endpoint: socket.socket) -> None:
        """Until something has come."""
        assert select.select([endpoint], [], [], 5.0)[0]


@pytest.fixture
def port() -> Iterator[Port]:
    first = udp_socket()
    pair = telemetry_socket.beside(first)
    if pair is None:
        pytest.skip("this kernel has no SO_ATTACH_REUSEPORT_CBPF")
    yield Port(first, pair)
    first.close()
    pair.close()


def run(program: list[telemetry_socket.Instruction], data: bytes) -> int:
    """Classic BPF, by the kernel's Documentation/networking/filter.rst; beyond the end of the data it returns 0."""
    a = x = 0
    at = 0
    while True:
        code, true, false, k = program[at]
        at += 1
        try:
            if code == 0x06:
                return k
            if code in (0x15, 0x1D):
                at += true if a == (k if code == 0x15 else x) else false
            elif code == 0x50:
                a = data[x + k]
            elif code == 0x48:
                a = struct.unpack_from(">H", data, x + k)[0]
            elif code == 0x80:
                a = len(data)
            elif code == 0x01:
                x = k
            elif code == 0x04:
                a += k
            elif code == 0x0C:
                a += x
            elif code == 0x07:
                x = a
            else:
                raise AssertionError(code)
        except (IndexError, struct.error):
            return 0


def test_every_jump_of_the_program_stays_in_it_and_fits_its_byte() -> None:
    program = telemetry_socket.program()
    assert len(program) <= 4096
    for place, (code, true, false, _) in enumerate(program):
        if code in (0x15, 0x1D):
            assert max(true, false) < 256
            assert place + 1 + max(true, false) < len(program)
    assert program[-1][0] == 0x06


@given(st.lists(st.sampled_from(CHUNKS), max_size=telemetry_socket.MOST_FRAMES).map(b"".join))
def test_the_program_says_what_python_says(datagram: bytes) -> None:
    assert (run(telemetry_socket.program(), datagram) == TELEMETRY) == may_wait(datagram)


@given(st.binary(max_size=60), st.integers(0, len(ATTITUDE) - 1))
def test_the_program_says_what_python_says_of_noise(noise: bytes, cut: int) -> None:
    for datagram in (noise, ATTITUDE[:cut] + noise, ATTITUDE + noise):
        assert (run(telemetry_socket.program(), datagram) == TELEMETRY) == may_wait(datagram)


def test_more_frames_than_the_program_looks_at_are_no_telemetry() -> None:
    most = telemetry_socket.MOST_FRAMES
    assert run(telemetry_socket.program(), ATTITUDE * most) == TELEMETRY
    assert run(telemetry_socket.program(), ATTITUDE * (most + 1)) == QUESTIONS


@pytest.mark.parametrize(
    ("datagram", "place"),
    [
        (ATTITUDE, TELEMETRY),
        (IMU + ATTITUDE, TELEMETRY),
        (HEARTBEAT, QUESTIONS),
        (TIMESYNC, QUESTIONS),
        (ONE_CALL, QUESTIONS),
        (ATTITUDE + ONE_CALL, QUESTIONS),
        (ATTITUDE[:-1], CUT_SHORT),
        (b"", CUT_SHORT),
    ],
)
def test_the_kernel_gives_each_datagram_to_its_socket(port: Port, datagram: bytes, place: int) -> None:
    with udp_socket() as peer:
        peer.sendto(datagram, port.address)
        ready, _, _ = select.select(port.all, [], [], 5.0)
        assert ready == [port.all[place]]
        if place != CUT_SHORT:
            now_s = time.monotonic()
            [(data, address, t_s)] = port.pair.drain(now_s)
            assert (data, address) == (datagram, peer.getsockname())
            assert now_s - telemetry_socket.OLDEST_S <= t_s <= now_s
            assert list(port.pair.drain(now_s)) == []


def test_each_datagram_has_the_time_at_which_it_came(port: Port) -> None:
    with udp_socket() as peer:
        before_s = time.monotonic()
        peer.sendto(ATTITUDE, port.address)
        port.wait(port.pair.telemetry)
        after_s = time.monotonic()
        while time.monotonic() < after_s + 0.02:
            select.select([], [], [], 0.005)
        [(_, _, t_s)] = port.pair.drain(time.monotonic())
        # The wall clock may be slewed a little meanwhile.
        assert before_s - 1e-3 <= t_s <= after_s + 1e-3 or t_s > after_s + telemetry_socket.OLDEST_S


def test_both_sockets_together_are_read_in_the_order_in_which_all_came(port: Port) -> None:
    """However long the loop stood still: an autopilot's clock that goes back means that it restarted."""
    with udp_socket() as peer:
        sent = []
        for number in range(40):
            boot = mavlink.MAVLink_attitude_message(number, *[0.0] * 6).pack(CODEC)
            sent.append(TIMESYNC[:-2] + bytes((number, 0)) if number % 3 == 1 else boot)
            peer.sendto(sent[-1], port.address)
        port.wait(port.pair.questions)
        assert [data for data, _, _ in port.pair.drain(50.0)] == sent


@pytest.mark.parametrize(("questions", "go_ahead"), [((TIMESYNC, ONE_CALL), True), ((TIMESYNC, HEARTBEAT), False)])
def test_questions_go_ahead_of_telemetry_only_where_all_of_them_may(
    port: Port, questions: tuple[bytes, bytes], go_ahead: bool
) -> None:
    first, second = questions
    with udp_socket() as peer:
        for datagram in (ATTITUDE, first, IMU, second):
            peer.sendto(datagram, port.address)
        port.wait(port.pair.questions)
        assert [data for data, _, _ in port.pair.ahead(50.0)] == ([first, second] if go_ahead else [])
        left = [ATTITUDE, IMU] if go_ahead else [ATTITUDE, first, IMU, second]
        assert [data for data, _, _ in port.pair.drain(50.0)] == left
        assert list(port.pair.drain(50.0)) == []


def test_a_wall_clock_that_was_set_meanwhile_dates_nothing(port: Port, monkeypatch: pytest.MonkeyPatch) -> None:
    for off_s in (-3600.0, 3600.0):
        with udp_socket() as peer, monkeypatch.context() as patched:
            peer.sendto(ATTITUDE, port.address)
            port.wait(port.pair.telemetry)
            there_s = time.time() + off_s
            patched.setattr(time, "time", lambda there_s=there_s: there_s)
            assert [t_s for _, _, t_s in port.pair.drain(50.0)] == [50.0]


def test_nobody_else_gets_the_port(port: Port) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other, pytest.raises(OSError, match="in use"):
        other.bind(port.address)


def test_what_had_come_to_the_first_socket_is_not_left_there() -> None:
    with udp_socket() as first, udp_socket() as peer:
        for datagram in (ATTITUDE, HEARTBEAT):
            peer.sendto(datagram, first.getsockname())
        assert select.select([first], [], [], 5.0)[0]
        found = telemetry_socket.left_in(first)
        assert found == [(datagram, peer.getsockname()) for datagram in (ATTITUDE, HEARTBEAT)]
        assert telemetry_socket.left_in(first) == []


def test_no_more_than_a_bounded_number_is_taken_at_once(port: Port, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(telemetry_socket, "MOST_AT_ONCE", 3)
    with udp_socket() as peer:
        for _ in range(4):
            peer.sendto(ATTITUDE, port.address)
        port.wait(port.pair.telemetry)
        assert [len(list(port.pair.drain(0.0))) for _ in range(3)] == [3, 1, 0]


@pytest.mark.parametrize("kernel_can", [True, False])
def test_a_listener_takes_telemetry_with_the_stream_and_questions_at_once(
    monkeypatch: pytest.MonkeyPatch, kernel_can: bool
) -> None:
    opened: list[Pair | None] = []

    def beside(endpoint: socket.socket) -> Pair | None:
        opened.append(real(endpoint) if kernel_can else None)
        return opened[-1]

    real = telemetry_socket.beside
    monkeypatch.setattr(telemetry_socket, "beside", beside)

    async def main() -> None:
        link, states = MavlinkLink(), States()
        task = asyncio.create_task(run_transport(link, "udpin:127.0.0.1:0", on_state=states))
        try:
            await until(lambda: states.connected)
            with udp_socket() as peer:
                target = ("127.0.0.1", states.port)
                peer.sendto(ATTITUDE, target)
                await until(lambda: link.received["ATTITUDE"] == 1)
                assert opened == [], "without a fast stream there is one socket"
                link.together.drive()
                link.together.rest()
                link.together.drive()
                assert len(opened) == 1
                link.attach(None)
                peer.sendto(ATTITUDE, target)
                peer.sendto(HEARTBEAT, target)
                await until(lambda: link.received["HEARTBEAT"] == 1)
                assert link.received["ATTITUDE"] == 2, "what came before a question is taken before it"
                peer.sendto(ATTITUDE, target)
                await asyncio.sleep(0.05)
                assert link.received["ATTITUDE"] == 2
                peer.sendto(TIMESYNC, target)
                await until(lambda: link.received["TIMESYNC"] == 1)
                assert link.received["ATTITUDE"] == 2, "answered ahead of what waits"
                link.together.rest()
                assert link.received["ATTITUDE"] == 3
                assert link.connected, "any datagram makes a peer known"
                peer.sendto(ATTITUDE, target)
                await until(lambda: link.received["ATTITUDE"] == 4)
                assert link.send(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
                assert await receive(peer)
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
        with udp_socket(states.port):
            pass  # both sockets are closed
        link.together.drive()
        link.together.take()

    asyncio.run(main())
