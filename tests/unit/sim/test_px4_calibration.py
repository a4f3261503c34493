"""Offset in use in a PX4, against its parameters (autopilots 4.1, 4.2, 9.2, 9.3.2)."""

from __future__ import annotations

import asyncio

import pytest

from sim.earth import mounting_matrix
from tests.support.px4_stage import ARM, GYRO_BIAS, LATEST_S, PX4Stage, now_s

ZERO = pytest.approx([0.0, 0.0, 0.0])


async def test_slots_are_found_by_device_id_not_by_number() -> None:
    async with PX4Stage(imus=2, slots=(2, 0)) as stage:
        assert [imu.gyro.slot for imu in stage.double.vehicle_imus] == [2, 0]
        await stage.set_vector(2, "GYRO", (0.02, 0.03, 0.04))
        await stage.set_vector(0, "ACC", (0.2, 0.3, 0.4))
        first, second = stage.double.vehicle_imus
        assert first.gyro.offset == pytest.approx([0.02, 0.03, 0.04])
        assert second.accel.offset == pytest.approx([0.2, 0.3, 0.4])
        assert second.gyro.offset == ZERO
        assert first.accel.offset == ZERO
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
        assert stage.double.vehicle_imus[0].accel.rotation == pytest.approx(turn)
    async with PX4Stage(parameters=parameters) as stage:
        turn = mounting_matrix(3.0, 0.0, 0.0) @ mounting_matrix(0.0, 0.0, 180.0)
        assert stage.double.vehicle_imus[0].accel.rotation == pytest.approx(turn)


async def test_a_slot_whose_id_is_zero_loses_its_sensor_and_arming_says_accel_0_uncalibrated() -> None:
    async with PX4Stage(parameters={"CAL_ACC0_XOFF": 0.3}) as stage:
        number = stage.double.parameter("CAL_ACC0_ID")
        assert stage.double.vehicle_imus[0].accel.offset == pytest.approx([0.3, 0.0, 0.0])
        await stage.set("CAL_ACC0_ID", 0)
        await asyncio.sleep(LATEST_S)
        assert stage.double.vehicle_imus[0].accel.offset == ZERO
        assert await stage.ground.command(ARM, 1) == 1
        await asyncio.sleep(1.0)
        assert "Preflight Fail: Accel 0 uncalibrated" in stage.ground.texts()
        assert not stage.double.armed
        await stage.set("CAL_ACC0_ID", number)
        await asyncio.sleep(LATEST_S)
        assert stage.double.vehicle_imus[0].accel.offset == pytest.approx([0.3, 0.0, 0.0])
        await asyncio.sleep(10.0)
        assert await stage.ground.command(ARM, 1) == 0
