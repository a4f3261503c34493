"""The PX4 double's parameter protocol and storage (autopilots 4.4, 7.5, 8, 9.2)."""

from __future__ import annotations

import asyncio
import math
import struct

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.support.px4_stage import INT32, REAL32, REBOOT, REQUEST, PX4Stage, decoded, now_s
from tests.support.virtual_time import run_virtual

INT8 = mavlink.MAV_PARAM_TYPE_INT8


def bytes_of(value: int) -> float:
    return float(struct.unpack("<f", struct.pack("<i", value))[0])


def test_an_integer_travels_as_the_bytes_of_an_int32() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            raw = await stage.companion.read_parameter("CAL_GYRO0_ID")
            assert struct.pack("<f", raw[0]) == struct.pack("<i", 1310988)
            assert stage.values("CAL_GYRO0_ID") == [1310988]
            await stage.set("CAL_ACC3_PRIO", -1)
            await stage.set("IMU_INTEG_RATE", 250)
            await asyncio.sleep(0.1)
            assert stage.double.parameter("IMU_INTEG_RATE") == 250
            assert set(stage.values("IMU_INTEG_RATE")) == {250.0}
            assert stage.values("CAL_ACC3_PRIO") == [-1.0]
            assert [write.value for write in stage.double.writes] == [-1.0, 250.0]

    run_virtual(main())


def test_a_float_written_as_an_integer_is_a_type_mismatch_and_nothing_is_stored() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            assert await stage.companion.set_parameter("CAL_GYRO0_XOFF", bytes_of(5), kind=INT32) == []
            assert await stage.companion.set_parameter("CAL_GYRO0_PRIO", 1.0, kind=REAL32) == []
            assert stage.errors() == [("CAL_GYRO0_XOFF", 7), ("CAL_GYRO0_PRIO", 7)]
            assert stage.double.parameter("CAL_GYRO0_XOFF") == 0.0
            assert stage.double.parameter("CAL_GYRO0_PRIO") == -1

    run_virtual(main())


def test_only_int32_and_real32_are_supported_types() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            assert await stage.companion.set_parameter("IMU_GYRO_CAL_EN", 0.0, kind=INT8) == []
            assert stage.errors() == [("IMU_GYRO_CAL_EN", 6)]

    run_virtual(main())


def test_an_unknown_name_is_an_error_and_no_value() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            assert await stage.companion.set_parameter("INS_GYROFFS_X", 1.0) == []
            assert await stage.companion.read_parameter("INS_GYROFFS_X") == []
            assert stage.errors() == [("INS_GYROFFS_X", 1), ("INS_GYROFFS_X", 1)]
            error = stage.companion.all(mavlink.MAVLink_param_error_message)[0]
            assert (error.target_system, error.target_component) == (1, 191)

    run_virtual(main())


def test_before_1_17_errors_are_silence() -> None:
    async def main() -> None:
        async with PX4Stage(version="1.16") as stage:
            assert await stage.companion.set_parameter("NO_SUCH", 1.0) == []
            assert await stage.companion.set_parameter("CAL_GYRO0_XOFF", 1.0, kind=INT32) == []
            assert await stage.companion.read_parameter("NO_SUCH") == []
            assert stage.errors() == []

    run_virtual(main())


def test_the_target_must_be_the_vehicle_and_component_1_or_0() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            for target, obeyed in (((1, 1), True), ((1, 0), True), ((1, 191), False), ((0, 1), False), ((2, 1), False)):
                before = len(stage.double.writes)
                answers = await stage.companion.set_parameter("CAL_ACC1_XOFF", 0.1, target=target)
                assert bool(answers) is obeyed, target
                assert len(stage.double.writes) - before == obeyed
                assert bool(await stage.companion.read_parameter("CAL_ACC1_XOFF", target=target)) is obeyed

    run_virtual(main())


def test_the_echo_comes_within_a_millisecond_on_the_port_of_the_writer() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            stage.companion_wire.delay_s = (0.0, 0.0)
            begun_s = now_s()
            await stage.set("CAL_GYRO0_XOFF", 0.1)
            first_s, echo = stage.companion.timed(mavlink.MAVLink_param_value_message, since_s=begun_s)[0]
            assert first_s - begun_s <= 0.0011
            assert echo.param_value == pytest.approx(0.1)
            assert echo.param_index == stage.double.parameters.index["CAL_GYRO0_XOFF"]

    run_virtual(main())


