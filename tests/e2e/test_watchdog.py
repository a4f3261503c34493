"""The watchdog accuses no task of a working daemon: minutes at the flight line on virtual time."""

from __future__ import annotations

import asyncio
import functools
from pathlib import Path

from companion.component.service import Refusal
from companion.daemon.process.service import watched_tasks
from companion.estimation.machine import What
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual


def test_nobody_is_accused_who_works(tmp_path: Path) -> None:
    async def main() -> dict[str, float]:
        rig = Rig(tmp_path, firmware="px4", min_still_s=4.0, max_s=8.0, loss=0.2, at_arm="gate", imu_rate_hz=10.0)
        oldest: dict[str, float] = {}
        async with rig.running() as running:
            watched = watched_tasks(running.service)

            async def look() -> None:
                while True:
                    await asyncio.sleep(1.0)
                    for each in watched:
                        if each.overdue(1.0):
                            oldest[each.name] = max(each.age_s, oldest.get(each.name, 0.0))

            looking = asyncio.create_task(look())
            await asyncio.sleep(20.0)
            for _ in range(2):
                start = functools.partial(running.service.calibrating.manager.start_calibration, What.BOTH, "test")
                while isinstance(job := start(), Refusal):  # of three heartbeats in a row all may be lost
                    await asyncio.sleep(1.0)
                await job.finished
                rig.wire.cut = True
                await asyncio.sleep(40.0)
                rig.wire.cut = False
                rig.autopilot.reboot(down_s=20.0)
                await asyncio.sleep(60.0)
            rig.unplugged |= {"compass", "gradienter"}
            await asyncio.sleep(40.0)
            looking.cancel()
        return oldest

    # The rig itself carries the bytes: the tasks that would do that are not running, and are missed.
    assert run_virtual(main()).keys() == {"MAVLink connection", "sensor gradienter", "sensor compass"}
