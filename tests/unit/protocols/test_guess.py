"""Recognition of devices: bytes of every simulated one are recognised, and nothing else is."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from companion.protocols.guess import (
    COMMON_BAUDS,
    Line,
    candidates,
    likeliest,
    lines_to_try,
    plain_share,
    strangers,
)
from companion.protocols.registry import PROTOCOLS
from sim.pty_device import Setting, heard
from sim.scenario import demo
from tests.support.chatter import compass_frame, imu_frame, tilt_frame


def vectornav(_: int) -> bytes:
    device = demo(seed=3).imu
    device.power_on(0.0)
    return b"".join(frame.data for frame in device.frames_until(0.2))


SPEAKERS: dict[str, tuple[Callable[[int], bytes], str]] = {
    "inclinometer_xy": (tilt_frame, "gradienter"),
    "hmr3300": (compass_frame, "compass"),
    "imu_line": (imu_frame, "imu"),
    "vectornav": (vectornav, "imu"),
}


def stream(name: str, frames: int = 12) -> bytes:
    return b"".join(SPEAKERS[name][0](number) for number in range(frames))


@pytest.mark.parametrize("name", SPEAKERS)
@pytest.mark.parametrize("cut", [0, 3, 9, 17])
def test_each_is_recognised_wherever_one_begins_to_listen(name: str, cut: int) -> None:
    found = likeliest(stream(name)[cut:])
    assert found is not None
    assert found.protocol == name
    assert SPEAKERS[name][1] in found.kinds
    assert found.sure
    assert [one.protocol for one in candidates(stream(name)[cut:]) if one.likely] == [name]


def test_one_family_for_two_kinds_is_one_candidate() -> None:
    (found,) = candidates(stream("hmr3300"))
    assert found.kinds == ("compass", "gradienter")


@pytest.mark.parametrize("seed", range(8))
def test_noise_is_nobody(seed: int) -> None:
    assert likeliest(random.Random(seed).randbytes(4000)) is None


@pytest.mark.parametrize("name", ["inclinometer_xy", "hmr3300", "imu_line"])
@pytest.mark.parametrize("baud", [2400, 4800, 19200, 38400, 115200])
def test_at_another_speed_it_is_nobody_and_looks_like_what_it_is(name: str, baud: int) -> None:
    data = heard(stream(name, 20), Setting(9600), Setting(baud))
    assert likeliest(data) is None
    assert plain_share(data) < 0.9
    assert plain_share(stream(name)) >= 0.9


def test_one_frame_is_not_enough_and_damaged_ones_are_not_sure() -> None:
    assert likeliest(tilt_frame(1)) is None
    damaged = b"".join(tilt_frame(n) if n % 2 else tilt_frame(n)[:9] + b"\r\n" for n in range(8))
    found = likeliest(damaged)
    assert found is None or not found.sure


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"\r\nDebian GNU/Linux 12 aircraft ttyS0\r\n\r\naircraft login: ", "login console"),
        (b"[    3.141592] usb 1-1: new full-speed USB device\r\n", "login console"),
        (b"AT+GCAP\r", "ModemManager"),
        (b"\r\nATE0\r\n", "ModemManager"),
        (b"", None),
        (b"X=+00.430\r\nY=-00.084\r\n", None),
        (b"STATIC 12\r\n", None),
    ],
)
def test_strangers(data: bytes, words: str | None) -> None:
    found = strangers(data)
    assert (found is None) == (words is None)
    assert words is None or words in (found or "")


def test_an_autopilot_is_a_stranger_by_its_packets() -> None:
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

    for version in (b"\xfd", b"\xfe"):
        codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        beat = mavlink.MAVLink_heartbeat_message(2, 3, 81, 0, 3, 3)
        data = b"".join(bytes(beat.pack(codec, force_mavlink1=version == b"\xfe")) for _ in range(6))
        assert data[:1] == version
        assert "MAVLink" in (strangers(data[7:]) or "")
    assert strangers(random.Random(1).randbytes(3000)) is None


def test_what_was_believed_is_tried_first_then_what_devices_come_with_and_nothing_twice() -> None:
    lines = list(lines_to_try([Line(4800, "odd")]))
    assert lines[0] == Line(4800, "odd")
    defaults = {Line(info.baud, info.parity) for kind in PROTOCOLS.values() for info in kind.values()}
    assert set(lines[1 : 1 + len(defaults)]) == defaults
    assert len(lines) == len(set(lines))
    assert {line.baud for line in lines} >= set(COMMON_BAUDS)
    assert {line.parity for line in lines if line.baud == 9600} == {"none", "even", "odd"}
    assert str(Line(9600, "even")) == "9600 8E1"
