"""All parameters of a real PX4 before a calibration and after its undo, and what may come between (autopilots 4, 8).

Some minutes of real time each.
"""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest

from sim.sitl.daemon import companion_daemon
from sim.sitl.residuals import CALIBRATE_WITHIN_S
from tests.sitl.px4_bench import QUICK, SAVED_S, calibrate, changed, flying

pytestmark = pytest.mark.sitl


async def test_undo_leaves_every_parameter_of_px4_as_it_was_also_after_a_power_cycle_and_with_others_writing(
    tmp_path: Path,
) -> None:
    async with flying(tmp_path / "px4") as (vehicle, ground):
        before = await ground.whole_list(60.0)
        async with companion_daemon(vehicle, tmp_path / "daemon", more=QUICK) as daemon:
            wrote = await calibrate(daemon)
            assert {name[:9] for name in wrote} >= {"CAL_GYRO0", "CAL_ACC0_", "CAL_ACC1_"}
            # The far value of the two steps has not woken PX4's own calibration, nor do the new ones.
            await vehicle.sleep(15.0)
            after = await ground.whole_list(60.0)
            assert changed(before, after) == set(wrote)
            for name, value in wrote.items():
                assert after[name] == np.float32(value)
            # Power off and on: all of it is still there, and can still be undone.
            await vehicle.sleep(SAVED_S)
            await vehicle.power_cycle()
            await vehicle.sleep(10.0)
            assert changed(after, await ground.whole_list(60.0)) == set()
            # Somebody else writes one of ours: nothing is overwritten blindly.
            await ground.put("CAL_GYRO0_XOFF", 0.001)
            await vehicle.sleep(3.0)
            refused = await daemon.ask("undo")
            assert "CAL_GYRO0_XOFF" in str(refused)
            assert "another writer" in str(refused)
            await ground.put("CAL_GYRO0_XOFF", wrote["CAL_GYRO0_XOFF"])
            await vehicle.sleep(3.0)
            undone = await daemon.ask("undo")
            assert not changed(before, await ground.whole_list(60.0)), undone


async def test_values_lost_by_a_power_cut_right_after_the_write_are_noticed_after_the_boot(tmp_path: Path) -> None:
    async with flying(tmp_path / "px4") as (vehicle, ground):
        before = await ground.whole_list(60.0)
        async with companion_daemon(vehicle, tmp_path / "daemon", more=QUICK) as daemon:
            calibrating = asyncio.create_task(daemon.calibrate(CALIBRATE_WITHIN_S))
            # PX4 saves a while after a change: cut the power when the first far value has come in.
            while await ground.get("CAL_ACC0_ZOFF") == before["CAL_ACC0_ZOFF"]:
                assert not calibrating.done(), daemon.log()
                await asyncio.sleep(0.02)
            await vehicle.power_cycle()
            record = await calibrating
            assert record["state"] == "failed"
            assert "restart" in record["reason"] or "reboot" in record["reason"], record["reason"]
            await vehicle.sleep(10.0)
            assert not changed(before, await ground.whole_list(60.0)), daemon.log()