def test_every_port_is_told_of_a_change_some_milliseconds_later() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            await stage.set("CAL_GYRO0_XOFF", 0.1)
            await asyncio.sleep(0.1)
            assert stage.values("CAL_GYRO0_XOFF", station=stage.ground) == [pytest.approx(0.1)]
            assert stage.values("CAL_GYRO0_XOFF") == [pytest.approx(0.1)] * 2  # its own echo, and the news

    run_virtual(main())


def test_the_same_value_written_again_at_once_keeps_the_others_from_being_told() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            stage.companion_wire.delay_s = (0.0, 0.0)
            for _ in range(2):
                message = mavlink.MAVLink_param_set_message(1, 1, b"CAL_GYRO0_XOFF", 0.1, REAL32)
                stage.companion.send(message)
                await asyncio.sleep(0.002)
            await asyncio.sleep(3.0)
            assert stage.values("CAL_GYRO0_XOFF") == [pytest.approx(0.1)] * 2
            assert stage.values("CAL_GYRO0_XOFF", station=stage.ground) == []
            assert stage.double.saved_parameter("CAL_GYRO0_XOFF") == pytest.approx(0.1)

    run_virtual(main())


def test_a_change_below_the_smallest_float_step_is_stored_but_nobody_is_told_and_it_is_not_saved() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            await stage.set("CAL_GYRO0_XOFF", 1e-7)
            await asyncio.sleep(3.0)
            assert stage.double.parameter("CAL_GYRO0_XOFF") == pytest.approx(1e-7)
            assert stage.double.saved_parameter("CAL_GYRO0_XOFF") == 0.0
            assert stage.values("CAL_GYRO0_XOFF", station=stage.ground) == []

    run_virtual(main())


def test_parameters_are_saved_by_themselves_a_third_of_a_second_later_and_then_every_two() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            await stage.set("CAL_ACC0_XOFF", 0.5)
            await asyncio.sleep(0.25)
            assert stage.double.saved_parameter("CAL_ACC0_XOFF") == 0.0
            await asyncio.sleep(0.1)
            assert stage.double.saved_parameter("CAL_ACC0_XOFF") == 0.5
            await stage.set("CAL_ACC0_YOFF", 0.5)
            await asyncio.sleep(1.5)
            assert stage.double.saved_parameter("CAL_ACC0_YOFF") == 0.0
            await asyncio.sleep(0.6)
            assert stage.double.saved_parameter("CAL_ACC0_YOFF") == 0.5

    run_virtual(main())


def test_a_power_cut_before_the_save_loses_the_write_and_after_it_does_not() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            await stage.set("CAL_ACC0_XOFF", 0.5)
            await asyncio.sleep(1.0)
            await stage.set("CAL_ACC0_YOFF", 0.5)
            await asyncio.sleep(0.1)
            stage.double.reboot(1.0)
            await asyncio.sleep(1.5)
            assert stage.double.parameter("CAL_ACC0_XOFF") == 0.5
            assert stage.double.parameter("CAL_ACC0_YOFF") == 0.0
            assert stage.double.boots == 2

    run_virtual(main())


def test_a_board_with_flash_storage_saves_only_after_disarming() -> None:
    async def main() -> None:
        async with PX4Stage(flash_storage=True) as stage:
            stage.double.arm()
            await stage.set("CAL_ACC0_XOFF", 0.5)
            await asyncio.sleep(5.0)
            assert stage.double.parameter("CAL_ACC0_XOFF") == 0.5
            assert stage.double.saved_parameter("CAL_ACC0_XOFF") == 0.0
            stage.double.disarm()
            await asyncio.sleep(1.5)
            assert stage.double.saved_parameter("CAL_ACC0_XOFF") == 0.5

    run_virtual(main())


def test_a_write_while_armed_is_not_refused() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            stage.double.arm()
            await stage.set_vector(0, "ACC", (0.3, 0.0, 0.0))
            assert stage.double.applied(1).accel_offset_m_s2 == pytest.approx([0.3, 0.0, 0.0])
            assert all(write.armed for write in stage.double.writes)

    run_virtual(main())


def test_the_whole_list_has_hundreds_of_names_with_true_indices_and_a_hash_before_them() -> None:
    async def main() -> None:
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

    run_virtual(main())


