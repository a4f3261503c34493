"""The second IMU of a real PX4: its integers hide the gyro bias, its console tells raw means (autopilots 10)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sim.imu_model import DEG_H, MG
from sim.sitl.daemon import companion_daemon
from tests.sitl.px4_bench import changed, flying

pytestmark = pytest.mark.sitl

MINUTE = "\n[calibration]\nmin_still_s = 20\nmax_s = 60\n"
WITHIN_S = 400.0
"""A busy machine simulates at a third of real time."""
GYROS = tuple(f"CAL_GYRO1_{axis}OFF" for axis in "XYZ")
ACCELS = tuple(f"CAL_ACC1_{axis}OFF" for axis in "XYZ")


async def test_the_console_tells_the_second_imu_without_a_write_before_the_result(tmp_path: Path) -> None:
    async with flying(tmp_path / "px4", gyro_deg_h=(100.0, -60.0, 170.0)) as (vehicle, ground):
        before = await ground.whole_list(60.0)
        async with companion_daemon(vehicle, tmp_path / "daemon", more=MINUTE) as daemon:
            record = await daemon.calibrate(WITHIN_S)
            print(record["state"], record["duration_s"], record["reason"], record["warnings"])
            print([(imu["name"], imu["warnings"]) for imu in record["imus"]])
            assert record["state"] == "done", record
            now = await ground.whole_list(60.0)
            second = next(imu for imu in record["imus"] if imu["name"] == "fc2")
            bias = vehicle.true_bias(2, vehicle.now_s)
            gyro = (np.array([now[name] for name in GYROS]) - bias.gyro_rad_s) / DEG_H
            accel = (np.array([now[name] for name in ACCELS]) - bias.accel_m_s2) / MG
            sigma_deg_h = np.array(second["gyro_sigma_use_rad_s"]) / DEG_H
            print(f"fc2 left {gyro} deg/h of sigma {sigma_deg_h}, {accel} mg")
            assert np.sqrt(np.mean(gyro**2)) < 4.0
            assert (np.abs(gyro) < 2.5 * sigma_deg_h).all()
            assert np.abs(accel).max() < 0.2
            assert (await daemon.ask("undo"))["state"] == "done"
            assert not changed(before, await ground.whole_list(60.0))
