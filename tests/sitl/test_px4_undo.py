"""All parameters of a real PX4 before a calibration and after its undo, and what may come between (autopilots 4, 8).

Some minutes of real time each.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest

from sim.companion_process import CompanionProcess
from sim.scenario import DEMO_POSE, demo
from sim.sitl.daemon import companion_daemon
from sim.sitl.ground import GroundStation
from sim.sitl.px4 import Px4Sitl
from sim.sitl.residuals import CALIBRATE_WITHIN_S, ground_station
from tests.sitl.craft import BINARIES, missing

pytestmark = pytest.mark.sitl

ITS_OWN = frozenset(
    {"_HASH_CHECK", "LND_FLIGHT_T_HI", "LND_FLIGHT_T_LO", "COM_FLIGHT_UUID", "SDLOG_MODE", "SDLOG_BACKEND"}
)
"""What PX4 itself may change meanwhile; those of the log are put back to their defaults by its start scripts."""
GYRO_DEG_H = (500.0, -700.0, 1000.0)
"""Case D: integers tell it without dither."""
ACCEL_MG = (1.0, -2.0, 3.0)
QUICK = "\n[calibration]\nmin_still_s = 20\nmax_s = 40\n"
SAVED_S = 4.0


@contextlib.asynccontextmanager
async def flying(folder: Path) -> AsyncIterator[tuple[Px4Sitl, GroundStation]]:
    """PX4 as it comes, its own background calibration on."""
    reason = missing("px4-sitl")
    if reason is not None:
        pytest.skip(reason)
    scenario = demo(pose=DEMO_POSE, part="white_only", gyro_deg_h=GYRO_DEG_H, accel_mg=ACCEL_MG, seed=1)
    vehicle = Px4Sitl(Path(os.environ[BINARIES["px4-sitl"]]), scenario, folder)
    async with vehicle, ground_station(vehicle) as ground:
        await ground.wait_for(lambda: bool(ground.vehicle_heartbeats()), 60.0, "a heartbeat")
        await vehicle.sleep(30.0)
        yield vehicle, ground


async def calibrate(daemon: CompanionProcess) -> dict[str, float]:
    """One that succeeds; the values that it wrote, by parameter."""
    record = await daemon.calibrate(CALIBRATE_WITHIN_S)
    assert record["state"] == "done", (record["reason"], daemon.log())
    return {name: one["after"] for imu in record["imus"] for name, one in imu["written"].items()}


def changed(one: dict[str, float], other: dict[str, float]) -> set[str]:
    """Names of other values; PX4 lists what somebody aboard has used since the boot, so each boot lists others."""
    both = one.keys() & other.keys()
    assert len(both) > 800
    return {name for name in both if one[name] != other[name]} - ITS_OWN


def test_undo_leaves_every_parameter_of_px4_as_it_was_also_after_a_power_cycle_and_with_others_writing(
    tmp_path: Path,
) -> None:
    async def main() -> None:
        folder = tmp_path / "daemon"
        folder.mkdir()
        async with flying(tmp_path / "px4") as (vehicle, ground):
            before = await ground.whole_list(60.0)
            async with companion_daemon(vehicle, folder, more=QUICK) as daemon:
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
                refused = await daemon.undo()
                assert "CAL_GYRO0_XOFF" in str(refused)
                assert "somebody else" in str(refused)
                await ground.put("CAL_GYRO0_XOFF", wrote["CAL_GYRO0_XOFF"])
                await vehicle.sleep(3.0)
                undone = await daemon.undo()
                assert not changed(before, await ground.whole_list(60.0)), undone

    asyncio.run(main())


def test_values_lost_by_a_power_cut_right_after_the_write_are_noticed_after_the_boot(tmp_path: Path) -> None:
    async def main() -> None:
        folder = tmp_path / "daemon"
        folder.mkdir()
        async with flying(tmp_path / "px4") as (vehicle, ground):
            before = await ground.whole_list(60.0)
            async with companion_daemon(vehicle, folder, more=QUICK) as daemon:
                calibrating = asyncio.create_task(daemon.calibrate(CALIBRATE_WITHIN_S))
                # PX4 saves a while after a change: cut the power when the first far value has come in.
                while await ground.get("CAL_ACC0_XOFF") == before["CAL_ACC0_XOFF"]:
                    assert not calibrating.done(), daemon.log()
                    await asyncio.sleep(0.02)
                await vehicle.power_cycle()
                record = await calibrating
                assert record["state"] == "failed"
                assert "restart" in record["reason"] or "reboot" in record["reason"], record["reason"]
                await vehicle.sleep(10.0)
                assert not changed(before, await ground.whole_list(60.0)), daemon.log()

    asyncio.run(main())
