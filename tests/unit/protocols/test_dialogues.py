"""What is said to silent devices, with simulated ones that answer as the manuals say; and what is never said."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest

from companion.protocols.compasses.hmr3300 import Hmr3300Decoder, Hmr3300Dialogue
from companion.protocols.compasses.nmea import Hmr3000Dialogue, NmeaDecoder
from companion.protocols.decoding.base import Decoder
from companion.protocols.decoding.dialogue import AGAIN_S, ANSWER_S, PATIENCE, SILENT_S, Dialogue
from companion.protocols.inclinometers.inclinometer_xy import InclinometerXyDecoder, InclinometerXyDialogue
from companion.protocols.inclinometers.jewell import JewellDecoder, JewellDialogue
from sim.aircraft import Pose, VirtualAircraft
from sim.compasses import NmeaCompass
from sim.devices import HMR3300, Gradienter, SerialDevice
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
    lambda: Conversation(HMR3300(AIRCRAFT), Hmr3300Decoder(), Hmr3300Dialogue()),
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
    for dialogue in (InclinometerXyDialogue(), Hmr3300Dialogue(), Hmr3000Dialogue(), JewellDialogue()):
        dialogue.opened(0.0)
        for step in range(2000):
            dialogue.heard(b"\xf0\x1c\x80", 0, step * 0.05)
            assert dialogue.due(step * 0.05) == b""


@pytest.mark.parametrize("make", [Gradienter, BeiInclinometer])
def test_a_stopped_gradienter_is_polled_and_left_alone_when_it_streams_again(make: type[Gradienter]) -> None:
    device = make(AIRCRAFT)
    line = Conversation(device, InclinometerXyDecoder(), InclinometerXyDialogue())
    device.command(b"s" if make is Gradienter else b"f", 0.0)
    line.run(12.0)
    assert set(line.words) == {b"R"}
    assert line.said[0][0] >= SILENT_S
    assert not device.streaming
    assert line.samples == pytest.approx(10.0 / InclinometerXyDialogue().period_s, rel=0.25)
    assert line.dialogue.words == "asked 5 times a second with R"
    device.command(b"S" if make is Gradienter else b"F", line.now_s)  # by another hand
    line.run(2.0)
    asked = len(line.said)
    line.run(20.0)
    assert len(line.said) == asked


def test_nothing_is_stored_in_a_bei_in_its_setup_level() -> None:
    """There "F" would be written to its EEPROM."""
    device = BeiInclinometer(AIRCRAFT, polled=True)
    device.command(b"fprog", 0.0)
    stored = device.stored
    line = Conversation(device, InclinometerXyDecoder(), InclinometerXyDialogue())
    line.run(60.0)
    assert device.setup
    assert device.stored == stored


def test_a_stopped_hmr3300_is_polled() -> None:
    device = HMR3300(AIRCRAFT)
    device.power_on(0.0)
    device.streaming = False
    line = Conversation(device, Hmr3300Decoder(), Hmr3300Dialogue())
    line.run(12.0)
    assert set(line.words) == {b"*Q\r\n"}
    assert line.samples == pytest.approx(10.0 / Hmr3300Dialogue().period_s, rel=0.35)
    assert not device.streaming


def test_an_hmr3300_behind_a_bad_contact_is_never_stopped() -> None:
    """It streams all the time, only nothing of it arrives: `*S` would stop it."""
    device = HMR3300(AIRCRAFT)
    device.power_on(0.0)
    dialogue = Hmr3300Dialogue()
    dialogue.opened(0.0)
    said = b"".join(dialogue.due(0.02 * n) for n in range(3000))
    assert device.command(said, 60.0) == b""
    assert device.streaming
    assert 10 <= said.count(b"*Q") <= 20


def test_an_hmr3000_without_sentences_is_polled() -> None:
    line = Conversation(NmeaCompass(AIRCRAFT, sentences=()), NmeaDecoder(), Hmr3000Dialogue())
    line.run(12.0)
    assert set(line.words) == {b"$PTNT,HPR*78\r\n"}
    assert line.said[0][0] >= SILENT_S
    assert line.samples == pytest.approx(10.0 / Hmr3000Dialogue().period_s, rel=0.25)
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


@pytest.mark.parametrize("dialogue", [Hmr3000Dialogue, JewellDialogue, InclinometerXyDialogue])
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
