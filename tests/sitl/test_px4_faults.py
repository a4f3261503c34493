"""Faults around a calibration of a real PX4: right afterwards, or refused with the old values restored.

Some minutes of real time each.
"""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.imu_model import DEG_H, MG
from sim.sitl.daemon import LossyLink, companion_daemon
from sim.sitl.px4 import Px4Sitl
from sim.sitl.residuals import CALIBRATE_WITHIN_S
from tests.sitl.px4_bench import QUICK, SAVED_S, calibrate, changed, flying

pytestmark = pytest.mark.sitl

GYRO_LIMIT_DEG_H = {1: 80.0, 2: 15.0}
"""Limits by IMU: the first one's coarse simulated steps allow 20 deg/h rms in 40 s; the other's noise less."""
ACCEL_LIMIT_MG = 0.2


def assert_right(vehicle: Px4Sitl, wrote: dict[str, float]) -> None:
    """Check that the written values are the true bias of the sensor with the slot."""
    for instance in (1, 2):
        bias = vehicle.true_bias(instance, 0.0)
        for part, true, unit, limit in (
            ("GYRO", bias.gyro_rad_s, DEG_H, GYRO_LIMIT_DEG_H[instance]),
            ("ACC", bias.accel_m_s2, MG, ACCEL_LIMIT_MG),
        ):
            names = [f"CAL_{part}{instance - 1}_{axis}OFF" for axis in "XYZ"]
            if names[0] in wrote:
                off = (np.array([wrote[name] for name in names]) - true) / unit
                assert np.abs(off).max() < limit, (names[0], off)


@pytest.mark.parametrize("seed", [1, 2])
async def test_a_fifth_of_all_packets_lost(tmp_path: Path, seed: int) -> None:
    async with flying(tmp_path / "px4") as (vehicle, ground):
        before = await ground.whole_list(60.0)
        port = int(vehicle.url.rpartition(":")[2])
        async with (
            LossyLink(seed=seed, near_port=port) as link,
            companion_daemon(vehicle, tmp_path / "daemon", more=QUICK, url=link.url) as daemon,
        ):
            link.loss = 0.2
            record = await daemon.calibrate(CALIBRATE_WITHIN_S)
            print(record["state"], record["duration_s"], record["reason"], record["warnings"])
            assert link.lost > 0.15 * (link.lost + link.passed)
            link.loss = 0.0
            wrote = {name: one["after"] for imu in record["imus"] for name, one in imu["written"].items()}
            if record["state"] == "done":
                assert_right(vehicle, wrote)
                assert changed(before, await ground.whole_list(60.0)) == set(wrote)
                undone = await daemon.ask("undo")
                assert undone["state"] == "done", undone
            else:
                await asyncio.sleep(20.0)
            assert changed(before, await ground.whole_list(60.0)) == set(), daemon.log()


async def test_a_daemon_that_dies_at_the_far_value_puts_the_old_ones_back_unless_px4_was_quicker(
    tmp_path: Path,
) -> None:
    async with flying(tmp_path / "px4") as (vehicle, ground):
        before = await ground.whole_list(60.0)
        async with companion_daemon(vehicle, tmp_path / "daemon", more=QUICK) as daemon:
            calibrating = asyncio.create_task(daemon.calibrate(CALIBRATE_WITHIN_S))
            while await ground.get("CAL_ACC0_ZOFF") == before["CAL_ACC0_ZOFF"]:
                assert not calibrating.done(), daemon.log()
                await asyncio.sleep(0.02)
            daemon.kill()
            with contextlib.suppress(RuntimeError, AssertionError, ValueError):
                await calibrating
        assert changed(before, await ground.whole_list(60.0))
        # Not by itself again: what is looked for is that the old values are back.
        async with companion_daemon(vehicle, tmp_path / "daemon", more=f'{QUICK}at_arm = "off"\n') as daemon:
            async with asyncio.timeout(60.0):
                while (status := await daemon.status()) is None or status["putting_back"]:
                    await asyncio.sleep(1.0)
            assert status["state"] == "idle"
            now = await ground.whole_list(60.0)
            left = changed(before, now)
            if left:
                # IMU_GYRO_CAL_EN: a far gyro value left alone for some seconds is what PX4 calibrates anew.
                assert left == {f"CAL_GYRO0_{axis}OFF" for axis in "XYZ"}
                assert "changed by another writer, not restored: CAL_GYRO0" in daemon.log()
                assert_right(vehicle, {name: now[name] for name in left})


async def test_another_station_that_writes_the_same_offset_meanwhile_is_not_overwritten_unsaid(tmp_path: Path) -> None:
    async with flying(tmp_path / "px4") as (vehicle, ground):
        before = await ground.whole_list(60.0)
        async with companion_daemon(vehicle, tmp_path / "daemon", more=QUICK) as daemon:
            calibrating = asyncio.create_task(daemon.calibrate(CALIBRATE_WITHIN_S))
            await vehicle.sleep(12.0)
            await ground.put("CAL_ACC0_XOFF", 0.25)
            record = await calibrating
            wrote = {name: one["after"] for imu in record["imus"] for name, one in imu["written"].items()}
            if record["state"] == "done":
                # Measured anew with the other's value in force: the whole bias is the same.
                assert_right(vehicle, wrote)
            else:
                assert changed(before, await ground.whole_list(60.0)) == {"CAL_ACC0_XOFF"}
                assert await ground.get("CAL_ACC0_XOFF") == 0.25


async def test_px4s_own_learning_at_disarm_leaves_our_offsets_alone(tmp_path: Path) -> None:
    """SENS_IMU_AUTOCAL: with what a calibration leaves it finds nothing that is worth a write (autopilots 4.3)."""
    async with flying(tmp_path / "px4") as (vehicle, ground):
        assert await ground.get("SENS_IMU_AUTOCAL") == 1
        async with companion_daemon(vehicle, tmp_path / "daemon", more=QUICK) as daemon:
            wrote = await calibrate(daemon)
            await vehicle.sleep(SAVED_S)
            await vehicle.power_cycle()
            await vehicle.sleep(30.0)
            calibrated = await ground.whole_list(60.0)
            assert await ground.arm() == mavlink.MAV_RESULT_ACCEPTED
            await vehicle.sleep(40.0)
            assert await ground.arm(arm=False) == mavlink.MAV_RESULT_ACCEPTED
            await vehicle.sleep(15.0)
            assert changed(calibrated, await ground.whole_list(60.0)).isdisjoint(wrote), daemon.log()
