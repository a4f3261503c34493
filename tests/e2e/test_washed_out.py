"""A client that requests and cancels, or arms and disarms, in a loop: kept values stay, others are served."""

from __future__ import annotations

import asyncio
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.service import Refusal
from companion.daemon.job import Job
from companion.estimation.machine import What
from tests.support.component import ACCEPTED, CALIBRATE, CANCEL, TEMPORARILY_REJECTED
from tests.support.rig import Rig


def ask(rig: Rig, requester: str) -> Job | Refusal:
    return rig.service.calibrating.manager.start_calibration(What.BOTH, requester)


async def done(rig: Rig) -> None:
    job = ask(rig, "a pilot")
    assert isinstance(job, Job), job
    async with asyncio.timeout(120.0):
        result = await job.finished
        assert result.outcome == "done", result


async def test_requests_and_cancels_in_a_loop_leave_the_history_as_it_was(tmp_path: Path) -> None:
    async with Rig(tmp_path).running() as rig:
        await rig.ready()
        await done(rig)
        folder = rig.service.calibrating.store.folder
        before = [path.read_bytes() for path in folder.iterdir()]
        for _ in range(1000):
            rig.ground.command(CALIBRATE)
            await asyncio.sleep(0.005)
            rig.ground.command(CANCEL)
            await asyncio.sleep(0.005)
        # The last cancel is still on its way, and would cancel what comes next.
        await rig.until(lambda: len(rig.ground.finals(CANCEL)) == 1000, 30.0)
        await rig.until(lambda: not rig.service.calibrating.manager.state.busy, 30.0)
        assert [path.read_bytes() for path in folder.iterdir()] == before
        assert len(before) == 1
        assert TEMPORARILY_REJECTED in rig.ground.finals(CALIBRATE)
        assert set(rig.ground.finals(CANCEL)) == {ACCEPTED}
        await rig.until(lambda: any("too many requests, wait" in text for text in rig.ground.texts()), 30.0)
        await done(rig)
        job = ask(rig, "a pilot")
        assert isinstance(job, Job), job
        await asyncio.sleep(6.0)
        job.cancel("a pilot")
        await job.finished
        assert [one.state for one in rig.service.calibrating.store.history()] == ["cancelled", "done", "done"]


async def test_an_arming_that_flickers_does_not_wash_out_the_armings(tmp_path: Path) -> None:
    async with Rig(tmp_path).running() as rig:
        await rig.ready()
        codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        for k in range(1200):
            beat = mavlink.MAVLink_heartbeat_message(2, 3, 128 if k % 2 else 0, 0, 4, 3)
            rig.wire.carry_from_other(beat.pack(codec))
            codec.seq = (codec.seq + 1) % 256
            await asyncio.sleep(0.05)
        await asyncio.sleep(1.0)
        assert len(rig.service.arming.armings.file.read()) == 1
