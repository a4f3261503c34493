"""Commands to the PX4 double, its own calibrations, its texts and its routing (autopilots 4.6, 5.4, 9.2, 9.3.2)."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import VirtualAircraft
from sim.imu_model import DEG_H, MG
from sim.motions import Handling
from tests.support.px4_stage import ARM, CALIBRATE, LATEST_S, POSE, REBOOT, PX4Stage, now_s
from tests.support.virtual_time import run_virtual

CASE_B_ACCEL = np.array([30.0, -30.0, 30.0]) * MG


def test_arming_runs_the_checks_and_disarming_does_not_ask() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            assert await stage.companion.command(ARM, 1) == 0
            assert [stage.double.armed, await stage.companion.command(ARM, 1)] == [True, 0]
            assert [await stage.companion.command(ARM, 0), stage.double.armed] == [0, False]
            await stage.set("COM_ARMABLE", 0)
            assert await stage.companion.command(ARM, 1) == 1
            assert await stage.companion.command(ARM, 1, 21196) == 1  # force from outside skips nothing
            await asyncio.sleep(1.0)
            assert "Preflight Fail: Vehicle is in safety configuration" in stage.ground.texts()

    run_virtual(main())


def test_unknown_commands_are_unsupported_and_some_are_not_answered_at_all() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            assert await stage.companion.command(mavlink.MAV_CMD_USER_1) == 3
            assert await stage.companion.command(mavlink.MAV_CMD_PREFLIGHT_SET_SENSOR_OFFSETS, wait_s=1.0) == -1

    run_virtual(main())


def test_failing_checks_are_said_by_themselves_when_they_change() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            await asyncio.sleep(5.0)
            assert stage.ground.texts() == []
            await stage.set("COM_ARMABLE", 0)
            await asyncio.sleep(10.0)
            assert stage.ground.texts() == ["Preflight Fail: Vehicle is in safety configuration"]

    run_virtual(main())


def test_a_calibration_that_there_is_not_is_accepted_and_nothing_happens() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            assert await stage.ground.command(CALIBRATE) == 0
            assert await stage.ground.command(CALIBRATE, 0, 0, 0, 0, 9) == 0
            assert not stage.double.calibrating
            assert await stage.ground.command(CALIBRATE, 0, 0, 0, 7) == 3

    run_virtual(main())


def test_a_command_to_another_component_is_never_carried_out() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            for target in ((1, 191), (1, 42), (2, 1)):
                assert await stage.ground.command(CALIBRATE, 1, target=target, wait_s=0.5) == -1
                assert await stage.ground.command(ARM, 1, target=target, wait_s=0.5) == -1
            assert not stage.double.armed
            assert not stage.double.calibrating
            assert await stage.ground.command(mavlink.MAV_CMD_RUN_PREARM_CHECKS, target=(0, 0)) == 0

    run_virtual(main())


def test_a_gyro_calibration_is_acknowledged_at_once_and_reported_in_texts() -> None:
    async def main() -> None:
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

    run_virtual(main())


def test_a_gyro_calibration_says_done_and_changes_nothing_below_0_01_rad_s() -> None:
    async def main() -> None:
        bias = np.array([1080.0, -1080.0, 1080.0]) * DEG_H
        async with PX4Stage(gyro_bias=bias, spec="white_only") as stage:
            assert await stage.ground.command(CALIBRATE, 1) == 0
            await asyncio.sleep(3.0)
            assert "[cal] calibration done: gyro" in stage.ground.texts()
            assert [stage.double.parameter(f"CAL_GYRO0_{axis}OFF") for axis in "XYZ"] == [0.0, 0.0, 0.0]
            assert stage.double.residual(1, now_s()).gyro_rad_s == pytest.approx(bias)

    run_virtual(main())


def test_a_gyro_calibration_of_a_moving_vehicle_fails_after_twenty_tries() -> None:
    async def main() -> None:
        aircraft = VirtualAircraft(POSE, motions=[Handling(start_s=0.0, duration_s=60.0)])
        async with PX4Stage(aircraft=aircraft) as stage:
            assert await stage.ground.command(CALIBRATE, 1) == 0
            await asyncio.sleep(30.0)
            assert "motion, retrying.." in stage.ground.texts()
            assert stage.ground.texts()[-1] == "[cal] calibration failed: gyro"

    run_virtual(main())


def test_the_quick_accelerometer_calibration_of_a_tilted_vehicle_leaves_the_horizontal_biases_and_finds_z() -> None:
    async def main() -> None:
        async with PX4Stage(accel_bias=CASE_B_ACCEL, gyro_bias=(0, 0, 0), spec="white_only") as stage:
            assert await stage.ground.command(CALIBRATE, 0, 0, 0, 0, 4) == 0
            await asyncio.sleep(2.0 * LATEST_S)
            left = stage.double.residual(1, now_s()).accel_m_s2 / MG
            # 25 mg rms of 30 in the real one: x, y not corrected, z right to 1 or 2 mg.
            assert np.abs(left[:2]).min() > 20.0
            assert abs(left[2]) < 5.0
            assert not [text for text in stage.ground.texts() if "accel" in text]

    run_virtual(main())


def test_the_level_calibration_puts_the_whole_tilt_into_the_board_rotation() -> None:
    async def main() -> None:
        async with PX4Stage(accel_bias=(0, 0, 0), gyro_bias=(0, 0, 0)) as stage:
            assert await stage.ground.command(CALIBRATE, 0, 0, 0, 0, 2) == 0
            await asyncio.sleep(3.0)
            assert stage.double.parameter("SENS_BOARD_X_OFF") == pytest.approx(-3.0, abs=0.1)  # -2.857 and 5.094
            assert stage.double.parameter("SENS_BOARD_Y_OFF") == pytest.approx(5.0, abs=0.1)
            await asyncio.sleep(20.0)
            roll, pitch, _ = np.degrees(stage.double.estimated_angles_rad(now_s()))
            assert abs(pitch) < 2.0  # 0.0 and 0.7 five seconds after it in the real one, still moving
            assert abs(roll) < 2.0
            assert "[cal] calibration done: level" in stage.ground.texts()

    run_virtual(main())


def test_calibrations_are_turned_away_while_armed_and_arming_while_calibrating() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            stage.double.arm()
            assert await stage.companion.command(CALIBRATE, 1) == 1
            stage.double.disarm()
            assert await stage.companion.command(CALIBRATE, 1) == 0
            assert await stage.companion.command(ARM, 1) == 1
            await asyncio.sleep(3.0)
            assert "Arming denied: calibrating\t" in stage.ground.texts()
            assert await stage.companion.command(ARM, 1) == 0

    run_virtual(main())


def test_texts_go_only_where_a_heartbeat_of_type_gcs_is_heard() -> None:
    async def main() -> None:
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

    run_virtual(main())


@pytest.mark.parametrize(("forward_1", "forward_0", "passes"), [(0, 1, False), (1, 0, False), (1, 1, True)])
def test_messages_pass_only_between_ports_that_both_forward(forward_1: int, forward_0: int, passes: bool) -> None:
    async def main() -> None:
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

    run_virtual(main())


def test_by_default_a_companion_on_telem2_is_invisible_to_the_ground_and_forwarding_needs_a_reboot() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            await stage.set("MAV_1_FORWARD", 1)
            await asyncio.sleep(5.0)
            assert not [m for _, m in stage.ground.heard if m.get_srcComponent() == 191]
            assert await stage.companion.command(REBOOT, 1) == 0
            await asyncio.sleep(10.0)
            assert [m for _, m in stage.ground.heard if m.get_srcComponent() == 191]

    run_virtual(main())


def test_acknowledgements_go_where_the_sender_was_heard() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            assert await stage.companion.command(mavlink.MAV_CMD_RUN_PREARM_CHECKS) == 0
            assert stage.acks(mavlink.MAV_CMD_RUN_PREARM_CHECKS, stage.ground) == []

    run_virtual(main())


def test_odd_values_in_commands_do_not_stop_it() -> None:
    nan = float("nan")

    async def main() -> None:
        async with PX4Stage() as stage:
            for number in (400, 511, 510, 512, 241, 245, 246, 401, 3001):
                for value in (nan, float("inf"), -1e30, 1e30, -1.0, 7.0):
                    params = (value,) * 7
                    stage.companion.send(mavlink.MAVLink_command_long_message(1, 1, number, 0, *params))
                    stage.companion.send(
                        mavlink.MAVLink_command_int_message(1, 1, 0, number, 0, 0, *params[:4], 2147483647, 0, value)
                    )
                    await asyncio.sleep(0.01)
            await asyncio.sleep(30.0)
            assert len(await stage.companion.read_parameter("CAL_ACC0_XOFF")) == 1

    run_virtual(main())
