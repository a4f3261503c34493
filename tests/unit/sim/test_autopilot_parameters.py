"""The double's parameter protocol, commands, routing and faults (autopilots 1.3 to 1.5, 3, 5.4, 7.5, 9.1)."""

from __future__ import annotations

import asyncio
import math
import struct
from typing import Any, Self

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import Pose, VirtualAircraft
from sim.ardupilot.double import ArduPilotDouble, offset_names
from sim.imu_model import DEG_H, MG, ImuModel
from sim.motions import Handling
from sim.station import Station
from tests.support.virtual_time import run_virtual
from tests.support.wire import Wire

GYRO_BIAS = np.array([100.0, -60.0, 170.0]) * DEG_H
ACCEL_BIAS = np.array([1.0, -2.0, 3.0]) * MG
POSE = Pose(5.0, -3.0, 40.0)
CALIBRATE = mavlink.MAV_CMD_PREFLIGHT_CALIBRATION
ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM


class Stage:
    """A double, a companion (1/191) and a ground station (255/190), each on its own wire."""

    def __init__(self, **options: Any) -> None:
        aircraft = options.pop("aircraft", None) or VirtualAircraft(POSE)
        spec, count = options.pop("spec", "white_only"), options.pop("imus", 1)
        imus = [
            ImuModel(aircraft, spec, seed=n, gyro_bias_rad_s=GYRO_BIAS, accel_bias_m_s2=ACCEL_BIAS)
            for n in range(count)
        ]
        options["parameters"] = {"INS_GYR_CAL": 0, **options.pop("parameters", {})}
        self.double = ArduPilotDouble(aircraft, imus, **options)
        self.companion, self.ground = Station(1, 191), Station(255, 190)
        Wire(self.companion, self.double, seed=1)
        Wire(self.ground, self.double.ground, seed=2)
        self._running: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        self._running = asyncio.create_task(self.double.run())
        await asyncio.sleep(0.05)
        return self

    async def __aexit__(self, *_: object) -> None:
        assert self._running is not None
        self._running.cancel()
        await asyncio.gather(self._running, return_exceptions=True)


async def test_a_write_is_stored_as_float32_and_echoed_to_everyone_with_index_65535() -> None:
    async with Stage() as stage:
        echo = await stage.companion.set_parameter("INS_GYROFFS_Y", 1.0 / 3000.0)
        nearest = struct.unpack("<f", struct.pack("<f", 1.0 / 3000.0))[0]
        assert echo == [nearest]
        assert stage.double.parameter("INS_GYROFFS_Y") == nearest
        values = stage.ground.all(mavlink.MAVLink_param_value_message)
        assert [(v.param_id, v.param_index) for v in values] == [("INS_GYROFFS_Y", 65535)]
        assert await stage.companion.read_parameter("INS_GYROFFS_Y") == [nearest]
        stage.double.set_parameter("INS_GYROFFS_Z", 1.0 / 3000.0)
        assert stage.double.parameter("INS_GYROFFS_Z") == nearest


async def test_writing_x_of_a_vector_emits_x_y_and_z() -> None:
    async with Stage() as stage:
        await stage.companion.set_parameter("INS_ACC2OFFS_X", 0.25)
        names = [value.param_id for value in stage.companion.all(mavlink.MAVLink_param_value_message)]
        assert names == ["INS_ACC2OFFS_X", "INS_ACC2OFFS_Y", "INS_ACC2OFFS_Z"]


async def test_names_of_three_instances_exist_and_acc1offs_does_not() -> None:
    async with Stage() as stage:
        for instance in (1, 2, 3):
            for kind in ("gyro", "accel", "scale"):
                for name in offset_names(instance, kind):
                    assert len(await stage.companion.read_parameter(name)) == 1
        assert offset_names(1, "accel")[0] == "INS_ACCOFFS_X"
        assert await stage.companion.set_parameter("INS_ACC1OFFS_X", 1.0) == []
        error = stage.companion.all(mavlink.MAVLink_param_error_message)[0]
        assert (error.param_id, error.error) == ("INS_ACC1OFFS_X", 1)
        assert (error.target_system, error.target_component) == (1, 191)
        for _ in range(16):
            assert await stage.companion.read_parameter("INS_ACC1OFFS_X") == []
        errors = [len(each.all(mavlink.MAVLink_param_error_message)) for each in (stage.companion, stage.ground)]
        # The error to a read leaves by whichever link is served first.
        assert (sum(errors), min(errors) > 0) == (17, True)


