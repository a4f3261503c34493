"""Requests to silent IMUs, understood by simulated ones."""

from __future__ import annotations

import itertools

import pytest

from companion.protocols.decoding.dialogue import LONGEST_PAUSE_S, SILENT_S, WakeDialogue
from companion.protocols.imus.mip import MipDialogue
from companion.protocols.imus.vectornav import VectorNavDialogue
from companion.protocols.imus.xsens import XsensDialogue
from companion.protocols.registry import PROTOCOLS
from sim.aircraft import VirtualAircraft
from sim.devices import SerialDevice
from sim.imu_model import ImuModel
from sim.scenario import IMUS
from tests.support.frames import sentence

RESUME, MEASURE = bytes.fromhex("756501020206E5CB"), bytes.fromhex("FAFF1000F1")
TO_IDLE, TO_CONFIG = bytes.fromhex("756501020202E1C7"), bytes.fromhex("FAFF3000D1")
ALL = [MipDialogue, VectorNavDialogue, XsensDialogue]


def asked(dialogue: WakeDialogue, from_s: float, to_s: float) -> list[tuple[float, bytes]]:
    """Requests, polled every 20 ms."""
    times = [from_s + 0.02 * step for step in range(round((to_s - from_s) / 0.02) + 1)]
    return [(t_s, said) for t_s in times if (said := dialogue.due(t_s))]


@pytest.mark.parametrize("kind", ALL)
def test_nothing_is_said_before_a_port_is_open_nor_while_a_device_speaks(kind: type[WakeDialogue]) -> None:
    dialogue = kind()
    assert asked(dialogue, 0.0, 20.0) == []
    dialogue.opened(20.0)
    for step in range(400):
        dialogue.heard(b"x", step % 2, 20.0 + 0.1 * step)
        assert dialogue.due(20.0 + 0.1 * step) == b""
    assert dialogue.words == ""


@pytest.mark.parametrize(("kind", "saying"), [(MipDialogue, RESUME), (XsensDialogue, MEASURE)])
def test_a_silent_device_is_asked_ever_less_often(kind: type[WakeDialogue], saying: bytes) -> None:
    dialogue = kind()
    dialogue.opened(10.0)
    said = asked(dialogue, 10.0, 335.0)
    assert {data for _, data in said} == {saying}
    times = [10.0, *(t_s for t_s, _ in said)]
    pauses = [later - sooner for sooner, later in itertools.pairwise(times)]
    assert pauses == pytest.approx([2.0, 4.0, 8.0, 16.0, 32.0, 64.0, 64.0, 64.0, 64.0], abs=0.05)
    assert pauses[0] >= SILENT_S - 0.02
    assert max(pauses) <= LONGEST_PAUSE_S + 0.05
    assert dialogue.words
    dialogue.heard(b"frames", 1, 500.0)
    assert [t_s for t_s, _ in asked(dialogue, 500.0, 503.0)] == pytest.approx([502.0], abs=0.05)
    dialogue.opened(600.0)
    assert dialogue.words == ""


def test_vectornav_is_first_resumed_then_given_its_factory_output_and_never_stores() -> None:
    dialogue = VectorNavDialogue()
    dialogue.opened(0.0)
    said = asked(dialogue, 0.0, 6.5)
    assert [data for _, data in said[:2]] == [sentence("VNASY,1"), sentence("VNWRG,06,14")]
    assert not any(b"VNWNV" in data for data, _ in VectorNavDialogue.SAYINGS)


@pytest.mark.parametrize(
    ("name", "stop", "acknowledged"),
    [("mip", TO_IDLE, "7565010404F10600"), ("xsens", TO_CONFIG, "FAFF1100F0")],
)
def test_a_stopped_device_streams_again(name: str, stop: bytes, acknowledged: str) -> None:
    device: SerialDevice = IMUS[name](ImuModel(VirtualAircraft(), "adis16470", seed=1))
    dialogue_type = PROTOCOLS["imu"][name].dialogue
    assert dialogue_type is not None
    dialogue = dialogue_type()
    device.power_on(0.0)
    assert device.frames_until(0.5)
    assert device.command(stop, 0.5)
    assert device.frames_until(3.0) == []
    dialogue.opened(0.5)
    said = dialogue.due(3.0)
    assert device.command(said[:3], 3.0) + device.command(said[3:], 3.0) != b""
    assert device.frames_until(3.5)
    assert device.command(said, 3.5).hex().upper().startswith(acknowledged)
