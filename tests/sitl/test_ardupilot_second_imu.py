"""The second IMU of a real ArduPilot: its integers hide the gyro bias (autopilots 9.3.1), and floats do not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sim.imu_model import DEG_H, MG
from tests.sitl.ardupilot_bench import (
    QUICK,
    SECOND_ACCELS,
    SECOND_GYROS,
    assert_as_recorded,
    bench,
    calibrated,
    imu_warnings,
    until_quiet,
)

pytestmark = pytest.mark.sitl

SECOND = """
[[imu]]
name = "fc2"
source = "autopilot"
instance = 2
profile = "icm42688p"
"""
MINUTE = '\n[calibration]\nmin_still_s = 10\nmax_s = 60\nat_arm = "off"\n'
WITHIN_S = 400.0
"""A busy machine simulates at a third of real time."""


async def test_integers_that_hide_the_second_gyro_are_not_calibrated_and_the_words_say_why(tmp_path: Path) -> None:
    async with bench(tmp_path) as b, b.daemon(SECOND + QUICK) as daemon:
        record = await calibrated(daemon)
        print(record["state"], record["duration_s"], record["reason"], record["warnings"], imu_warnings(record))
        await until_quiet(daemon)
        now, changed = await b.ground.whole_list(), await b.changed()
        print(changed)
        assert_as_recorded(record, changed)
        words = " ".join([record["reason"], *imu_warnings(record)])
        assert "companion autopilot script" in words, record
        if record["state"] == "done":
            b.assert_right(now)
            second = next(imu for imu in record["imus"] if imu["name"] == "fc2")
            assert not {*SECOND_GYROS} & second["written"].keys()
        else:
            assert changed == {}


async def test_the_scripts_floats_tell_the_second_imu_without_a_write_before_the_result(tmp_path: Path) -> None:
    async with bench(tmp_path, script=True) as b, b.daemon(SECOND + MINUTE) as daemon:
        record = await calibrated(daemon, WITHIN_S)
        print(record["state"], record["duration_s"], record["reason"], record["warnings"], imu_warnings(record))
        assert record["state"] == "done", record
        now, changed = await b.ground.whole_list(), await b.changed()
        second = next(imu for imu in record["imus"] if imu["name"] == "fc2")
        bias = b.vehicle.true_bias(2, b.vehicle.now_s)
        gyro = (np.array([now[name] for name in SECOND_GYROS]) - bias.gyro_rad_s) / DEG_H
        accel = (np.array([now[name] for name in SECOND_ACCELS]) - bias.accel_m_s2) / MG
        sigma_deg_h = np.array(second["gyro_sigma_use_rad_s"]) / DEG_H
        print(f"fc2 left {gyro} deg/h of sigma {sigma_deg_h}, {accel} mg")
        b.assert_right(now)
        assert np.sqrt(np.mean(gyro**2)) < 4.0
        assert (np.abs(gyro) < 2.5 * sigma_deg_h).all()
        b.assert_right(now, instance=2)
        assert_as_recorded(record, changed)
        assert {*SECOND_GYROS, *SECOND_ACCELS} <= changed.keys()
        assert (await daemon.ask("undo"))["state"] == "done"
        assert await b.changed() == {}
