"""The PX4 double's parameter protocol and storage (autopilots 4.4, 7.5, 8, 9.2)."""

from __future__ import annotations

import asyncio

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.support.px4_stage import INT32, PX4Stage, decoded


async def test_before_1_17_errors_are_silence() -> None:
    async with PX4Stage(version="1.16") as stage:
        assert await stage.companion.set_parameter("NO_SUCH", 1.0) == []
        assert await stage.companion.set_parameter("CAL_GYRO0_XOFF", 1.0, kind=INT32) == []
        assert await stage.companion.read_parameter("NO_SUCH") == []
        assert stage.errors() == []


async def test_parameters_are_saved_by_themselves_a_third_of_a_second_later_and_then_every_two() -> None:
    async with PX4Stage() as stage:
        await stage.set("CAL_ACC0_XOFF", 0.5)
        await asyncio.sleep(0.25)
        assert stage.double.parameters.saved["CAL_ACC0_XOFF"] == 0.0
        await asyncio.sleep(0.1)
        assert stage.double.parameters.saved["CAL_ACC0_XOFF"] == 0.5
        await stage.set("CAL_ACC0_YOFF", 0.5)
        await asyncio.sleep(1.5)
        assert stage.double.parameters.saved["CAL_ACC0_YOFF"] == 0.0
        await asyncio.sleep(0.6)
        assert stage.double.parameters.saved["CAL_ACC0_YOFF"] == 0.5


async def test_a_write_while_armed_is_not_refused() -> None:
    async with PX4Stage() as stage:
        stage.double.arm()
        await stage.set_vector(0, "ACC", (0.3, 0.0, 0.0))
        assert stage.double.vehicle_imus[0].accel.offset == pytest.approx([0.3, 0.0, 0.0])
        assert all(write.armed for write in stage.double.writes)


async def test_the_whole_list_has_hundreds_of_names_with_true_indices_and_a_hash_before_them() -> None:
    async with PX4Stage() as stage:
        stage.companion.send(mavlink.MAVLink_param_request_list_message(1, 1))
        await asyncio.sleep(2.0)
        values = stage.companion.all(mavlink.MAVLink_param_value_message)
        assert values[0].param_id == "_HASH_CHECK"
        assert values[0].param_index == 65535
        count = values[1].param_count
        assert 700 <= count <= 1100
        assert [value.param_index for value in values[1:]] == list(range(count))
        names = [value.param_id for value in values[1:]]
        assert names == sorted(set(names))
        wanted = {f"CAL_GYRO{n}_{word}" for n in range(4) for word in ("ID", "PRIO", "ROT", "XOFF", "YOFF", "ZOFF")}
        wanted |= {f"CAL_ACC{n}_{axis}{word}" for n in range(4) for axis in "XYZ" for word in ("OFF", "SCALE")}
        wanted |= {"SENS_BOARD_ROT", "SENS_BOARD_X_OFF", "IMU_GYRO_CAL_EN", "SENS_IMU_AUTOCAL", "COM_ARM_AUTH_REQ"}
        wanted |= {f"MAV_{n}_{word}" for n in range(3) for word in ("FORWARD", "CONFIG")}
        wanted |= {"COM_ARM_AUTH_ID", "COM_ARM_AUTH_MET", "COM_ARM_AUTH_TO", "IMU_INTEG_RATE", "MAV_SYS_ID"}
        assert wanted <= set(names)
        by_name = {value.param_id: decoded(value) for value in values[1:]}
        assert by_name["CAL_GYRO3_ID"] == 0.0
        assert by_name["CAL_ACC0_XSCALE"] == 1.0
        assert all(len(name) <= 16 for name in names)
        assert stage.ground.all(mavlink.MAVLink_param_value_message) == []
