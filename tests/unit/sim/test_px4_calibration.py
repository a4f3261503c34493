"""Which offset a PX4 works with, whatever its parameters say (autopilots 4.1, 4.2, 9.2, 9.3.2)."""

from __future__ import annotations

import asyncio

import pytest

from sim.earth import mounting_matrix
from tests.support.px4_stage import ARM, GYRO_BIAS, LATEST_S, PX4Stage, now_s

ZERO = pytest.approx([0.0, 0.0, 0.0])


async def test_slots_are_found_by_device_id_not_by_number() -> None:
    async with PX4Stage(imus=2, slots=(2, 0)) as stage:
        assert [stage.double.applied(n).gyro_slot for n in (1, 2)] == [2, 0]
        await stage.set_vector(2, "GYRO", (0.02, 0.03, 0.04))
        await stage.set_vector(0, "ACC", (0.2, 0.3, 0.4))
        first, second = stage.double.applied(1), stage.double.applied(2)
        assert first.gyro_offset_rad_s == pytest.approx([0.02, 0.03, 0.04])
        assert second.accel_offset_m_s2 == pytest.approx([0.2, 0.3, 0.4])
        assert second.gyro_offset_rad_s == ZERO
        assert first.accel_offset_m_s2 == ZERO
        assert stage.double.residual(1, now_s()).gyro_rad_s == pytest.approx(GYRO_BIAS - [0.02, 0.03, 0.04])


async def test_scale_comes_after_the_offset_and_the_rotations_after_both() -> None:
    angles = (1.5, -2.5, 4.0)
    parameters = {f"SENS_BOARD_{axis}_OFF": value for axis, value in zip("XYZ", angles, strict=True)}
    parameters |= {"SENS_BOARD_ROT": 2, "CAL_ACC0_XOFF": 0.5, "CAL_ACC0_XSCALE": 1.05, "CAL_GYRO0_YOFF": 0.02}
    async with PX4Stage(parameters=parameters, gyro_bias=(0, 0, 0), accel_bias=(0, 0, 0)) as stage:
        truth = stage.aircraft.truth_at(0.0)
        turn = mounting_matrix(*angles) @ mounting_matrix(0.0, 0.0, 90.0)
        force = turn @ ((truth.force_m_s2 - [0.5, 0.0, 0.0]) * [1.05, 1.0, 1.0])
        rate = turn @ (truth.rate_rad_s - [0.0, 0.02, 0.0])
        left = stage.double.residual(1, now_s())
        assert left.accel_m_s2 + truth.force_m_s2 == pytest.approx(force, abs=1e-6)
        assert left.gyro_rad_s + truth.rate_rad_s == pytest.approx(rate, abs=1e-9)


async def test_an_external_imu_turns_with_its_own_rotation_and_with_the_level_offsets() -> None:
    parameters = {"SENS_BOARD_ROT": 4, "CAL_ACC0_ROT": 6, "CAL_GYRO0_ROT": 6, "SENS_BOARD_X_OFF": 3.0}
    async with PX4Stage(parameters=parameters, external=(0,)) as stage:
        turn = mounting_matrix(3.0, 0.0, 0.0) @ mounting_matrix(0.0, 0.0, 270.0)
        assert stage.double.applied(1).rotation == pytest.approx(turn)
    async with PX4Stage(parameters=parameters) as stage:
        turn = mounting_matrix(3.0, 0.0, 0.0) @ mounting_matrix(0.0, 0.0, 180.0)
        assert stage.double.applied(1).rotation == pytest.approx(turn)


@pytest.mark.parametrize("kind", ["GYRO", "ACC"])
async def test_a_vector_within_0_01_of_the_one_in_use_is_stored_and_read_back_and_ignored(kind: str) -> None:
    async with PX4Stage() as stage:
        await stage.set_vector(0, kind, (0.0057, -0.0057, 0.0057))  # 0.00987 long
        assert stage.double.parameter(f"CAL_{kind}0_XOFF") == pytest.approx(0.0057)
        assert stage.values(f"CAL_{kind}0_XOFF")[-1] == pytest.approx(0.0057)
        used = stage.double.applied(1)
        assert (used.gyro_offset_rad_s if kind == "GYRO" else used.accel_offset_m_s2) == ZERO
        await stage.set_vector(0, kind, (0.0059, -0.0059, 0.0059))  # 0.01022
        used = stage.double.applied(1)
        taken = used.gyro_offset_rad_s if kind == "GYRO" else used.accel_offset_m_s2
        assert taken == pytest.approx([0.0059, -0.0059, 0.0059])