async def test_a_gyro_calibration_writes_temperatures_and_all_instances_and_announces_them() -> None:
    async with Stage(imus=2, auxiliary=True, parameters={"INS_GYR3OFFS_Y": 0.2, "INS_GYR3_ID": 7}) as stage:
        double = stage.double
        assert await stage.companion.command(CALIBRATE, 1, wait_s=2.0) == 0
        names = [name for instance in (1, 2, 4) for name in offset_names(instance, "gyro")]
        assert all(double.parameter(name) for name in names)
        assert double.parameter("INS_GYR1_CALTEMP") == double.parameter("INS_GYR2_CALTEMP") == 25.0
        assert double.parameter("INS_GYR3OFFS_Y") == double.parameter("INS_GYR3_ID") == 0.0
        await asyncio.sleep(0.5)
        told = {message.param_id for message in stage.ground.all(mavlink.MAVLink_param_value_message)}
        assert {*names, "INS_GYR2_CALTEMP", "INS_GYR3OFFS_Y"} <= told


async def test_a_gyro_calibration_that_does_not_converge_is_stored_and_blocks_arming_until_a_boot() -> None:
    async with Stage() as stage:
        stage.double.faults.gyro_calibration_fails = True
        stage.companion.send(mavlink.MAVLink_command_long_message(1, 1, CALIBRATE, 0, 1, 0, 0, 0, 0, 0, 0))
        await asyncio.sleep(31.0)
        assert stage.companion.all(mavlink.MAVLink_command_ack_message)[-1].result == 4
        assert stage.double.parameter("INS_GYROFFS_X") != 0.0
        assert stage.double.parameter("INS_GYR1_CALTEMP") == -300.0
        assert await stage.ground.command(ARM, 1) == 4
        assert "Arm: Gyros not calibrated" in stage.ground.texts()
        stage.double.reboot(down_s=1.0)
        await asyncio.sleep(1.5)
        assert await stage.ground.command(ARM, 1) == 0


@pytest.mark.parametrize("version", ["4.3", "4.6"])
async def test_before_4_7_an_unknown_name_is_answered_with_silence(version: str) -> None:
    async with Stage(version=version) as stage:
        assert await stage.companion.read_parameter("NO_SUCH") == []
        assert await stage.companion.set_parameter("NO_SUCH", 1.0) == []
        assert stage.companion.all(mavlink.MAVLink_param_error_message) == []


@pytest.mark.parametrize(("version", "renamed"), [("4.3", False), ("4.6", False), ("4.7", True), ("4.8", True)])
def test_4_7_renamed_sysid_thismav_sr_and_arming_check(version: str, renamed: bool) -> None:
    double = Stage(version=version, auxiliary=True).double
    old = {"SYSID_THISMAV", "SYSID_MYGCS", "SR0_RAW_SENS", "ARMING_CHECK"}
    new = {"MAV_SYSID", "MAV_GCS_SYSID", "MAV1_RAW_SENS", "ARMING_SKIPCHK"}
    names = set(double.parameters.names)
    assert (new if renamed else old) <= names
    assert not (old if renamed else new) & names
    assert ("INS4_GYROFFS_X" in names) == (version != "4.3")  # from 4.4 on


@pytest.mark.parametrize(
    ("version", "word", "armed"), [("4.5", 21196, False), ("4.5", 2989, True), ("4.6", 21196, True)]
)
async def test_arming_is_forced_by_2989_and_from_4_6_on_by_21196(version: str, word: int, armed: bool) -> None:
    async with Stage(version=version, parameters=dict.fromkeys(offset_names(1, "accel"), 0.0)) as stage:
        await stage.ground.command(ARM, 1, word)
        assert stage.double.armed == armed


async def test_the_whole_list_is_paced_with_true_indices_and_slows_the_streams() -> None:
    async with Stage() as stage:
        await stage.companion.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_HIGHRES_IMU, 5000)
        since_s = asyncio.get_running_loop().time()
        stage.companion.send(mavlink.MAVLink_param_request_list_message(1, 1))
        await asyncio.sleep(1.0)
        values = stage.companion.timed(mavlink.MAVLink_param_value_message, since_s=since_s)
        count = values[0][1].param_count
        assert sorted(value.param_index for _, value in values) == list(range(count))
        assert len({value.param_id for _, value in values}) == count
        taken_s = values[-1][0] - values[0][0]
        assert taken_s == pytest.approx(count * 0.00176, rel=0.1)
        streamed = stage.companion.timed(mavlink.MAVLink_highres_imu_message, since_s=since_s)
        during = sum(1 for t_s, _ in streamed if t_s - since_s < taken_s)
        assert during / taken_s == pytest.approx(50.0, rel=0.25)
        assert stage.ground.all(mavlink.MAVLink_param_value_message) == []


