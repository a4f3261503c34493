"""What is asked of devices that only answer, against simulated ones; and when nothing is said."""

from __future__ import annotations

import pytest

from companion.protocols.compasses.pni import PniDecoder, PniDialogue
from companion.protocols.decoding.base import Decoder
from companion.protocols.decoding.dialogue import AGAIN_S, SILENT_S, PollDialogue
from companion.protocols.inclinometers.rion import RionDecoder, RionDialogue
from companion.samples import CompassSample, MagSample, Sample, TiltSample
from sim.aircraft import Pose, VirtualAircraft
from sim.compasses import PniCompass, RionCompass
from sim.devices import SerialDevice
from sim.gradienters import RionInclinometer

STEP_S = 0.02
READ = bytes.fromhex("6804000408")
GET_DATA = bytes.fromhex("000504BF71")


class Conversation:
    """A dialogue, a decoder and a device, every 20 ms."""

    def __init__(self, dialogue: PollDialogue, decoder: Decoder, device: SerialDevice) -> None:
        self.dialogue, self.decoder, self.device = dialogue, decoder, device
        self.steps = 0
        self.said: list[tuple[float, bytes]] = []
        self.samples: list[Sample] = []
        self.unplugged = False
        device.power_on(0.0)
        dialogue.opened(0.0)

    @property
    def now_s(self) -> float:
        return self.steps * STEP_S

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.steps += 1
            heard = b"".join(frame.data for frame in self.device.frames_until(self.now_s))
            question = self.dialogue.due(self.now_s)
            if question:
                self.said.append((self.now_s, question))
                if not self.unplugged:
                    heard += self.device.command(question, self.now_s)
            if heard and not self.unplugged:
                samples = self.decoder.feed(heard, self.now_s)
                self.samples += samples
                self.dialogue.heard(heard, len(samples), self.now_s)


def aircraft() -> VirtualAircraft:
    return VirtualAircraft(Pose(pitch_deg=5.0, roll_deg=-3.0, heading_deg=40.0))


def test_a_rion_compass_is_asked_five_times_a_second() -> None:
    talk = Conversation(RionDialogue(), RionDecoder(), RionCompass(aircraft(), heading_noise_deg=0.0))
    assert talk.dialogue.words == ""
    talk.run(12.0)
    assert talk.said[0][0] == pytest.approx(SILENT_S, abs=2 * STEP_S)
    assert {data for _, data in talk.said} == {READ}
    assert len(talk.said) == pytest.approx(50, abs=1)
    assert talk.samples == [CompassSample(at_s, 40.0, 5.0, -3.0) for at_s, _ in talk.said]
    assert talk.dialogue.words == "asked 5 times a second with 68 04 00 04 08"


def test_a_rion_inclinometer_answers_the_same_question() -> None:
    talk = Conversation(RionDialogue(), RionDecoder(), RionInclinometer(aircraft(), noise_deg=0.0))
    talk.run(4.0)
    assert len(talk.samples) == len(talk.said) == pytest.approx(10, abs=1)
    sample = talk.samples[-1]
    assert isinstance(sample, TiltSample)
    assert (sample.x_deg, sample.y_deg) == pytest.approx((-2.98859, 5.0), abs=1e-4)


def test_a_pni_compass_is_told_what_to_answer_and_then_asked() -> None:
    device = PniCompass(aircraft(), heading_noise_deg=0.0)
    talk = Conversation(PniDialogue(), PniDecoder(), device)
    talk.run(12.0)
    assert talk.said[0][1] == bytes.fromhex("000E03080518190809 1B1C1DB20E") + GET_DATA
    assert {data for _, data in talk.said[1:]} == {GET_DATA}
    assert len(talk.said) == pytest.approx(100, abs=1)
    compass, mag = talk.samples[-2:]
    assert isinstance(compass, CompassSample)
    assert (compass.heading_deg, compass.pitch_deg, compass.roll_deg) == pytest.approx((40.0, 5.0, -3.0), abs=1e-3)
    assert isinstance(mag, MagSample)
    assert len(talk.samples) == 2 * len(talk.said)
    assert talk.decoder.rejected.total() == 0
    assert device.saves == 0


def test_a_pni_compass_that_has_lost_its_power_is_told_again() -> None:
    device = PniCompass(aircraft())
    talk = Conversation(PniDialogue(), PniDecoder(), device)
    talk.run(5.0)
    talk.unplugged = True
    talk.run(4.0)
    assert device.components != (5, 79)
    device.power_on(talk.now_s)
    talk.unplugged = False
    before = len(talk.samples)
    talk.run(AGAIN_S + 1.5)
    assert device.components == (5, 24, 25, 8, 9, 27, 28, 29)
    assert len(talk.samples) > before


def test_its_own_echo_is_no_answer_and_no_speech() -> None:
    class Echoing(RionCompass):
        def command(self, data: bytes, t_s: float) -> bytes:
            return data + super().command(data, t_s)

    talk = Conversation(RionDialogue(), RionDecoder(), Echoing(aircraft()))
    talk.run(12.0)
    assert len(talk.samples) == len(talk.said) == pytest.approx(50, abs=1)
    assert talk.decoder.rejected == {"echo of a command": len(talk.said)}


def test_a_port_opened_again_begins_with_listening() -> None:
    talk = Conversation(PniDialogue(), PniDecoder(), PniCompass(aircraft()))
    talk.run(3.0)
    talk.dialogue.opened(talk.now_s)
    asked = len(talk.said)
    talk.run(SILENT_S - 2 * STEP_S)
    assert len(talk.said) == asked
    talk.run(0.2)
    assert talk.said[asked][1] == PniDialogue.keywords["set_up"] + GET_DATA
