"""What PX4 writes by itself (autopilots 4.3, 9.2, 9.3.2)."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from sim.imu_model import DEG_H, MG
from tests.support.px4_stage import GYRO_BIAS, PX4Stage, now_s

THREE_DEG_S = (0.05, 0.0, 0.0)


async def test_a_wrong_gyro_offset_is_rewritten_about_5_s_after_the_write_while_disarmed_and_still() -> None:
    async with PX4Stage(rivals=True, spec="white_only") as stage:
        await asyncio.sleep(10.0)
        assert stage.double.gyro_rival.commits == 0  # 0.001 rad/s is below the threshold
        await stage.set("CAL_GYRO0_XOFF", -0.05)
        written_s = now_s()
        while stage.double.gyro_rival.commits == 0:
            await asyncio.sleep(0.1)
        assert 5.0 <= now_s() - written_s < 8.0
        rate = stage.aircraft.truth_at(0.0).rate_rad_s
        found = [stage.double.parameter(f"CAL_GYRO0_{axis}OFF") for axis in "XYZ"]
        assert found == pytest.approx(GYRO_BIAS + rate, abs=60.0 * DEG_H)  # the Earth's rotation goes into it
        assert not np.array_equal(found, GYRO_BIAS)


async def test_the_background_calibration_is_started_at_boot_only() -> None:
    async with PX4Stage(rivals=True) as stage:
        await stage.set("IMU_GYRO_CAL_EN", 0)
        await asyncio.sleep(2.0)
        await stage.set("CAL_GYRO0_XOFF", -0.05)
        await asyncio.sleep(10.0)
        assert stage.double.gyro_rival.commits == 1  # still running
        stage.double.reboot(1.0)
        await asyncio.sleep(2.0)
        await stage.set("CAL_GYRO0_XOFF", -0.05)
        await asyncio.sleep(20.0)
        assert stage.double.gyro_rival.commits == 1
        assert stage.double.parameter("CAL_GYRO0_XOFF") == pytest.approx(-0.05)


async def test_what_was_learned_while_armed_is_written_at_disarm_if_it_is_worth_0_05() -> None:
    bias = np.array([0.0, 0.0, 20.0]) * MG
    parameters = {"SENS_IMU_AUTOCAL": 1}
    async with PX4Stage(accel_bias=bias, parameters=parameters) as stage:
        stage.double.arm()
        await asyncio.sleep(60.0)
        assert stage.double.parameter("CAL_ACC0_ZOFF") == 0.0
        stage.double.disarm()
        await asyncio.sleep(0.1)
        assert stage.double.parameter("CAL_ACC0_ZOFF") == pytest.approx(bias[2], rel=0.02)
        assert stage.values("CAL_ACC0_ZOFF", station=stage.ground) == [pytest.approx(bias[2], rel=0.02)]
        assert stage.double.learned_offsets.commits == 1
        # What is left is not worth a second time.
        stage.double.arm()
        await asyncio.sleep(60.0)
        stage.double.disarm()
        assert stage.double.learned_offsets.commits == 1
