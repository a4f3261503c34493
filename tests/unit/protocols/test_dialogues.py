"""Requests to silent devices, with simulated ones that answer as in the manuals; forbidden requests."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest

from companion.protocols.compasses.hmr3300 import Hmr3300Decoder, Hmr3300Dialogue
from companion.protocols.compasses.nmea import Hmr3000Dialogue, NmeaDecoder
from companion.protocols.compasses.pni import PniDecoder, PniDialogue
from companion.protocols.decoding.base import Decoder
from companion.protocols.decoding.dialogue import AGAIN_S, ANSWER_S, PATIENCE, SILENT_S, PollDialogue
from companion.protocols.inclinometers.inclinometer_xy import InclinometerXyDecoder, InclinometerXyDialogue
from companion.protocols.inclinometers.jewell import JewellDecoder, JewellDialogue
from companion.protocols.inclinometers.rion import RionDecoder, RionDialogue
from companion.samples import CompassSample, MagSample, Sample
from sim.aircraft import Pose, VirtualAircraft
from sim.compasses import NmeaCompass, PniCompass, RionCompass
from sim.devices import HMR3300, Gradienter, SerialDevice
from sim.gradienters import BeiInclinometer, Jewell, RionInclinometer

AIRCRAFT = VirtualAircraft(Pose(pitch_deg=5.0, roll_deg=-3.0, heading_deg=40.0))
STEP_S = 0.02
DELAY_S = 0.03
READ = bytes.fromhex("6804000408")
GET_DATA = bytes.fromhex("000504BF71")


class Conversation:
    """A device, a decoder and a dialogue on one line; every byte takes its time and `DELAY_S` more."""

    def __init__(self, device: SerialDevice | None, decoder: Decoder, dialogue: PollDialogue) -> None:
        self.device, self.decoder, self.dialogue = device, decoder, dialogue
        self.unplugged = False
        self.now_s = 0.0
        self.said: list[tuple[float, bytes]] = []
        self.samples: list[Sample] = []
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
                if self.device is not None and not self.unplugged:
                    answer = self.device.command(question, self.now_s)
                    if answer:
                        self.arriving.append((self.now_s + self.device.line_time_s(len(answer)) + DELAY_S, answer))

    def hear(self, data: bytes) -> None:
        found = self.decoder.feed(data, self.now_s)
        self.samples += found
        self.dialogue.heard(data, len(found), self.now_s)

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
    assert len(line.samples) >= 29


def test_nothing_is_said_to_a_device_of_which_only_rubbish_comes() -> None:
    """A wrong baud rate: it speaks, and is not to be told anything at that rate."""
    for dialogue in (InclinometerXyDialogue(), Hmr3300Dialogue(), Hmr3000Dialogue(), JewellDialogue()):
        dialogue.opened(0.0)
        for step in range(2000):
            dialogue.heard(b"\xf0\x1c\x80", 0, step * 0.05)
            assert dialogue.due(step * 0.05) == b""


def stopped_hmr3300() -> HMR3300:
    device = HMR3300(AIRCRAFT)
    device.power_on(0.0)
    device.streaming = False
    return device


JEWELLS = [Jewell(AIRCRAFT, output=output, continuous=False) for output in ("SIM", "XDR", "ASH")]
SILENT: list[tuple[SerialDevice, Decoder, PollDialogue, bytes, str]] = [
    (stopped_hmr3300(), Hmr3300Decoder(), Hmr3300Dialogue(), b"*Q\r\n", "*Q"),
    (NmeaCompass(AIRCRAFT, sentences=()), NmeaDecoder(), Hmr3000Dialogue(), b"$PTNT,HPR*78\r\n", "$PTNT,HPR*78"),
    *((device, JewellDecoder(), JewellDialogue(), b"*9900XY\r\n", "*9900XY") for device in JEWELLS),
    (RionCompass(AIRCRAFT), RionDecoder(), RionDialogue(), READ, "68 04 00 04 08"),
    (RionInclinometer(AIRCRAFT), RionDecoder(), RionDialogue(), READ, "68 04 00 04 08"),
]


@pytest.mark.parametrize(("device", "decoder", "dialogue", "question", "name"), SILENT)
def test_a_silent_device_is_polled_with_one_question_that_stores_nothing(
    device: SerialDevice, decoder: Decoder, dialogue: PollDialogue, question: bytes, name: str
) -> None:
    line = Conversation(device, decoder, dialogue)
    line.run(12.0)
    assert set(line.words) == {question}
    assert line.said[0][0] >= SILENT_S
    assert len(line.samples) == pytest.approx(10.0 / dialogue.period_s, rel=0.25)
    assert len(line.samples) >= len(line.said) - 1
    assert not decoder.rejected
    assert getattr(device, "stored", 0) == 0
    assert dialogue.words == f"polled {1.0 / dialogue.period_s:.0f} times a second with {name}"


@pytest.mark.parametrize("make", [Gradienter, BeiInclinometer])
def test_a_stopped_gradienter_is_polled_and_left_alone_when_it_streams_again(make: type[Gradienter]) -> None:
    device = make(AIRCRAFT)
    line = Conversation(device, InclinometerXyDecoder(), InclinometerXyDialogue())
    device.command(b"s" if make is Gradienter else b"f", 0.0)
    line.run(12.0)
    assert set(line.words) == {b"R"}
    assert line.said[0][0] >= SILENT_S
    assert not device.streaming
    assert len(line.samples) == pytest.approx(10.0 / InclinometerXyDialogue().period_s, rel=0.25)
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
    Conversation(device, InclinometerXyDecoder(), InclinometerXyDialogue()).run(60.0)
    assert device.setup
    assert device.stored == stored


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


@pytest.mark.parametrize("dialogue", [Hmr3000Dialogue, JewellDialogue, InclinometerXyDialogue])
def test_nobody_there_is_asked_ever_more_seldom(dialogue: type[PollDialogue]) -> None:
    line = Conversation(None, NmeaDecoder(), dialogue())  # type: ignore[call-arg]
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


def test_a_pni_compass_is_told_what_to_answer_then_asked_and_told_again_after_a_power_cycle() -> None:
    device = PniCompass(AIRCRAFT, heading_noise_deg=0.0)
    device.power_on(0.0)
    line = Conversation(device, PniDecoder(), PniDialogue())
    line.run(12.0)
    assert line.words[0] == bytes.fromhex("000E03080518190809 1B1C1DB20E") + GET_DATA
    assert set(line.words[1:]) == {GET_DATA}
    compass, mag = line.samples[-2:]
    assert isinstance(compass, CompassSample)
    assert (compass.heading_deg, compass.pitch_deg, compass.roll_deg) == pytest.approx((40.0, 5.0, -3.0), abs=1e-3)
    assert isinstance(mag, MagSample)
    assert line.decoder.rejected.total() == 0
    line.unplugged = True
    line.run(4.0)
    device.power_on(line.now_s)
    line.unplugged = False
    before = len(line.samples)
    line.run(AGAIN_S + 1.5)
    assert device.components == (5, 24, 25, 8, 9, 27, 28, 29)
    assert len(line.samples) > before
    assert device.saves == 0


def test_its_own_echo_is_no_answer_and_no_speech() -> None:
    class Echoing(RionCompass):
        def command(self, data: bytes, t_s: float) -> bytes:
            return data + super().command(data, t_s)

    line = Conversation(Echoing(AIRCRAFT), RionDecoder(), RionDialogue())
    line.run(12.0)
    assert len(line.said) == pytest.approx(50, abs=4)
    assert len(line.samples) >= len(line.said) - 1
    assert line.decoder.rejected["echo of a command"] >= len(line.said) - 1
