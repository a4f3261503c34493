"""Commands to the PX4 double, its own calibrations, its texts and its routing (autopilots 4.6, 5.4, 9.2, 9.3.2)."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.imu_model import DEG_H, MG
from tests.support.px4_stage import ARM, CALIBRATE, LATEST_S, PX4Stage, now_s

CASE_B_ACCEL = np.array([30.0, -30.0, 30.0]) * MG


async def test_a_command_to_another_component_is_never_carried_out() -> None:
    async with PX4Stage() as stage:
        for target in ((1, 191), (1, 42), (2, 1)):
            assert await stage.ground.command(CALIBRATE, 1, target=target, wait_s=0.5) == -1
            assert await stage.ground.command(ARM, 1, target=target, wait_s=0.5) == -1
        assert not stage.double.armed
        assert not stage.double.calibrating
        assert await stage.ground.command(mavlink.MAV_CMD_RUN_PREARM_CHECKS, target=(0, 0)) == 0


async def test_a_gyro_calibration_is_acknowledged_at_once_and_reported_in_texts() -> None:
    async with PX4Stage(gyro_bias=np.radians([1.0, 1.0, 1.0]), spec="white_only") as stage:
        begun_s = now_s()
        assert await stage.ground.command(CALIBRATE, 1) == 0
        assert now_s() - begun_s < 0.05
        assert await stage.ground.command(CALIBRATE, 1) == 1  # busy
        while "[cal] calibration done: gyro" not in stage.ground.texts():
            await asyncio.sleep(0.01)
            assert now_s() - begun_s < 5.0
        texts = stage.ground.texts()
        assert texts[0] == "[cal] calibration started: 2 gyro"
        assert "[cal] progress <50>" in texts
        await asyncio.sleep(LATEST_S)
        error = stage.double.residual(1, now_s()).gyro_rad_s / DEG_H
        assert np.abs(error).max() < 60.0
        assert stage.acks(CALIBRATE, stage.ground) == [0, 1]  # there is no final acknowledgement


async def test_a_gyro_calibration_says_done_and_changes_nothing_below_0_01_rad_s() -> None:
    bias = np.array([1080.0, -1080.0, 1080.0]) * DEG_H
    async with PX4Stage(gyro_bias=bias, spec="white_only") as stage:
        assert await stage.ground.command(CALIBRATE, 1) == 0
        await asyncio.sleep(3.0)
        assert "[cal] calibration done: gyro" in stage.ground.texts()
        assert [stage.double.parameter(f"CAL_GYRO0_{axis}OFF") for axis in "XYZ"] == [0.0, 0.0, 0.0]
        assert stage.double.residual(1, now_s()).gyro_rad_s == pytest.approx(bias)


async def test_texts_go_only_where_a_heartbeat_of_type_gcs_is_heard() -> None:
    async with PX4Stage() as stage:
        stage.double.say(mavlink.MAV_SEVERITY_INFO, "hello")
        await asyncio.sleep(1.0)
        assert stage.ground.texts() == ["hello"]
        assert stage.companion.texts() == []
        stage.companion.heartbeat(mavlink.MAV_TYPE_GCS)
        await asyncio.sleep(0.5)
        assert stage.companion.texts() == ["hello"]  # it waited, and is not 5 s old
        await asyncio.sleep(3.0)
        stage.double.say(mavlink.MAV_SEVERITY_INFO, "later")
        await asyncio.sleep(6.0)
        stage.companion.heartbeat(mavlink.MAV_TYPE_GCS)
        await asyncio.sleep(0.5)
        assert stage.companion.texts() == ["hello"]
        long = "x" * 120
        stage.double.say(mavlink.MAV_SEVERITY_INFO, long)
        await asyncio.sleep(0.5)
        assert "".join(stage.ground.texts()[-3:]) == long


@pytest.mark.parametrize(("forward_1", "forward_0", "passes"), [(0, 1, False), (1, 0, False), (1, 1, True)])
async def test_messages_pass_only_between_ports_that_both_forward(forward_1: int, forward_0: int, passes: bool) -> None:
    parameters = {"MAV_1_FORWARD": forward_1, "MAV_0_FORWARD": forward_0}
    async with PX4Stage(parameters=parameters) as stage:
        await asyncio.sleep(2.0)
        stage.ground.send(mavlink.MAVLink_command_long_message(1, 191, 31010, 0, 0, 0, 0, 0, 0, 0, 0))
        stage.ground.send(mavlink.MAVLink_command_long_message(1, 77, 31010, 0, 0, 0, 0, 0, 0, 0, 0))
        await asyncio.sleep(0.1)
        commands = stage.companion.all(mavlink.MAVLink_command_long_message)
        assert [command.target_component for command in commands] == ([191] if passes else [])
        heard = [m for _, m in stage.ground.heard if m.get_srcComponent() == 191]
        assert bool(heard) is passes
