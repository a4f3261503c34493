"""One device on one port: its roles, and what is said to it."""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import os
import subprocess
import sys
import tty
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import parse
from companion.config.sections import Config
from companion.configured.models import Role, SerialDevice, serial_devices
from companion.daemon.devices import sensors
from companion.daemon.devices.sensors import SerialSensor
from companion.links.serial.bytestream import ByteLink
from companion.protocols.decoding.dialogue import Dialogue
from companion.protocols.registry import PROTOCOLS, ProtocolInfo
from companion.samples import CompassSample, Sample, TiltSample
from tests.support.frames import sentence
from tests.support.virtual_time import run_virtual

LINES = b"40.1, 5.0, -3.0\r\n40.2, 5.1, -3.1\r\n"


class Talker(Dialogue):
    """Notes what it is told, and says what it is given to say."""

    def __init__(self) -> None:
        self.told: list[tuple[Any, ...]] = []
        self.asked: list[float] = []
        self.to_say: Iterator[bytes] = iter(())
        super().__init__()

    def opened(self, t_s: float) -> None:
        self.told.append(("opened",))

    def heard(self, data: bytes, samples: int, t_s: float) -> None:
        self.told.append(("heard", data, samples))

    def due(self, t_s: float) -> bytes:
        self.asked.append(t_s)
        data = next(self.to_say, b"")
        if data:
            self.words = f"said {data.decode()}"
        return data


class Chatterbox(Talker):
    """Has always something to say."""

    def due(self, t_s: float) -> bytes:
        super().due(t_s)
        return b"!"