def test_the_hash_is_read_only_and_stops_the_list() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            stage.companion.send(mavlink.MAVLink_param_request_list_message(1, 1))
            await asyncio.sleep(0.03)
            await stage.companion.set_parameter("_HASH_CHECK", 1.0, kind=INT32)
            assert stage.errors() == [("_HASH_CHECK", 5)]
            assert len(stage.companion.all(mavlink.MAVLink_param_value_message)) < 200

    run_virtual(main())


def test_the_capabilities_say_float_and_bytewise() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            assert await stage.companion.command(REQUEST, 148) == 0
            (version,) = stage.companion.all(mavlink.MAVLink_autopilot_version_message)
            assert version.capabilities & 2
            assert version.capabilities & 16
            assert not version.capabilities & 131072
            assert version.flight_sw_version >> 16 == 0x0112

    run_virtual(main())


def test_storage_1_saves_0_loads_2_resets_and_armed_is_turned_away() -> None:
    storage = mavlink.MAV_CMD_PREFLIGHT_STORAGE

    async def main() -> None:
        async with PX4Stage() as stage:
            await stage.set("CAL_ACC0_XOFF", 0.5)
            assert await stage.companion.command(storage, 1) == 0
            assert stage.double.saved_parameter("CAL_ACC0_XOFF") == 0.5
            await stage.set("CAL_ACC0_XOFF", 0.7)
            assert await stage.companion.command(storage, 0) == 0
            assert stage.double.parameter("CAL_ACC0_XOFF") == 0.5
            stage.double.arm()
            assert await stage.companion.command(storage, 2) == 1
            stage.double.disarm()
            assert await stage.companion.command(storage, 2) == 0
            assert stage.double.parameter("CAL_ACC0_XOFF") == 0.0

    run_virtual(main())


def test_a_reboot_is_obeyed_disarmed_only_and_takes_time_back_to_zero() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            stage.double.arm()
            assert await stage.companion.command(REBOOT, 1) == 2
            stage.double.disarm()
            before = stage.double.boot_ms(now_s())
            assert await stage.companion.command(REBOOT, 1) == 0
            await asyncio.sleep(1.0)
            assert await stage.companion.read_parameter("CAL_ACC0_XOFF") == []
            await asyncio.sleep(4.0)
            assert stage.double.boots == 2
            assert stage.double.boot_ms(now_s()) < before
            assert len(await stage.companion.read_parameter("CAL_ACC0_XOFF")) == 1

    run_virtual(main())


@pytest.mark.parametrize("fault", ["refuse", "ignore", "wrong_echo"])
def test_faults_of_single_parameters(fault: str) -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            getattr(stage.double.faults, fault).add("CAL_ACC0_*")
            answers = await stage.companion.set_parameter("CAL_ACC0_XOFF", 0.5)
            stored = stage.double.parameter("CAL_ACC0_XOFF")
            if fault == "wrong_echo":
                assert stored == 0.5
                assert 0.5 not in answers
                assert answers
            else:
                assert (answers, stored) == ([], 0.0)
                assert stage.errors() == ([("CAL_ACC0_XOFF", 5)] if fault == "refuse" else [])

    run_virtual(main())


def test_faults_of_the_whole_autopilot() -> None:
    async def main() -> None:
        async with PX4Stage() as stage:
            stage.double.faults.silent = True
            assert await stage.companion.set_parameter("CAL_ACC0_XOFF", 0.5) == []
            assert await stage.companion.command(REQUEST, 148, wait_s=0.5) == -1
            stage.double.faults.silent = False
            stage.double.faults.echo_without_effect = True
            await stage.set_vector(0, "ACC", (0.5, 0.5, 0.5))
            assert stage.double.applied(1).accel_offset_m_s2 == pytest.approx([0.5, 0.0, 0.0])  # silent, but obeyed
            stage.double.faults.echo_without_effect = False
            stage.double.faults.reboot_after_writes = 1
            await stage.set("CAL_ACC0_XOFF", 0.6)
            await asyncio.sleep(3.0)
            assert stage.double.boots == 2
            stage.double.faults.arm_after_writes = 1
            stage.double.faults.foreign_write_after = (1, "CAL_ACC0_ZOFF", -0.25)
            await stage.set("CAL_ACC0_XOFF", 0.6)
            await asyncio.sleep(0.1)
            assert stage.double.armed
            assert stage.values("CAL_ACC0_ZOFF", station=stage.ground)[-1] == -0.25
            assert math.isclose(stage.double.parameter("CAL_ACC0_ZOFF"), -0.25)

    run_virtual(main())
