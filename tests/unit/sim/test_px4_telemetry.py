"""Streams of the PX4 double: content, rate and receivers (autopilots 4.5, 5.1, 5.4, 9.2, 9.3.2)."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.imu_model import MG
from tests.support.px4_stage import INTERVAL, LATEST_S, POSE, REQUEST, PX4Stage, now_s

HIGHRES, SCALED, SCALED2, SCALED3, RAW = 105, 26, 116, 129, 27
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


async def test_noise_of_the_outputs_is_that_of_a_mean_over_the_interval_and_independent() -> None:
    async with PX4Stage(spec="white_only") as stage:
        heard = await stream(stage, HIGHRES, 250, 20.0, mavlink.MAVLink_highres_imu_message)
        values = np.hstack((gyro_of(heard), accel_of(heard)))[1500:]
        expected = stage.double.imus[0].white / math.sqrt(1.0 / 250.0)
        assert values.std(axis=0) == pytest.approx(expected, rel=0.06)
        centred = values - values.mean(axis=0)
        correlation = (centred[1:] * centred[:-1]).mean(axis=0) / centred.var(axis=0)
        assert np.abs(correlation).max() < 0.06


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
