"""What the PX4 double sends, how often and to whom (autopilots 4.5, 5.1, 5.4, 9.2, 9.3.2)."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.earth import STANDARD_GRAVITY_M_S2
from sim.imu_model import DEG_H, MG
from tests.support.px4_stage import ACCEL_BIAS, GYRO_BIAS, INTERVAL, LATEST_S, POSE, REQUEST, PX4Stage, now_s

HIGHRES, SCALED, SCALED2, SCALED3, RAW = 105, 26, 116, 129, 27
MILLI_G = STANDARD_GRAVITY_M_S2 / 1000.0
BIG_ACCEL = np.array([30.0, -30.0, 30.0]) * MG


def gyro_of(messages: list[Any]) -> np.ndarray:
    return np.array([[m.xgyro, m.ygyro, m.zgyro] for m in messages], dtype=float)


def accel_of(messages: list[Any]) -> np.ndarray:
    return np.array([[m.xacc, m.yacc, m.zacc] for m in messages], dtype=float)


async def stream(stage: PX4Stage, message_id: int, rate_hz: float, over_s: float, kind: type[Any]) -> list[Any]:
    assert await stage.companion.command(INTERVAL, message_id, 1e6 / rate_hz) == 0
    since_s = now_s()
    await asyncio.sleep(over_s)
    heard: list[Any] = stage.companion.all(kind, since_s=since_s)
    return heard


async def test_scaled_imu_is_the_corrected_sensor_truncated_toward_zero() -> None:
    parameters = {"CAL_GYRO0_XOFF": 0.0123, "CAL_ACC0_YOFF": -0.2}
    async with PX4Stage(parameters=parameters) as stage:
        await asyncio.sleep(30.0)  # whatever the estimator has learned does not matter
        heard = await stream(stage, SCALED, 50, 1.0, mavlink.MAVLink_scaled_imu_message)
        truth = stage.aircraft.truth_at(0.0)
        rate = (truth.rate_rad_s + GYRO_BIAS - [0.0123, 0.0, 0.0]) * 1000.0
        force = (truth.force_m_s2 + ACCEL_BIAS + [0.0, 0.2, 0.0]) / MILLI_G
        assert np.all(gyro_of(heard) == np.trunc(rate))
        assert np.all(accel_of(heard) == np.trunc(force))
        assert gyro_of(heard)[0].tolist() == [-11.0, 0.0, 0.0]  # -11.77, -0.32, 0.78


async def test_noise_of_the_outputs_is_that_of_a_mean_over_the_interval_and_independent() -> None:
    async with PX4Stage(spec="white_only") as stage:
        heard = await stream(stage, HIGHRES, 250, 20.0, mavlink.MAVLink_highres_imu_message)
        values = np.hstack((gyro_of(heard), accel_of(heard)))[1500:]
        expected = stage.double.imus[0].white / math.sqrt(1.0 / 250.0)
        assert values.std(axis=0) == pytest.approx(expected, rel=0.06)
        centred = values - values.mean(axis=0)
        correlation = (centred[1:] * centred[:-1]).mean(axis=0) / centred.var(axis=0)
        assert np.abs(correlation).max() < 0.06


async def test_highres_imu_gyro_tends_to_the_true_rate_whatever_the_calibration() -> None:
    async with PX4Stage(parameters={"CAL_GYRO0_XOFF": -0.05}) as stage:
        heard = await stream(stage, HIGHRES, 50, 10.0, mavlink.MAVLink_highres_imu_message)
        earth = stage.aircraft.truth_at(0.0).rate_rad_s
        assert gyro_of(heard[-50:]).mean(axis=0) == pytest.approx(earth, abs=4.0 * DEG_H)  # it wanders
        assert heard[-1].id == 0


async def test_scaled_imu_2_and_3_are_acknowledged_but_never_arrive_with_one_imu() -> None:
    async with PX4Stage() as stage:
        assert await stream(stage, SCALED2, 50, 1.0, mavlink.MAVLink_scaled_imu2_message) == []
        assert await stream(stage, SCALED3, 50, 1.0, mavlink.MAVLink_scaled_imu3_message) == []
    async with PX4Stage(imus=3) as stage:
        assert len(await stream(stage, SCALED2, 50, 1.0, mavlink.MAVLink_scaled_imu2_message)) > 40
        assert len(await stream(stage, SCALED3, 50, 1.0, mavlink.MAVLink_scaled_imu3_message)) > 40


async def test_raw_imu_does_not_exist_and_heartbeats_cannot_be_had_faster() -> None:
    async with PX4Stage() as stage:
        assert await stage.companion.command(INTERVAL, RAW, 20000) == 4
        assert await stage.companion.command(INTERVAL, 0, 200000) == 4
        assert await stage.companion.command(INTERVAL, SCALED, 20000, 1.0) == 4
        begun = len(stage.companion.all(mavlink.MAVLink_heartbeat_message))
        await asyncio.sleep(10.0)
        assert len(stage.companion.all(mavlink.MAVLink_heartbeat_message)) - begun == pytest.approx(10, abs=1)


@pytest.mark.parametrize(
    ("asked_hz", "seen_hz"), [(50, 50), (100, 100), (200, 125), (250, 250), (400, 250), (1000, 250)]
)
async def test_rates_are_quantised_by_the_250_hz_of_the_sensor(asked_hz: int, seen_hz: int) -> None:
    async with PX4Stage() as stage:
        heard = await stream(stage, SCALED, asked_hz, 10.0, mavlink.MAVLink_scaled_imu_message)
        assert len(heard) / 10.0 == pytest.approx(seen_hz, rel=0.02)
        times = [m.time_boot_ms for m in heard]
        assert len(set(times)) == len(times)


async def test_the_attitude_has_swallowed_the_accelerometer_bias_and_keeps_it_until_a_reboot() -> None:
    async with PX4Stage(accel_bias=BIG_ACCEL, gyro_bias=(0.0, 0.0, 0.0)) as stage:

        async def errors_deg() -> tuple[float, float]:
            assert await stage.companion.command(REQUEST, 30) == 0
            last = stage.companion.all(mavlink.MAVLink_attitude_message)[-1]
            return math.degrees(last.pitch) - POSE.pitch_deg, math.degrees(last.roll) - POSE.roll_deg

        await asyncio.sleep(60.0)
        before = await errors_deg()
        assert before == pytest.approx((1.72, 1.72), abs=0.01)  # 30 mg in rad: the real one had 1.91 and 1.66
        x, y, z = BIG_ACCEL
        await stage.set_vector(0, "ACC", (0.05, 0.05, 0.05), settle=False)
        await asyncio.sleep(2.5)
        await stage.set_vector(0, "ACC", (x, y, z))
        await asyncio.sleep(170.0)
        late = await errors_deg()
        assert 0.6 < late[0] / before[0] < 0.95  # 1.51 of 1.91
        assert 0.6 < late[1] / before[1] < 0.95  # 1.31 of 1.66
        assert stage.double.residual(1, now_s()).accel_m_s2 == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)
        stage.double.reboot(1.0)
        await asyncio.sleep(2.0)
        assert await errors_deg() == pytest.approx((0.0, 0.0), abs=0.001)


async def test_a_gyro_offset_that_is_taken_clears_the_estimators_bias_and_one_that_is_not_does_not() -> None:
    async with PX4Stage(gyro_bias=(0.006, 0.0, 0.0)) as stage:
        await asyncio.sleep(20.0)
        estimator = stage.double.vehicle_imus[0].estimator
        stage.double.update_estimators(now_s())
        assert estimator.gyro_bias_rad_s[0] == pytest.approx(0.006, rel=0.01)
        await stage.set("CAL_GYRO0_XOFF", 0.006)
        await asyncio.sleep(LATEST_S)
        assert estimator.gyro_bias_rad_s[0] == pytest.approx(0.006, rel=0.01)
        await stage.set("CAL_GYRO0_XOFF", 0.016)
        assert abs(estimator.gyro_bias_rad_s[0]) < 0.001