async def test_writes_while_armed_are_accepted_and_witnessed() -> None:
    async with Stage() as stage:
        await stage.companion.set_parameter("INS_GYROFFS_X", 0.001)
        stage.double.arm()
        assert await stage.ground.set_parameter("INS_GYROFFS_Z", 0.002) == [pytest.approx(0.002)]
        seen = [(w.name, round(w.value, 6), w.armed, w.component_id) for w in stage.double.writes]
        assert seen == [("INS_GYROFFS_X", 0.001, False, 191), ("INS_GYROFFS_Z", 0.002, True, 190)]
        assert stage.double.writes[0].t_s == pytest.approx(1000.05, abs=0.01)


async def test_parameters_survive_a_reboot_and_nothing_else_does() -> None:
    async with Stage() as stage:
        await stage.companion.set_parameter("INS_ACCOFFS_X", 0.301)
        await stage.companion.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_HIGHRES_IMU, 10000)
        await asyncio.sleep(1.0)
        before = stage.companion.all(mavlink.MAVLink_highres_imu_message)[-1].time_usec
        assert await stage.companion.command(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1) == 0
        await asyncio.sleep(1.0)
        quiet_s = asyncio.get_running_loop().time()
        assert await stage.companion.read_parameter("INS_ACCOFFS_X") == []
        await asyncio.sleep(3.0)
        assert stage.double.boots == 2
        assert stage.companion.all(mavlink.MAVLink_highres_imu_message, since_s=quiet_s) == []
        assert await stage.companion.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 105, 10000) == 0
        await asyncio.sleep(0.1)
        assert stage.companion.all(mavlink.MAVLink_highres_imu_message)[-1].time_usec < before - 10_000_000
        assert await stage.companion.read_parameter("INS_ACCOFFS_X") == [pytest.approx(0.301)]


async def test_a_boot_with_ins_gyr_cal_throws_the_offsets_away_and_swallows_the_earths_rotation() -> None:
    async with Stage(parameters={"INS_GYR_CAL": 1}) as stage:
        rate = stage.double.aircraft.truth_at(0.0).rate_rad_s
        names = offset_names(1, "gyro")
        at_start = np.array([stage.double.parameter(name) for name in names])
        assert at_start == pytest.approx(GYRO_BIAS + rate, abs=40.0 * DEG_H)
        for name in names:
            await stage.companion.set_parameter(name, 0.5)
        stage.double.reboot()
        await asyncio.sleep(3.0)
        after = np.array([stage.double.parameter(name) for name in names])
        assert after == pytest.approx(GYRO_BIAS + rate, abs=40.0 * DEG_H)
        assert not np.array_equal(after, at_start)


def test_the_gyro_calibration_takes_half_a_second_and_errs_by_earth_rate_and_white_noise() -> None:
    errors = []

    async def main() -> None:
        async with Stage() as stage:
            rate = stage.double.aircraft.truth_at(0.0).rate_rad_s
            loop = asyncio.get_running_loop()
            for _ in range(40):
                begun_s = loop.time()
                assert await stage.companion.command(CALIBRATE, 1) == 0
                assert 0.5 < loop.time() - begun_s < 0.6
                found = [stage.double.parameter(name) for name in offset_names(1, "gyro")]
                errors.append((found - GYRO_BIAS - rate) / DEG_H)
            assert stage.double.parameter("INS_GYR1_CALTEMP") == 25.0

    run_virtual(main())
    assert np.array(errors).std() == pytest.approx(7.1 / math.sqrt(0.5), rel=0.2)  # 9.9 was seen
    assert np.abs(np.mean(errors, axis=0)).max() < 5.0