async def test_three_writes_leave_a_mixed_vector_when_the_last_step_is_small() -> None:
    async with PX4Stage() as stage:
        await stage.set("CAL_GYRO0_XOFF", 0.015)
        await asyncio.sleep(2.0 * LATEST_S)
        await stage.set("CAL_GYRO0_YOFF", 0.005)
        await asyncio.sleep(2.0 * LATEST_S)
        assert stage.double.parameter("CAL_GYRO0_YOFF") == pytest.approx(0.005)
        assert stage.double.applied(1).gyro_offset_rad_s == pytest.approx([0.015, 0.0, 0.0])


async def test_the_first_gyro_load_takes_any_vector_but_an_accelerometer_never_takes_a_small_one() -> None:
    async with PX4Stage() as stage:
        await stage.set_vector(0, "GYRO", (0.001, 0.002, -0.001))
        await stage.set_vector(0, "ACC", (0.005, -0.004, 0.003))
        assert stage.double.applied(1).gyro_offset_rad_s == ZERO
        stage.double.reboot(1.0)
        await asyncio.sleep(2.0)
        assert stage.double.parameter("CAL_ACC0_XOFF") == pytest.approx(0.005)
        assert stage.double.applied(1).gyro_offset_rad_s == pytest.approx([0.001, 0.002, -0.001])
        assert stage.double.applied(1).accel_offset_m_s2 == ZERO


@pytest.mark.parametrize(("kind", "far"), [("GYRO", 0.02), ("ACC", 0.05)])
async def test_a_far_offset_first_and_the_wanted_one_2_5_s_later_is_taken_without_reboot(kind: str, far: float) -> None:
    async with PX4Stage() as stage:
        wanted = (0.0031, 0.0020, -0.0041)
        await stage.set_vector(0, kind, (far, far, far), settle=False)
        await asyncio.sleep(2.5)
        await stage.set_vector(0, kind, wanted)
        used = stage.double.applied(1)
        taken = used.gyro_offset_rad_s if kind == "GYRO" else used.accel_offset_m_s2
        assert taken == pytest.approx(wanted, rel=1e-6)


async def test_an_effect_comes_within_4_ms_after_a_quiet_second_and_otherwise_up_to_a_second_later() -> None:
    async with PX4Stage() as stage:
        stage.companion_wire.delay_s = (0.0, 0.0)

        async def delay_of(value: float) -> float:
            begun_s = now_s()
            await stage.set("CAL_ACC0_XOFF", value)
            while abs(stage.double.applied(1).accel_offset_m_s2[0] - value) > 1e-6:
                await asyncio.sleep(0.001)
                assert now_s() - begun_s < 2.0
            return now_s() - begun_s

        await asyncio.sleep(3.0)
        assert await delay_of(0.1) < 0.012  # 4 ms and this test's own 10
        assert await delay_of(0.2) < 0.012  # what a second of quiet has saved up
        assert 0.9 < await delay_of(0.3) < 1.01
        await asyncio.sleep(0.6)
        assert await delay_of(0.4) == pytest.approx(0.4, abs=0.03)


async def test_a_device_without_a_slot_uses_no_offset_and_keeps_the_vehicle_from_arming() -> None:
    async with PX4Stage(imus=2, slots=(0, None)) as stage:
        assert stage.double.applied(2).gyro_slot is None
        assert stage.double.prearm_failures(now_s()) == ["Accel 1 uncalibrated", "Gyro 1 uncalibrated"]
        assert await stage.companion.command(ARM, 1) == 1


async def test_a_slot_whose_id_is_zero_loses_its_sensor_and_arming_says_accel_0_uncalibrated() -> None:
    async with PX4Stage(parameters={"CAL_ACC0_XOFF": 0.3}) as stage:
        number = stage.double.parameter("CAL_ACC0_ID")
        assert stage.double.applied(1).accel_offset_m_s2 == pytest.approx([0.3, 0.0, 0.0])
        await stage.set("CAL_ACC0_ID", 0)
        await asyncio.sleep(LATEST_S)
        assert stage.double.applied(1).accel_offset_m_s2 == ZERO
        assert await stage.ground.command(ARM, 1) == 1
        await asyncio.sleep(1.0)
        assert "Preflight Fail: Accel 0 uncalibrated" in stage.ground.texts()
        assert not stage.double.armed
        await stage.set("CAL_ACC0_ID", number)
        await asyncio.sleep(LATEST_S)
        assert stage.double.applied(1).accel_offset_m_s2 == pytest.approx([0.3, 0.0, 0.0])
        await asyncio.sleep(10.0)
        assert await stage.ground.command(ARM, 1) == 0
