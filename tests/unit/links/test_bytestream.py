"""Ports that come back: real ptys and real loopback sockets, unplugged, refused, hung and reset."""

from __future__ import annotations

import asyncio
import itertools
import logging
import os
import socket
import stat
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest

from companion.errors import LinkError
from companion.links.serial import bytestream
from companion.links.serial import port as serial_port
from companion.links.serial.bytestream import OUT_BUFFER_BYTES, QUICK_READS, ByteLink, PortSettings
from companion.links.serial.port import SerialOpener, open_serial

pytestmark = pytest.mark.real_clock

NOBODY = 65534
IS_ROOT = os.geteuid() == 0
FAST = 4_000_000
"""Baud at which a few bytes take no time."""


class Pty:
    """A device: what is written to `master` is what the sensor says; `unplug` pulls it out."""

    def __init__(self, link: Path) -> None:
        self.master, slave = os.openpty()
        self.name = os.ttyname(slave)
        os.close(slave)
        link.unlink(missing_ok=True)
        link.symlink_to(self.name)
        self._link = link

    def unplug(self) -> None:
        self._link.unlink(missing_ok=True)
        if self.master >= 0:
            os.close(self.master)
            self.master = -1


@contextmanager
def plugged(link: Path) -> Iterator[Pty]:
    pty = Pty(link)
    try:
        yield pty
    finally:
        pty.unplug()


class ScriptedPort:
    """A running ByteLink and what it has told so far."""

    def __init__(self, url: str, baud: int = 19200) -> None:
        self.chunks: asyncio.Queue[tuple[bytes, float]] = asyncio.Queue()
        self.states: asyncio.Queue[tuple[bool, str]] = asyncio.Queue()
        self.link = ByteLink(
            PortSettings(url, baud),
            lambda data, t_s: self.chunks.put_nowait((data, t_s)),
            name="compass",
            on_state=lambda connected, reason: self.states.put_nowait((connected, reason)),
        )

    async def state(self, *, connected: bool) -> str:
        """Wait for the next report of that state; return its reason."""
        async with asyncio.timeout(40):
            while True:
                found, reason = await self.states.get()
                if found == connected:
                    return reason

    async def data(self, count: int) -> bytes:
        received = b""
        async with asyncio.timeout(40):
            while len(received) < count:
                received += (await self.chunks.get())[0]
        return received


@asynccontextmanager
async def running(url: str | Path, baud: int = 19200) -> AsyncIterator[ScriptedPort]:
    port = ScriptedPort(str(url), baud)
    task = asyncio.create_task(port.link.run())
    try:
        yield port
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


def open_descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


def join_openers() -> None:
    """Wait for the threads that open ports: each ends when its driver answers."""
    for thread in threading.enumerate():
        if thread.name.startswith("open "):
            thread.join(10)
            assert not thread.is_alive()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "imu"


# Serial ---------------------------------------------------------------------------------------------------------------


async def test_bytes_arrive_with_the_time_of_the_loop(path: Path) -> None:
    with plugged(path) as pty:
        async with running(path) as port:
            await port.state(connected=True)
            before_s = asyncio.get_running_loop().time()
            os.write(pty.master, b"123.4, 18.6, -0.5\r\n")
            data, t_s = await asyncio.wait_for(port.chunks.get(), 40)
            assert data == b"123.4, 18.6, -0.5\r\n"
            assert before_s <= t_s <= asyncio.get_running_loop().time()
            assert port.link.bytes_received == 19
            assert port.link.connected
            assert port.link.last_error == ""


async def collecting(port: ScriptedPort, pty: Pty) -> None:
    """Bytes one by one, each after the last has been read, until the link no longer wakes for each."""
    reads = 0
    while port.link._collecting is None:
        os.write(pty.master, bytes([reads]))
        assert await port.data(1) == bytes([reads])
        reads += 1
    assert reads == QUICK_READS


