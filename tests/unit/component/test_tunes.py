"""Tunes on the autopilot's buzzer: when they are sent, and that both firmwares can play them."""

from __future__ import annotations

import asyncio
from contextlib import suppress

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.vehicle import Vehicle
from companion.component.statustext import TUNE_STALE_S, TUNES_APART_S, Tune, Tunes
from companion.links.mavlink.link import MavlinkLink
from sim.firmware.buzzer import Played, notes_of
from tests.support.component import Ground
from tests.support.wire import Wire

BEAT_S = 0.5


def beat(*, armed: bool) -> mavlink.MAVLink_heartbeat_message:
    mode = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0)
    return mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, mode, 0, 3, 3)


class TuneBench:
    """Tunes at one end of a wire, an autopilot (system 7) that only beats and listens at the other."""

    def __init__(self) -> None:
        self.link, self.autopilot, self.woken = MavlinkLink(), Ground(7, 1), asyncio.Event()
        self.wire = Wire(self.link, self.autopilot)
        self.wanted, self.armed = True, False
        self.tunes = Tunes(self.link, Vehicle(self.link), lambda: self.wanted, self.woken)

    async def run(self, seconds: float) -> None:
        """Let time pass as the component's loop does: it wakes for what `step` says, and for what is new."""
        loop = asyncio.get_running_loop()
        end_s, beat_s = loop.time() + seconds, loop.time()
        while (now_s := loop.time()) < end_s:
            if now_s >= beat_s:
                self.autopilot.send(beat(armed=self.armed))
                beat_s += BEAT_S
            self.woken.clear()
            due_s = min(self.tunes.step(now_s), beat_s, end_s)
            with suppress(TimeoutError):
                async with asyncio.timeout(due_s - now_s):
                    await self.woken.wait()

    @property
    def played(self) -> list[tuple[float, str]]:
        return [
            (t_s, message.tune + message.tune2)
            for t_s, message in self.autopilot.received
            if isinstance(message, mavlink.MAVLink_play_tune_message)
        ]


async def test_it_is_sent_to_the_autopilot_at_once_and_the_next_when_the_first_is_over() -> None:
    bench = TuneBench()
    await bench.run(1.0)
    bench.tunes.play(Tune.HOLD_STILL)
    await bench.run(0.2)
    bench.tunes.play(Tune.NEXT)
    bench.tunes.play(Tune.WRONG)
    await bench.run(3.0)
    (first_s, first), (second_s, second) = bench.played
    assert (first, second) == (Tune.HOLD_STILL.value, Tune.WRONG.value)  # only the latest waits
    assert second_s - first_s == pytest.approx(TUNES_APART_S, abs=0.05)
    targets = {
        (message.target_system, message.target_component)
        for _, message in bench.autopilot.received
        if isinstance(message, mavlink.MAVLink_play_tune_message)
    }
    assert targets == {(7, 1)}


async def test_nothing_is_played_armed_nor_unknown_nor_unwanted_nor_afterwards() -> None:
    bench = TuneBench()
    bench.tunes.play(Tune.NEXT)
    await bench.run(0.0)
    bench.tunes.step(asyncio.get_running_loop().time())  # before its first heartbeat
    bench.armed = True
    await bench.run(1.0)
    bench.tunes.play(Tune.NEXT)
    await bench.run(1.0)
    bench.armed = False
    await bench.run(6.0)
    bench.wanted = False
    bench.tunes.play(Tune.NEXT)
    await bench.run(1.0)
    bench.wanted = True
    await asyncio.sleep(2.5)  # the heartbeats have ended
    bench.tunes.play(Tune.NEXT)
    bench.tunes.step(asyncio.get_running_loop().time())
    await bench.run(2.0)
    assert bench.played == []


async def test_one_that_had_to_wait_too_long_is_no_news() -> None:
    bench = TuneBench()
    await bench.run(1.0)
    bench.tunes.play(Tune.FAILED)
    await asyncio.sleep(TUNE_STALE_S)  # the loop of the component stood still
    await bench.run(1.0)
    assert bench.played == []


@pytest.mark.parametrize(
    ("tune", "heard"),
    [
        (Tune.HOLD_STILL, "1 long note"),
        (Tune.NEXT, "2 short notes, rising"),
        (Tune.WRONG, "6 short notes, up and down"),
        (Tune.DONE, "4 short notes, rising"),
        (Tune.FAILED, "4 long notes, falling"),
    ],
)
def test_the_notes_are_what_the_guide_says_and_short_and_shrill_enough(tune: Tune, heard: str) -> None:
    played = Played(0.0, notes_of(tune.value))
    assert str(played) == heard
    assert played.seconds <= 1.2 < TUNES_APART_S
    assert len(tune.value) < 30, "PX4 and ArduPilot read on from the first field only where that is full"
    assert all(900.0 < note.frequency_hz < 5000.0 for note in played.notes if note.frequency_hz), "what a buzzer can"


def test_the_simulated_buzzer_reads_notes_as_the_firmwares_do() -> None:
    """Worked out by hand: at T120 a quarter takes 0.5 s, of which 7/8 sound; A of O4 is 1760 Hz in both firmwares."""
    notes = notes_of("T120O4A4P4ML<A8.")
    assert [note.frequency_hz for note in notes] == pytest.approx([1760.0, 0.0, 0.0, 880.0])
    assert [note.seconds for note in notes] == pytest.approx([0.4375, 0.0625, 0.5, 0.375])
