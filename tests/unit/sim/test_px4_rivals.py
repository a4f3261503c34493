"""PX4's own writes (autopilots 4.3, 9.2, 9.3.2)."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from sim.imu_model import MG
from tests.support.px4_stage import PX4Stage


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