async def test_a_fast_stream_is_collected_and_a_byte_after_it_wakes_the_loop(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bytestream, "QUICK_S", 10.0)
    with plugged(path) as pty:
        async with running(path, FAST) as port:
            await port.state(connected=True)
            await collecting(port, pty)
            for number in range(5):
                os.write(pty.master, bytes([number]))
            chunk, _ = await asyncio.wait_for(port.chunks.get(), 40)
            assert chunk == bytes(range(5))  # written in one turn of the loop, they come together
            async with asyncio.timeout(40):
                while port.link._collecting is not None:
                    await asyncio.sleep(0.001)
            await collecting(port, pty)  # as at the start: each byte by itself


async def test_a_device_that_is_pulled_out_while_its_stream_is_collected_comes_back(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bytestream, "QUICK_S", 10.0)
    async with running(path, FAST) as port:
        for _ in range(2):
            with plugged(path) as pty:
                await port.state(connected=True)
                await collecting(port, pty)
                pty.unplug()
                assert "the device is gone" in await port.state(connected=False)
                assert port.link._collecting is None


async def test_an_unplugged_device_is_closed_at_once_and_found_again_under_another_name(path: Path) -> None:
    with plugged(path) as first:
        async with running(path) as port:
            await port.state(connected=True)
            os.write(first.master, b"one")
            assert await port.data(3) == b"one"
            descriptors = open_descriptors()
            first.unplug()
            reason = await port.state(connected=False)
            assert reason == f"{path}: the device is gone; unplugged?"
            assert port.link.last_error == reason
            assert not port.link.connected
            assert open_descriptors() == descriptors - 2  # the test's end and the link's
            assert "no such device; is it plugged in?" in await port.state(connected=False)
            # Another pty under the old one's link: only opening the link afresh can find it.
            with plugged(path) as second:
                await port.state(connected=True)
                os.write(second.master, b"two")
                assert await port.data(3) == b"two"
                assert port.link.reconnects == 1


async def test_a_second_reader_is_refused_and_told_who_is_first(path: Path) -> None:
    with plugged(path) as pty:
        async with running(path) as first:
            await first.state(connected=True)
            async with running(path) as second:
                reason = await second.state(connected=False)
                assert reason.startswith(f"{path}: in use by another program (")
                assert f"process {os.getpid()})" in reason
                os.write(pty.master, b"for the first")
                assert await first.data(13) == b"for the first"
                assert second.link.bytes_received == 0


def run_as_nobody(code: str) -> str:
    """Run Python without rights: root gives them up after the imports (this checkout may be closed to others)."""
    drop = f"import os\nos.setgroups([])\nos.setgid({NOBODY})\nos.setuid({NOBODY})\n" if IS_ROOT else "import os\n"
    imports = (
        "import serial\nfrom companion.errors import LinkError\nfrom companion.links.serial.port import open_serial\n"
        "from companion.messages import catalogue\ncatalogue()\n"
    )
    root = Path(__file__).parents[3]
    command = [sys.executable, "-c", imports + drop + code]
    return subprocess.run(command, check=True, cwd=root, stdout=subprocess.PIPE, text=True).stdout.strip()


def give_to_nobody(pty: Pty) -> None:
    if IS_ROOT:
        os.chown(pty.name, NOBODY, NOBODY)


def test_who_may_not_open_a_port_is_told_what_is_missing(path: Path) -> None:
    code = "try:\n    open_serial({name!r}, 9600, 'none')\nexcept LinkError as error:\n    print(error)\n"
    with plugged(path) as pty:
        os.chmod(pty.name, 0o000)
        said = run_as_nobody(code.format(name=pty.name))
        assert said.startswith(f"{pty.name}: permission denied; user ")
        assert f"may not read and write it (owner {Path(pty.name).owner()}:" in said
        assert said.endswith("mode 0000)")
        if IS_ROOT:
            os.chown(pty.name, 0, 20)  # as udev does it: root:dialout
        os.chmod(pty.name, 0o060)
        assert "is not in group" in run_as_nobody(code.format(name=pty.name))


