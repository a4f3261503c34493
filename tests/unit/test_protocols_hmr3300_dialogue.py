"""What is said to an HMR3300: against the simulated device, whose `*S` toggles like the real one's."""

from __future__ import annotations

import pytest

from companion.protocols.compasses.hmr3300 import Hmr3300Decoder, Hmr3300Dialogue
from sim.aircraft import Pose, VirtualAircraft
from sim.devices import HMR3300
from sim.scenario import site_at

STEP_S = 0.02


class Line:
    """A device, the decoder and the dialogue on one line, 20 ms at a time."""

    def __init__(self) -> None:
        self.device = HMR3300(VirtualAircraft(Pose(0.0, 0.0, 0.0), site_at(40.0, 116.0, 50.0)))
        self.device.power_on(0.0)
        self.decoder, self.dialogue = Hmr3300Decoder(), Hmr3300Dialogue()
        self.sent: list[bytes] = []
        self.now_s = 0.0
        self.broken = False
        self.deaf = False
        self.dialogue.opened(0.0)
        self.decoder.interrupted()

    def run(self, seconds: float) -> int:
        """Samples that came."""
        samples = 0
        answer = b""
        for _ in range(round(seconds / STEP_S)):
            self.now_s += STEP_S
            data = answer + b"".join(frame.data for frame in self.device.frames_until(self.now_s))
            answer = b""
            if data and not self.broken:
                found = len(self.decoder.feed(data, self.now_s))
                samples += found
                self.dialogue.heard(data, found, self.now_s)
            if said := self.dialogue.due(self.now_s):
                self.sent.append(said)
                if not self.deaf:
                    answer = self.device.command(said, self.now_s)
        return samples


def test_to_a_device_that_streams_nothing_is_said() -> None:
    line = Line()
    assert line.run(60.0) >= 475
    assert line.sent == []
    assert line.dialogue.words == ""


def test_a_stopped_device_is_started_and_then_left_alone() -> None:
    line = Line()
    line.device.streaming = False
    line.run(3.0)
    assert line.sent == [b"*Q\r\n", b"*S\r\n"]
    assert "started" in line.dialogue.words
    assert line.run(60.0) >= 470
    assert len(line.sent) == 2


def test_a_device_behind_a_bad_contact_is_never_stopped() -> None:
    """It streams all the time, only nothing of it arrives: a blind `*S` would stop it."""
    line = Line()
    for _ in range(20):
        line.broken = True
        line.run(2.9)
        line.broken = False
        line.run(0.35)
    assert line.device.streaming
    assert line.sent
    assert set(line.sent) == {b"*Q\r\n"}


@pytest.mark.parametrize("after_s", [0.02 * n for n in range(1, 60, 3)])
def test_a_stream_that_comes_back_while_it_is_asked_is_never_stopped(after_s: float) -> None:
    line = Line()
    line.broken = True
    line.run(2.0)
    while not line.sent:
        line.run(STEP_S)
    line.run(after_s)
    line.broken = False
    line.run(30.0)
    assert line.device.streaming
    assert b"*S\r\n" not in line.sent


def test_a_device_without_power_is_asked_seldom() -> None:
    line = Line()
    line.broken = line.deaf = True
    line.run(600.0)
    assert 50 < len(line.sent) <= 110
    assert set(line.sent) == {b"*Q\r\n"}


@pytest.mark.parametrize(
    "answer", [b"#I\r\n", b"HMR3300 V1.00\r\n", b"\xff\x00\x81\r\n", b"123.4, 1.0, 2.0\r\n123.4, 1.0, 2.0\r\n", b"12"]
)
def test_what_is_not_exactly_one_line_starts_nothing(answer: bytes) -> None:
    dialogue = Hmr3300Dialogue()
    dialogue.opened(0.0)
    assert dialogue.due(2.5) == b"*Q\r\n"
    dialogue.heard(answer, 0, 2.6)
    assert [dialogue.due(2.6 + 0.02 * n) for n in range(1, 200)] == [b""] * 199


def test_a_line_that_comes_in_pieces_is_one_line() -> None:
    dialogue = Hmr3300Dialogue()
    dialogue.opened(0.0)
    assert dialogue.due(2.5) == b"*Q\r\n"
    for n, piece in enumerate((b"12", b"3.4, 1.0, ", b"-2.0\r", b"\n")):
        dialogue.heard(piece, 0, 2.6 + 0.01 * n)
        assert dialogue.due(2.6 + 0.01 * n) == b""
    assert b"".join(dialogue.due(2.7 + 0.02 * n) for n in range(50)) == b"*S\r\n"
