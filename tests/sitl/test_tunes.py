"""PLAY_TUNE on all four: taken without a word, and PX4 plays the notes that it says."""

from __future__ import annotations

import asyncio
import os
import re
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.statustext import TUNES_APART_S, Tune
from sim.firmware.buzzer import notes_of
from sim.sitl.px4 import Px4Sitl
from tests.sitl.craft import Autopilot, Craft, DoubleCraft, SitlCraft

pytestmark = pytest.mark.real_clock


@pytest.mark.parametrize("tune", list(Tune), ids=lambda tune: tune.name)
def test_a_tune_is_taken_without_a_complaint(autopilot: Autopilot, tune: Tune) -> None:
    async def main(craft: Craft) -> None:
        async with craft.companion() as station:
            await craft.heartbeats()
            since_s = asyncio.get_running_loop().time()
            station.send(mavlink.MAVLink_play_tune_message(craft.ground.vehicle, 1, tune.value.encode(), b""))
            await asyncio.sleep(TUNES_APART_S)
            await craft.heartbeats()
            assert "tune" not in craft.ground.texts_since(since_s).lower()
            if isinstance(craft, DoubleCraft):
                assert craft.double.buzzer.played[-1].notes == notes_of(tune.value)
            elif isinstance(craft, SitlCraft) and isinstance(craft.vehicle, Px4Sitl):
                last = [note for note in notes_of(tune.value) if note.frequency_hz][-1]
                frequency_hz, duration_us = await played_last(craft.vehicle.instance)
                assert frequency_hz == pytest.approx(last.frequency_hz, abs=1.0)
                assert duration_us * 1e-6 == pytest.approx(last.seconds, abs=0.002)

    autopilot.run(main)


async def played_last(instance: int) -> tuple[float, float]:
    """Frequency in Hz and duration in us of the last note, as PX4's own shell tells them."""
    listener = Path(os.environ["PX4_SITL"]).parent / "px4-listener"
    shell = await asyncio.create_subprocess_exec(
        listener, "--instance", str(instance), "tune_control", stdout=asyncio.subprocess.PIPE
    )
    out, _ = await asyncio.wait_for(shell.communicate(), 10.0)
    found = dict(re.findall(r"(frequency|duration): (\d+)", out.decode()))
    return float(found["frequency"]), float(found["duration"])


@pytest.mark.only("px4")
def test_px4_reads_on_in_a_new_tune_where_it_was_in_the_old_one(autopilot: Autopilot) -> None:
    """Therefore `TUNES_APART_S`: the notes are the new ones, from the third on, and their tempo is the old one."""
    slow = "MFT32L1O4A"  # one note of 7.5 s

    async def main(craft: Craft) -> None:
        async with craft.companion() as station:
            await craft.heartbeats()
            for tune in (slow, Tune.DONE.value):
                station.send(mavlink.MAVLink_play_tune_message(craft.ground.vehicle, 1, tune.encode(), b""))
                await asyncio.sleep(TUNES_APART_S)
            if isinstance(craft, DoubleCraft):
                assert craft.double.buzzer.broken_off == 1
            else:
                assert isinstance(craft, SitlCraft)
                assert isinstance(craft.vehicle, Px4Sitl)
                frequency_hz, duration_us = await played_last(craft.vehicle.instance)
                new = [note for note in notes_of(Tune.DONE.value) if note.frequency_hz]
                assert any(frequency_hz == pytest.approx(note.frequency_hz, abs=1.0) for note in new)
                assert duration_us * 1e-6 > 3.0 * max(note.seconds for note in new[:3])

    autopilot.run(main)