def test_even_a_reader_that_asks_for_no_lock_is_kept_out(path: Path) -> None:
    with plugged(path) as pty:
        descriptor = open_serial(str(path), 9600, "none")
        try:
            give_to_nobody(pty)
            code = f"try:\n    os.open({pty.name!r}, os.O_RDWR)\nexcept OSError as error:\n    print(error.strerror)\n"
            assert run_as_nobody(code) == "Device or resource busy"
        finally:
            os.close(descriptor)


async def test_a_port_that_was_given_back_can_be_opened_by_others(path: Path) -> None:
    """A pseudo-terminal whose other end stays open would keep the lock for ever."""
    with plugged(path) as pty:
        async with running(path) as port:
            await port.state(connected=True)
        give_to_nobody(pty)
        code = f"os.close(os.open({pty.name!r}, os.O_RDWR | os.O_NOCTTY))\nprint('open')\n"
        assert await asyncio.to_thread(run_as_nobody, code) == "open"


def test_what_is_no_port_is_said_to_be_none(tmp_path: Path) -> None:
    plain = tmp_path / "file"
    plain.write_text("not a tty")
    with pytest.raises(LinkError, match=r"file: cannot be opened: not a serial port$"):
        open_serial(str(plain), 9600, "none")
    with pytest.raises(LinkError, match="no such device"):
        open_serial(str(tmp_path / "missing"), 9600, "none")


@pytest.mark.parametrize(
    ("baud", "speed", "parity", "flags"),
    [
        (2400, termios.B2400, "none", 0),
        (9600, termios.B9600, "even", termios.PARENB),
        (19200, termios.B19200, "odd", termios.PARENB | termios.PARODD),
        (500000, termios.B500000, "none", 0),
    ],
)
def test_speed_and_parity_are_set(
    path: Path, monkeypatch: pytest.MonkeyPatch, baud: int, speed: int, parity: Any, flags: int
) -> None:
    asked: list[list[Any]] = []
    really_set = termios.tcsetattr

    def note(descriptor: int, when: int, settings: list[Any]) -> None:
        asked.append(list(settings))
        really_set(descriptor, when, settings)

    monkeypatch.setattr(termios, "tcsetattr", note)
    before = open_descriptors()
    with plugged(path):
        descriptor = open_serial(str(path), baud, parity)
        try:
            iflag, oflag, cflag, lflag, ispeed, ospeed, control = termios.tcgetattr(descriptor)
            assert (ispeed, ospeed) == (speed, speed)
            assert cflag & termios.CSIZE == termios.CS8
            assert not oflag & termios.OPOST
            assert not lflag & (termios.ICANON | termios.ECHO | termios.ISIG)
            assert not iflag & (termios.ICRNL | termios.IXON | termios.ISTRIP | termios.IGNPAR | termios.PARMRK)
            assert bool(iflag & termios.INPCK) == (parity != "none"), "parity errors must be seen"
            # The kernel's ptys forget PARENB, so parity is read from what was asked for.
            assert asked[0][2] & (termios.PARENB | termios.PARODD) == flags
            assert control[termios.VMIN] in (1, b"\x01")
            assert not os.get_blocking(descriptor)
            with pytest.raises(BlockingIOError):
                os.read(descriptor, 1)  # and not b"", which is how a dead port looks
        finally:
            os.close(descriptor)
    assert open_descriptors() == before


def test_a_speed_that_cannot_be_is_refused(path: Path) -> None:
    with plugged(path), pytest.raises(LinkError, match=r"imu: cannot be opened: the driver refuses 99999999999 baud$"):
        open_serial(str(path), 99_999_999_999, "none")


