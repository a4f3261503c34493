"""The double's parameter protocol, commands, routing and faults (autopilots 1.3 to 1.5, 3, 5.4, 7.5, 9.1)."""

from __future__ import annotations

import asyncio
from typing import Any, Self

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import Pose, VirtualAircraft
from sim.ardupilot.double import ArduPilotDouble
from sim.ardupilot.parameters import offset_names
from sim.imu_model import DEG_H, MG, ImuModel
from sim.motions import Handling
from sim.station import Station
from tests.support.wire import Wire

GYRO_BIAS = np.array([100.0, -60.0, 170.0]) * DEG_H
ACCEL_BIAS = np.array([1.0, -2.0, 3.0]) * MG
POSE = Pose(5.0, -3.0, 40.0)
CALIBRATE = mavlink.MAV_CMD_PREFLIGHT_CALIBRATION
ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM


class ParameterStage:
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


async def test_a_gyro_calibration_writes_temperatures_and_all_instances_and_announces_them() -> None:
    async with ParameterStage(imus=2, auxiliary=True, parameters={"INS_GYR3OFFS_Y": 0.2, "INS_GYR3_ID": 7}) as stage:
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
    async with ParameterStage() as stage:
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
    async with ParameterStage(version=version) as stage:
        assert await stage.companion.read_parameter("NO_SUCH") == []
        assert await stage.companion.set_parameter("NO_SUCH", 1.0) == []
        assert stage.companion.all(mavlink.MAVLink_param_error_message) == []


@pytest.mark.parametrize(("version", "renamed"), [("4.3", False), ("4.6", False), ("4.7", True), ("4.8", True)])
def test_4_7_renamed_sysid_thismav_sr_and_arming_check(version: str, renamed: bool) -> None:
    double = ParameterStage(version=version, auxiliary=True).double
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
    async with ParameterStage(version=version, parameters=dict.fromkeys(offset_names(1, "accel"), 0.0)) as stage:
        await stage.ground.command(ARM, 1, word)
        assert stage.double.armed == armed


async def test_writes_while_armed_are_accepted_and_witnessed() -> None:
    async with ParameterStage() as stage:
        await stage.companion.set_parameter("INS_GYROFFS_X", 0.001)
        stage.double.arm()
        assert await stage.ground.set_parameter("INS_GYROFFS_Z", 0.002) == [pytest.approx(0.002)]
        seen = [(w.name, round(w.value, 6), w.armed, w.component_id) for w in stage.double.writes]
        assert seen == [("INS_GYROFFS_X", 0.001, False, 191), ("INS_GYROFFS_Z", 0.002, True, 190)]
        assert stage.double.writes[0].t_s == pytest.approx(1000.05, abs=0.01)


async def test_a_calibration_waits_for_stillness_and_is_refused_while_armed() -> None:
    aircraft = VirtualAircraft(POSE, motions=[Handling(start_s=0.0, duration_s=8.0)])
    async with ParameterStage(aircraft=aircraft) as stage:
        loop = asyncio.get_running_loop()
        begun_s = loop.time()
        assert await stage.companion.command(CALIBRATE, 1, wait_s=40.0) == 0
        assert 8.0 < loop.time() - begun_s < 9.5
        stage.double.arm()
        assert await stage.companion.command(CALIBRATE, 1) == mavlink.MAV_RESULT_FAILED
        assert "Disarm to allow calibration" in stage.companion.texts()


async def test_two_imus_that_differ_too_much_do_not_arm() -> None:
    async with ParameterStage(imus=2) as stage:
        await stage.companion.set_parameter("INS_ACC2OFFS_X", 1.0)
        assert await stage.ground.command(ARM, 1) == mavlink.MAV_RESULT_FAILED
        assert "Arm: Accels inconsistent" in stage.ground.texts()