async def test_a_repeated_gyro_calibration_is_accepted_too_early_while_offsets_read_zero() -> None:
    async with Stage(parameters={"INS_GYROFFS_X": 0.3}) as stage:
        stage.companion.send(mavlink.MAVLink_command_long_message(1, 1, CALIBRATE, 0, 1, 0, 0, 0, 0, 0, 0))
        await asyncio.sleep(0.2)
        since_s = asyncio.get_running_loop().time()
        assert await stage.companion.command(CALIBRATE, 1, wait_s=0.1) == 0
        assert asyncio.get_running_loop().time() - since_s < 0.05
        assert await stage.companion.read_parameter("INS_GYROFFS_X") == [0.0]
        await asyncio.sleep(0.5)
        assert len(stage.companion.all(mavlink.MAVLink_command_ack_message)) == 2
        assert stage.double.parameter("INS_GYROFFS_X") not in (0.0, 0.3)


async def test_a_calibration_waits_for_stillness_and_is_refused_while_armed() -> None:
    aircraft = VirtualAircraft(POSE, motions=[Handling(start_s=0.0, duration_s=8.0)])
    async with Stage(aircraft=aircraft) as stage:
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        assert await stage.companion.command(CALIBRATE, 1, wait_s=40.0) == 0
        assert 8.0 < loop.time() - begun_s < 9.5
        stage.double.arm()
        assert await stage.companion.command(CALIBRATE, 1) == mavlink.MAV_RESULT_FAILED
        assert "Disarm to allow calibration" in stage.companion.texts()


async def test_arming_shows_in_the_heartbeat_and_is_refused_for_uncalibrated_accelerometers() -> None:
    async with Stage() as stage:
        assert await stage.ground.command(ARM, 1) == 0
        await asyncio.sleep(1.1)
        assert stage.companion.all(mavlink.MAVLink_heartbeat_message)[-1].base_mode & 128
        assert await stage.ground.command(ARM, 0) == 0
        await asyncio.sleep(1.1)
        assert not stage.companion.all(mavlink.MAVLink_heartbeat_message)[-1].base_mode & 128
        for name in offset_names(1, "accel"):
            await stage.companion.set_parameter(name, 0.0)
        assert await stage.ground.command(ARM, 1) == mavlink.MAV_RESULT_FAILED
        assert "Arm: 3D Accel calibration needed" in stage.companion.texts()
        assert await stage.ground.command(ARM, 1, 21196) == 0


async def test_two_imus_that_differ_too_much_do_not_arm() -> None:
    async with Stage(imus=2) as stage:
        await stage.companion.set_parameter("INS_ACC2OFFS_X", 1.0)
        assert await stage.ground.command(ARM, 1) == mavlink.MAV_RESULT_FAILED
        assert "Arm: Accels inconsistent" in stage.ground.texts()


async def test_what_is_addressed_to_an_unheard_component_the_autopilot_does_itself() -> None:
    async with Stage() as stage:
        assert not stage.double.hears(191)
        assert await stage.ground.command(CALIBRATE, 1, target=(1, 191)) == 0
        assert stage.double.parameter("INS_GYROFFS_X") != 0.0
        ack = stage.ground.all(mavlink.MAVLink_command_ack_message)[0]
        assert ack.get_srcComponent() == 1
        assert len(await stage.ground.read_parameter("INS_GYR_CAL", target=(1, 191))) == 1


async def test_once_heard_the_component_gets_its_messages_and_the_autopilot_keeps_out() -> None:
    async with Stage() as stage:
        stage.companion.heartbeat()
        await asyncio.sleep(0.05)
        assert stage.double.hears(191)
        assert [m.get_srcComponent() for m in stage.ground.all(mavlink.MAVLink_heartbeat_message)].count(191) == 1
        assert await stage.ground.command(CALIBRATE, 1, target=(1, 191), wait_s=1.0) == -1
        assert stage.companion.all(mavlink.MAVLink_command_long_message)[0].command == CALIBRATE
        assert stage.double.parameter("INS_GYROFFS_X") == 0.0
        answer = mavlink.MAVLink_command_ack_message(CALIBRATE, 5, 10, 0, 255, 190)
        stage.companion.send(answer)
        await asyncio.sleep(0.05)
        assert stage.ground.all(mavlink.MAVLink_command_ack_message)[-1].progress == 10
        # On its own wire, a message to itself comes back to nobody: the autopilot takes it.
        assert await stage.companion.command(mavlink.MAV_CMD_USER_1, target=(1, 191)) == 3
        assert await stage.ground.command(mavlink.MAV_CMD_USER_1, target=(1, 1)) == 3
        assert len(stage.companion.all(mavlink.MAVLink_command_long_message)) == 1
