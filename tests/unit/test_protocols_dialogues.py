"""What is said to silent devices, with simulated ones that answer as the manuals say; and what is never said."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest

from companion.protocols.compasses.nmea import Hmr3000Dialogue, NmeaDecoder
from companion.protocols.decoding.base import Decoder
from companion.protocols.decoding.dialogue import AGAIN_S, ANSWER_S, PATIENCE, SILENT_S, Dialogue
from companion.protocols.inclinometers.inclinometer_xy import InclinometerXyDecoder, InclinometerXyDialogue
from companion.protocols.inclinometers.jewell import JewellDecoder, JewellDialogue
from sim.aircraft import Pose, VirtualAircraft
from sim.compasses import NmeaCompass
from sim.devices import Gradienter, SerialDevice
from sim.gradienters import BeiInclinometer, Jewell

AIRCRAFT = VirtualAircraft(Pose(pitch_deg=5.0, roll_deg=-3.0, heading_deg=40.0))
STEP_S = 0.02
DELAY_S = 0.03


class Conversation:
    """A device, a decoder and a dialogue on one line; every byte takes its time and `DELAY_S` more."""

    def __init__(self, device: SerialDevice | None, decoder: Decoder, dialogue: Dialogue) -> None:
        self.device, self.decoder, self.dialogue = device, decoder, dialogue
        self.now_s = 0.0
        self.said: list[tuple[float, bytes]] = []
        self.samples = 0
        self.arriving: list[tuple[float, bytes]] = []
        dialogue.opened(0.0)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.now_s += STEP_S
            if self.device is not None:
                self.arriving += [(frame.complete_s, frame.data) for frame in self.device.frames_until(self.now_s)]
            self.arriving.sort(key=lambda item: item[0])
            while self.arriving and self.arriving[0][0] <= self.now_s:
                self.hear(self.arriving.pop(0)[1])
            question = self.dialogue.due(self.now_s)
            if question:
                self.said.append((self.now_s, question))
                if self.device is not None:
                    answer = self.device.command(question, self.now_s)
                    if answer:
                        self.arriving.append((self.now_s + self.device.line_time_s(len(answer)) + DELAY_S, answer))

    def hear(self, data: bytes) -> None:
        got = len(self.decoder.feed(data, self.now_s))
        self.samples += got
        self.dialogue.heard(data, got, self.now_s)

    @property
    def words(self) -> list[bytes]:
        return [question for _, question in self.said]


TALKING: list[Callable[[], Conversation]] = [
    lambda: Conversation(Gradienter(AIRCRAFT), InclinometerXyDecoder(), InclinometerXyDialogue()),
    lambda: Conversation(BeiInclinometer(AIRCRAFT), InclinometerXyDecoder(), InclinometerXyDialogue()),
    lambda: Conversation(NmeaCompass(AIRCRAFT), NmeaDecoder(), Hmr3000Dialogue()),
    lambda: Conversation(NmeaCompass(AIRCRAFT, sentences=("HDT",), rate_hz=1.0), NmeaDecoder(), Hmr3000Dialogue()),
    lambda: Conversation(Jewell(AIRCRAFT, rate_hz=1.0), JewellDecoder(), JewellDialogue()),
]


@pytest.mark.parametrize("make", TALKING)
def test_nothing_is_said_to_a_device_that_speaks_by_itself(make: Callable[[], Conversation]) -> None:
    line = make()
    line.run(30.0)
    assert line.said == []
    assert line.dialogue.words == ""
    assert line.samples >= 29


def test_nothing_is_said_to_a_device_of_which_only_rubbish_comes() -> None:
    """A wrong baud rate: it speaks, and is not to be told anything at that rate."""
    for dialogue in (InclinometerXyDialogue(), Hmr3000Dialogue(), JewellDialogue()):
        dialogue.opened(0.0)
        for step in range(2000):
            dialogue.heard(b"\xf0\x1c\x80", 0, step * 0.05)
            assert dialogue.due(step * 0.05) == b""


def test_a_stopped_meas_is_started_after_it_has_shown_that_it_is_stopped() -> None:
    device = Gradienter(AIRCRAFT)
    line = Conversation(device, InclinometerXyDecoder(), InclinometerXyDialogue())
    device.command(b"s", 0.0)
    line.run(6.0)
    assert line.words == [b"*", b"R", b"S"]
    assert line.said[0][0] >= SILENT_S
    assert device.streaming
    assert line.samples > 15
    assert line.dialogue.words == "it was stopped: stream started with S"
    device.command(b"s", line.now_s)  # by another hand
    line.run(6.0)
    assert line.words == [b"*", b"R", b"S"] * 2


def test_a_polled_bei_is_started_with_its_own_letter_and_stores_nothing() -> None:
    device = BeiInclinometer(AIRCRAFT, polled=True)
    line = Conversation(device, InclinometerXyDecoder(), InclinometerXyDialogue())
    line.hear(device.power_on(0.0))
    line.run(6.0)
    assert line.words == [b"*", b"F"]
    assert line.samples > 15
    assert device.stored == 0


def test_a_bei_in_its_setup_level_is_not_told_anything() -> None:
    """There "F" would be written to its EEPROM."""
    device = BeiInclinometer(AIRCRAFT)
    device.command(b"fprog", 0.0)
    assert device.setup
    line = Conversation(device, InclinometerXyDecoder(), InclinometerXyDialogue())
    line.run(300.0)
    assert set(line.words) == {b"*"}
    assert len(line.said) <= 6
    assert device.stored == 0
    assert line.dialogue.words == "it is in its setup level: switch it off and on"


def test_a_gradienter_that_streams_again_after_the_question_is_left_alone() -> None:
    """Its answer to R would be followed by more readings: it was not stopped after all."""
    device = Gradienter(AIRCRAFT)
    line = Conversation(device, InclinometerXyDecoder(), InclinometerXyDialogue())
    device.command(b"s", 0.0)
    while not line.said:
        line.run(STEP_S)
    device.command(b"S", line.now_s)
    line.run(20.0)
    assert line.words == [b"*"]


def test_an_hmr3000_without_sentences_is_polled() -> None:
    line = Conversation(NmeaCompass(AIRCRAFT, sentences=()), NmeaDecoder(), Hmr3000Dialogue())
    line.run(12.0)
    assert set(line.words) == {b"$PTNT,HPR*78\r\n"}
    assert line.said[0][0] >= SILENT_S
    assert line.samples == pytest.approx(10.0 / Hmr3000Dialogue.PERIOD_S, rel=0.25)
    assert line.samples >= len(line.said) - 1
    assert line.dialogue.words == "asked 10 times a second with $PTNT,HPR*78"


def test_polling_ends_when_the_device_begins_to_speak() -> None:
    device = NmeaCompass(AIRCRAFT, sentences=())
    line = Conversation(device, NmeaDecoder(), Hmr3000Dialogue())
    line.run(5.0)
    device.sentences = ("HPR",)
    line.run(2.0)
    asked = len(line.said)
    line.run(20.0)
    assert len(line.said) == asked


@pytest.mark.parametrize("output", ["SIM", "XDR", "ASH"])
def test_a_silent_jewell_is_polled_in_whichever_format_and_stores_nothing(output: str) -> None:
    device = Jewell(AIRCRAFT, output=output, continuous=False)  # type: ignore[arg-type]
    device.power_on(0.0)
    line = Conversation(device, JewellDecoder(), JewellDialogue())
    line.run(12.0)
    assert set(line.words) == {b"*9900XY\r\n"}
    assert line.samples == pytest.approx(50, abs=8)
    assert not line.decoder.rejected
    assert device.stored == 0


@pytest.mark.parametrize("dialogue", [Hmr3000Dialogue, JewellDialogue])
def test_nobody_there_is_asked_ever_more_seldom(dialogue: type[Dialogue]) -> None:
    line = Conversation(None, NmeaDecoder(), dialogue())
    line.run(120.0)
    times = [t_s for t_s, _ in line.said]
    gaps = [after - before for before, after in itertools.pairwise(times)]
    assert gaps[:PATIENCE] == pytest.approx([ANSWER_S] * PATIENCE, abs=0.03)
    assert gaps[PATIENCE:] == pytest.approx([AGAIN_S] * len(gaps[PATIENCE:]), abs=0.03)
    assert line.dialogue.words.endswith("no answer yet")
    line.dialogue.opened(line.now_s)
    asked = len(line.said)
    line.run(SILENT_S - 0.1)
    assert len(line.said) == asked


def test_a_gradienter_that_is_not_there_is_asked_seldom() -> None:
    line = Conversation(None, InclinometerXyDecoder(), InclinometerXyDialogue())
    line.run(120.0)
    assert set(line.words) == {b"*", b"R"}
    assert 20 <= len(line.said) <= 50