async def test_a_port_that_dies_as_soon_as_it_is_open_is_not_hammered(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Hung-up ttys are readable for ever and give nothing: each is closed, and the pauses grow."""
    opened: list[float] = []

    def open_dead(_path: str, _baud: int, _parity: str) -> int:
        opened.append(time.monotonic())
        reading, writing = os.pipe()
        os.close(writing)
        return reading

    monkeypatch.setattr(serial_port, "open_serial", open_dead)
    before = open_descriptors()
    async with running(path) as port:
        for _ in range(4):
            await port.state(connected=True)
            assert "the device is gone" in await port.state(connected=False)
    pauses = [later - earlier for earlier, later in itertools.pairwise(opened)]
    for pause, least in zip(pauses, (0.2, 0.4, 0.8), strict=False):  # a busy machine takes longer, never shorter
        assert 0.8 * least < pause < least + 5.0
    assert open_descriptors() == before


def test_a_cancel_while_the_driver_hangs_leaks_nothing(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entered, release = threading.Event(), threading.Event()
    returned: list[int] = []

    def hang(_path: str, _baud: int, _parity: str) -> int:
        entered.set()
        release.wait(10)
        reading, writing = os.pipe()
        os.close(writing)
        returned.append(reading)
        return reading

    monkeypatch.setattr(serial_port, "open_serial", hang)
    before = open_descriptors()

    async def main() -> None:
        async with running(path):
            await asyncio.to_thread(entered.wait, 10)

    asyncio.run(main())  # comes to its end although the driver still hangs
    assert not returned
    release.set()
    join_openers()
    assert len(returned) == 1
    assert open_descriptors() == before


def test_a_driver_that_hangs_is_reported_and_not_asked_again(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    release = threading.Event()
    calls: list[str] = []

    def hang(name: str, _baud: int, _parity: str) -> int:
        calls.append(name)
        release.wait(10)
        raise LinkError("too late")

    monkeypatch.setattr(serial_port, "open_serial", hang)
    monkeypatch.setattr(serial_port, "OPEN_DEADLINE_S", 0.05)

    async def main() -> None:
        async with running(path) as port:
            assert "no answer of the driver within 0.05 s" in await port.state(connected=False)
            assert "the driver hangs" in await port.state(connected=False)

    asyncio.run(main())
    release.set()
    assert calls == [str(path)]


def test_an_unexpected_fault_while_opening_is_an_event_and_no_silence(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_path: str, _baud: int, _parity: str) -> int:
        raise RuntimeError("never thought of")

    monkeypatch.setattr(serial_port, "open_serial", fail)
    with pytest.raises(LinkError, match=r"/dev/imu: cannot be opened: RuntimeError\('never thought of'\)"):
        asyncio.run(SerialOpener("/dev/imu", 9600, "none").open())


async def test_one_warning_a_loss_and_word_when_it_is_back(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG, logger="companion.links.system.connection")
    with plugged(path) as pty:
        async with running(path) as port:
            await port.state(connected=True)
            pty.unplug()
            assert "gone" in await port.state(connected=False)
            assert "no such device" in await port.state(connected=False)
            with plugged(path) as again:
                await port.state(connected=True)
                again.unplug()
                await port.state(connected=False)
    told = [(record.levelname, record.getMessage()) for record in caplog.records]
    assert told[0] == ("INFO", f"compass: {path} is open")
    assert told[1] == ("WARNING", f"compass: {path}: the device is gone; unplugged?")
    assert {level for level, _ in told[2:-2]} == {"DEBUG"}
    assert told[-2] == ("INFO", f"compass: {path} is open again")
    assert told[-1] == told[1], "a new loss is news again"


# Writing --------------------------------------------------------------------------------------------------------------


async def test_writing(path: Path) -> None:
    async with running(path) as port:
        assert not port.link.write(b"nobody there")
        with plugged(path) as pty:
            await port.state(connected=True)
            assert port.link.write(b"*Q\r\n")
            assert await asyncio.to_thread(os.read, pty.master, 100) == b"*Q\r\n"


async def test_what_the_device_does_not_take_waits_up_to_a_bound_and_is_never_sent_in_part(path: Path) -> None:
    block = bytes(range(32, 96)) * 8
    with plugged(path) as pty:
        async with running(path) as port:
            await port.state(connected=True)
            taken = 0
            while port.link.write(block):
                taken += 1
                assert taken < 1000
            assert taken * len(block) > OUT_BUFFER_BYTES - len(block)
            assert len(port.link._out) <= OUT_BUFFER_BYTES
            assert not port.link.write(block)
            received = b""
            while len(received) < taken * len(block):
                received += await asyncio.to_thread(os.read, pty.master, 65536)
            assert received == block * taken
            assert port.link.write(b"room again")


# TCP ------------------------------------------------------------------------------------------------------------------


@contextmanager
def server() -> Iterator[tuple[socket.socket, str]]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.setblocking(False)
        yield listening, f"tcp://127.0.0.1:{listening.getsockname()[1]}"


async def accept(listening: socket.socket) -> socket.socket:
    peer, _ = await asyncio.wait_for(asyncio.get_running_loop().sock_accept(listening), 40)
    return peer


def reset(peer: socket.socket) -> None:
    peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    peer.close()


@pytest.mark.parametrize("ending", ["close", "half-close", "reset"])
async def test_a_socket_serves_like_a_port_and_comes_back(ending: str) -> None:
    before = open_descriptors()
    with server() as (listening, url):
        async with running(url) as port:
            peer = await accept(listening)
            await port.state(connected=True)
            peer.sendall(b"one")
            assert await port.data(3) == b"one"
            assert port.link.write(b"hello")
            assert await asyncio.get_running_loop().sock_recv(peer, 10) == b"hello"
            if ending == "close":
                peer.close()
            elif ending == "half-close":
                peer.shutdown(socket.SHUT_WR)
            else:
                reset(peer)
            reason = await port.state(connected=False)
            assert ("reset" if ending == "reset" else "the other side closed the connection") in reason
            with peer, await accept(listening) as again:
                await port.state(connected=True)
                again.sendall(b"two")
                assert await port.data(3) == b"two"
                assert port.link.reconnects == 1
    assert open_descriptors() == before


async def test_a_peer_that_vanishes_without_a_word_is_probed() -> None:
    """No packet is lost on loopback, so what is checked is that the kernel will ask: 5 s idle, then 3 times in 6 s."""
    with server() as (listening, url):
        async with running(url) as port:
            with await accept(listening):
                await port.state(connected=True)
                assert port.link._descriptor is not None
                with socket.socket(fileno=os.dup(port.link._descriptor)) as ours:
                    assert ours.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE) == 1
                    assert ours.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE) == 5
                    assert ours.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPCNT) == 3


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("tcp://127.0.0.1:99999", "PORT from 1 to 65535"),
        ("tcp://127.0.0.1:0", "PORT from 1 to 65535"),
        ("tcp://127.0.0.1", "allowed: tcp://HOST:PORT"),
        ("tcp://:80", "allowed: tcp://HOST:PORT"),
        ("tcp://[::1:80", "allowed: tcp://HOST:PORT"),
        ("tcp://" + "a" * 80 + ".invalid:80", "no connection: unknown host "),
    ],
)
async def test_an_address_that_cannot_be_is_reported_and_does_not_end_the_link(url: str, message: str) -> None:
    async with running(url) as port:
        assert message in await port.state(connected=False)


# Settings -------------------------------------------------------------------------------------------------------------


def test_explanations_name_the_mode_of_a_device() -> None:
    """Texts without root: an existing file, and a made-up refusal."""
    said = serial_port.explain("/dev/null", 9600, PermissionError(13, "Permission denied"))
    mode = stat.S_IMODE(os.stat("/dev/null").st_mode)
    assert said.startswith("/dev/null: permission denied; user ")
    assert said.endswith(f"mode {mode:04o})")


def test_what_the_units_device_control_forbids_is_not_taken_for_a_missing_group() -> None:
    said = serial_port.explain("/dev/null", 9600, PermissionError(1, "Operation not permitted"))
    assert said.startswith("/dev/null: permission denied; the service's unit does not allow this kind of port")
