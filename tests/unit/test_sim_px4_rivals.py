"""What PX4 writes by itself (autopilots 4.3, 9.2, 9.3.2)."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from sim.imu_model import DEG_H, MG
from sim.motions import Handling
from tests.support.px4_stage import GYRO_BIAS, PX4Stage, now_s
from tests.support.virtual_time import run_virtual

THREE_DEG_S = (0.05, 0.0, 0.0)


def test_a_wrong_gyro_offset_is_rewritten_about_5_s_after_the_write_while_disarmed_and_still() -> None:
    async def main() -> None:
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

    run_virtual(main())


def test_what_the_rival_writes_is_announced_on_every_port_and_used() -> None:
    async def main() -> None:
        async with PX4Stage(rivals=True) as stage:
            await asyncio.sleep(10.0)
            await stage.set("CAL_GYRO0_XOFF", -0.05)
            await asyncio.sleep(10.0)
            stored = stage.double.parameter("CAL_GYRO0_XOFF")
            for station in (stage.companion, stage.ground):
                assert stage.values("CAL_GYRO0_XOFF", station=station)[-1] == pytest.approx(stored)
            assert stage.double.applied(1).gyro_offset_rad_s[0] == pytest.approx(stored)
            assert [write.value for write in stage.double.writes] == [pytest.approx(-0.05)]

    run_virtual(main())


def test_biases_below_0_01_rad_s_are_left_alone_for_ever() -> None:
    async def main() -> None:
        bias = (0.0052, 0.0052, 0.0052)  # 0.3 deg/s on every axis: 0.0091 together
        async with PX4Stage(rivals=True, spec="white_only", gyro_bias=bias) as stage:
            await asyncio.sleep(60.0)
            assert stage.double.gyro_rival.commits == 0
            assert stage.double.parameter("CAL_GYRO0_XOFF") == 0.0

    run_virtual(main())


def test_a_bias_of_1_deg_s_is_written_once_and_not_refined() -> None:
    async def main() -> None:
        bias = np.radians([1.0, 1.0, 1.0])
        async with PX4Stage(rivals=True, spec="white_only", gyro_bias=bias) as stage:
            await asyncio.sleep(15.0)
            assert stage.double.gyro_rival.commits == 1
            error = stage.double.residual(1, now_s()).gyro_rad_s / DEG_H
            assert np.sqrt((error**2).mean()) < 30.0  # 13.5 in the real one, Earth's rotation included
            await asyncio.sleep(60.0)
            assert stage.double.gyro_rival.commits == 1

    run_virtual(main())


def test_the_background_calibration_is_started_at_boot_only() -> None:
    async def main() -> None:
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

    run_virtual(main())


def test_neither_armed_nor_in_somebodys_hands_does_it_write() -> None:
    async def main() -> None:
        async with PX4Stage(rivals=True) as stage:
            await asyncio.sleep(1.0)
            stage.double.arm()
            await stage.set("CAL_GYRO0_XOFF", -0.05)
            await asyncio.sleep(20.0)
            assert stage.double.gyro_rival.commits == 0
            t_s = stage.aircraft.time_at(now_s())
            stage.aircraft.add(Handling(start_s=t_s, duration_s=30.0))
            await asyncio.sleep(8.0)
            stage.double.disarm()
            await asyncio.sleep(14.0)
            assert stage.double.gyro_rival.commits == 0
            await asyncio.sleep(20.0)
            assert stage.double.gyro_rival.commits == 1

    run_virtual(main())


def test_a_gyro_without_a_slot_is_given_one_by_the_background_calibration() -> None:
    async def main() -> None:
        async with PX4Stage(rivals=True, imus=2, slots=(0, None)) as stage:
            await asyncio.sleep(15.0)
            assert stage.double.applied(2).gyro_slot == 1
            assert stage.double.parameter("CAL_GYRO1_ID") == 1310996

    run_virtual(main())


def test_an_accelerometer_without_a_slot_is_given_one_with_what_the_estimator_learned() -> None:
    async def main() -> None:
        bias = np.array([0.0, 0.0, 20.0]) * MG
        parameters = {"SENS_IMU_AUTOCAL": 1}
        async with PX4Stage(accel_bias=bias, imus=2, slots=(0, None), parameters=parameters) as stage:
            await asyncio.sleep(10.0)
            assert stage.double.applied(2).accel_slot is None
            await asyncio.sleep(2.0)
            assert stage.double.applied(2).accel_slot == 1
            assert stage.double.parameter("CAL_ACC1_ID") == 1310996
            assert stage.double.parameter("CAL_ACC1_PRIO") == 50
            assert stage.double.parameter("CAL_ACC1_ZOFF") == pytest.approx(bias[2], rel=0.02)
            assert stage.double.parameter("CAL_ACC0_ZOFF") == 0.0  # that one has a slot, and nobody armed

    run_virtual(main())


def test_what_was_learned_while_armed_is_written_at_disarm_if_it_is_worth_0_05() -> None:
    async def main() -> None:
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

    run_virtual(main())


@pytest.mark.parametrize("reason", ["small", "off", "just_changed"])
def test_nothing_is_written_at_disarm_when(reason: str) -> None:
    async def main() -> None:
        bias = np.array([0.0, 0.0, 4.0 if reason == "small" else 20.0]) * MG
        parameters = {"SENS_IMU_AUTOCAL": int(reason != "off")}
        async with PX4Stage(accel_bias=bias, parameters=parameters) as stage:
            stage.double.arm()
            await asyncio.sleep(60.0)
            if reason == "just_changed":
                await stage.set("CAL_ACC0_XOFF", 0.1)
                await asyncio.sleep(25.0)
            stage.double.disarm()
            assert stage.double.learned_offsets.commits == 0
            assert stage.double.parameter("CAL_ACC0_ZOFF") == 0.0

    run_virtual(main())