class OpenPort(ByteLink):
    """A port that is open, and notes what is sent."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        self.sent: list[bytes] = []

    @property
    def connected(self) -> bool:
        return True

    def write(self, data: bytes) -> bool:
        self.sent.append(data)
        return True

    async def run(self) -> None:
        await asyncio.Event().wait()


def device(
    *roles: Role, dialogue: type[Dialogue] | None = None, port: str = "tcp://nowhere:1", **changes: Any
) -> SerialDevice:
    info = dataclasses.replace(PROTOCOLS["compass"]["hmr3300"], dialogue=dialogue)
    return SerialDevice(port, info, 19200, "none", roles=roles, **{"read_only": False, **changes})


BOTH = (Role("gradienter", "gradienter"), Role("compass", "compass"))


def opened(which: SerialDevice) -> tuple[SerialSensor, OpenPort, list[tuple[str, Sample]]]:
    """A sensor on a port that has just been opened."""
    taken: list[tuple[str, Sample]] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sensors, "ByteLink", OpenPort)
        sensor = SerialSensor(which, lambda role, part: taken.append((role.name, part)))
    port = sensor.link
    assert isinstance(port, OpenPort)
    sensor._on_state(True, "open")
    return sensor, port, taken


# --- roles


async def test_a_device_is_decoded_once_and_every_role_takes_what_it_needs() -> None:
    sensor, _, taken = opened(device(*BOTH))
    sensor.receive(b"\r\n" + LINES, 1.0)
    assert [name for name, _ in taken] == ["gradienter", "compass"] * 2
    (tilt, heading) = (part for _, part in taken[:2])
    assert isinstance(tilt, TiltSample)
    assert isinstance(heading, CompassSample)
    assert (tilt.x_deg, tilt.y_deg, heading.heading_deg) == (-3.0, 5.0, 40.1)
    assert tilt.t_s == heading.t_s
    assert sensor.decoder.accepted == 2


async def test_headings_to_another_north_than_the_configured_one_are_refused_in_words() -> None:
    info = PROTOCOLS["compass"]["nmea"]
    role = Role("compass", "compass", "magnetic")
    sensor, _, taken = opened(SerialDevice("/nowhere", info, 19200, "none", read_only=True, roles=(role,)))
    now_s = asyncio.get_running_loop().time
    sensor.receive(sentence("HEHDT,86.2,T"), now_s())
    assert taken == []
    status = sensor.roles[0].status()
    assert not status["good"]
    assert 'its headings are true; set compass.reference = "true"' in str(status["summary"])
    sensor.receive(sentence("HEHDM,92.0,M") + sentence("PTNTHPR,92.0,N,1.0,N,2.0,N"), now_s())
    assert [part.heading_deg for _, part in taken if isinstance(part, CompassSample)] == [92.0, 92.0]
    assert sensor.roles[0].status()["good"]


def config(text: str) -> Config:
    return parse('[mavlink]\nurl = "tcp:h:1"\n[[imu]]\nname = "fc"\nsource = "autopilot"\n' + text, "test")


GRADIENTER = '[gradienter]\nport = "/dev/a"\nprotocol = "hmr3300"\nlaw = "euler"\n'
COMPASS = '[compass]\nport = "/dev/a"\nprotocol = "hmr3300"\n'


def test_what_one_section_leaves_open_the_other_says() -> None:
    (one,) = serial_devices(config(GRADIENTER + COMPASS + 'baud = 9600\nparity = "odd"\nread_only = true\n'))
    assert (one.name, one.baud, one.parity, one.read_only) == ("gradienter", 9600, "odd", True)
    assert [role.kind for role in one.roles] == ["gradienter", "compass"]
    (one,) = serial_devices(config(GRADIENTER + COMPASS))
    assert (one.baud, one.parity, one.read_only) == (19200, "none", False)
    two = serial_devices(config(GRADIENTER + COMPASS.replace("/dev/a", "/dev/b")))
    assert [each.name for each in two] == ["gradienter", "compass"]


# --- what is said


async def test_not_even_a_talkative_dialogue_floods_a_device_or_the_log(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    sensor, port, _ = opened(device(*BOTH, dialogue=Chatterbox))
    assert isinstance(sensor.dialogue, Talker)
    sensor.dialogue.words = "said something"
    running = asyncio.create_task(sensor.run())
    await asyncio.sleep(0.3)
    before = len(port.sent)
    for _ in range(1000):
        await asyncio.sleep(0.001)
        sensor.receive(b"4", asyncio.get_running_loop().time())
    assert 20 <= len(port.sent) - before <= 51
    running.cancel()
    assert [record.message for record in caplog.records].count("gradienter, compass: said something") == 1


TALKATIVE: dict[str, ProtocolInfo] = {
    "chatterbox": dataclasses.replace(PROTOCOLS["compass"]["hmr3300"], dialogue=Chatterbox),
    **{info.name: info for infos in PROTOCOLS.values() for info in infos.values() if info.dialogue is not None},
}
EVENTS = st.lists(
    st.one_of(
        st.floats(0.0, 8.0).map(lambda seconds: ("wait", seconds)),
        st.binary(max_size=40).map(lambda data: ("read", data)),
        st.sampled_from([LINES, b"#I\r\n", b"X=+00.430\r\nY=-00.084\r\n"]).map(lambda data: ("read", data)),
        st.just(("reopen", None)),
    ),
    max_size=12,
)


@pytest.mark.parametrize("info", TALKATIVE.values(), ids=list(TALKATIVE))
@given(events=EVENTS)
@settings(max_examples=40)
def test_with_read_only_not_one_byte_leaves(info: ProtocolInfo, events: list[tuple[str, Any]]) -> None:
    async def main(*, read_only: bool) -> int:
        sensor, port, _ = opened(dataclasses.replace(device(*BOTH, read_only=read_only), info=info))
        running = asyncio.create_task(sensor.run())
        for what, value in [*events, ("wait", 3.0)]:
            if what == "wait":
                await asyncio.sleep(value)
            elif what == "read":
                sensor.receive(value, asyncio.get_running_loop().time())
            else:
                sensor._on_state(True, "open")
        running.cancel()
        return len(b"".join(port.sent))

    assert run_virtual(main(read_only=True)) == 0
    if info.dialogue is Chatterbox:
        assert run_virtual(main(read_only=False)) > 0


# --- on a real pseudo-terminal


def pty_pair() -> tuple[int, str]:
    master, slave = os.openpty()
    tty.setraw(slave)
    path = os.ttyname(slave)
    os.set_blocking(master, False)
    os.close(slave)
    return master, path


def arrived(master: int) -> bytes:
    try:
        return os.read(master, 4096)
    except (BlockingIOError, OSError):
        return b""


async def until(condition: Callable[[], bool], within_s: float = 8.0) -> None:
    async with asyncio.timeout(within_s):
        while not condition():
            await asyncio.sleep(0.01)


@pytest.mark.real_clock
def test_while_another_program_has_the_port_open_nothing_is_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sensors, "HELD_AGAIN_S", 0.05)

    master, path = pty_pair()
    slave = os.open(path, os.O_RDWR | os.O_NOCTTY)
    other = subprocess.Popen(
        [sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE, pass_fds=[slave]
    )
    os.close(slave)

    async def main() -> None:
        sensor = SerialSensor(device(*BOTH, dialogue=Chatterbox, port=path), lambda role, part: None)
        running = asyncio.create_task(sensor.run())
        try:
            await until(lambda: "in use by another program" in sensor.text)
            assert str(other.pid) in sensor.text
            await asyncio.sleep(0.6)  # more than two looks: time enough for a byte that must not come
            assert arrived(master) == b""
            other.communicate()
            await until(lambda: arrived(master) != b"")
            assert sensor.text == ""
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)

    try:
        asyncio.run(main())
    finally:
        other.kill()
        other.wait()
        os.close(master)
