"""PX4's way of keeping biases: slots, rotations, encodings, and changes that it would ignore (autopilots 4, 7.5, 9)."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import math
from collections.abc import AsyncIterator
from typing import NamedTuple

import numpy as np
import pytest

from companion.autopilot.firmware.base import NO_IMU, SlotMemory
from companion.autopilot.firmware.firmwares import read_calibration
from companion.autopilot.firmware.imu_calibration import ImuCalibration, changes_for
from companion.autopilot.firmware.px4 import PX4, Slot, choose_slot, warnings_about
from companion.autopilot.parameters.change import Change, WriteFailedError
from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.autopilot.vehicle.parameter_writer import ParameterWriter
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.errors import AutopilotError, NotDisarmedError, ParameterRefusedError
from companion.links.mavlink.link import MavlinkLink
from tests.support.scripted_autopilot import f32, flying_on
from tests.support.scripted_px4 import ICM, INT32, ScriptedPx4
from tests.support.virtual_time import run_virtual

BMI = 6684682  # another chip on another bus address
SIM = 1310988  # the simulator's: bus type 4
CAN = 3 | 5 << 3 | 9 << 8  # bus type 3: always external


class Px4ClientBench(NamedTuple):
    px4: ScriptedPx4
    vehicle: Vehicle
    client: ParameterClient
    writer: ParameterWriter


@contextlib.asynccontextmanager
async def aboard(px4: ScriptedPx4) -> AsyncIterator[Px4ClientBench]:
    link = MavlinkLink()
    vehicle = Vehicle(link)
    client = ParameterClient(link, vehicle)
    async with flying_on(link, px4):
        await vehicle.found.wait()
        await asyncio.sleep(1.0)
        yield Px4ClientBench(px4, vehicle, client, ParameterWriter(client, vehicle))
    vehicle.close()


def read(px4: ScriptedPx4, instance: int = 1, memory: SlotMemory | None = None) -> ImuCalibration:
    async def main() -> ImuCalibration:
        async with aboard(px4) as stage:
            return await read_calibration(stage.client, instance, memory)

    return run_virtual(main())


def names(sensor: str, slot: int) -> tuple[str, str, str]:
    return f"CAL_{sensor}{slot}_XOFF", f"CAL_{sensor}{slot}_YOFF", f"CAL_{sensor}{slot}_ZOFF"


# --- integers


@pytest.mark.parametrize("capabilities", [2 | 16, 2], ids=["by the capability bit", "by who it is"])
async def test_integers_are_read_byte_by_byte(capabilities: int) -> None:
    values: dict[str, float] = {
        "CAL_GYRO0_ID": ICM,
        "CAL_GYRO1_ID": 16777217,
        "CAL_GYRO0_ROT": -1,
        "SENS_BOARD_ROT": 2,
    }
    async with aboard(ScriptedPx4(parameters=values, capabilities=capabilities)) as stage:
        for name, value in values.items():
            assert await stage.client.read(name) == value
        assert await stage.client.read("CAL_ACC0_XSCALE") == 1.0


@pytest.mark.parametrize("value", [0, 1, -1, 7, 16777217, 2**31 - 1, -(2**31)])
async def test_integers_are_written_byte_by_byte_with_their_own_type(value: int) -> None:
    async with aboard(ScriptedPx4(parameters={"CAL_GYRO0_ID": 5})) as stage:
        assert await stage.client.write("CAL_GYRO0_ID", value) == value
        assert stage.px4.parameters["CAL_GYRO0_ID"] == value
        assert stage.px4.wrong_types == []
        sent = [message for message in stage.px4.requests if message.get_type() == "PARAM_SET"]
        assert {message.param_type for message in sent} == {INT32}
        await stage.client.write("CAL_GYRO0_XOFF", 0.25)
        assert stage.px4.sets[-1][:2] == ("CAL_GYRO0_XOFF", 0.25)


@pytest.mark.parametrize("value", [0.5, math.nan, math.inf, 2.0**31])
async def test_what_is_no_whole_number_is_not_written_to_an_integer(value: float) -> None:
    async with aboard(ScriptedPx4()) as stage:
        with pytest.raises(ParameterRefusedError, match="not a whole number"):
            await stage.client.write("CAL_GYRO0_ID", value)
        assert stage.px4.sets == []


# --- slots


def test_the_slots_are_taken_in_order_and_gyro_and_accelerometer_may_stand_in_different_ones() -> None:
    px4 = ScriptedPx4(devices=(ICM, BMI))
    px4.parameters |= {"CAL_ACC0_ID": BMI, "CAL_ACC1_ID": ICM}
    one, two = read(px4, 1), read(px4, 2)
    # The accelerometer by order of its slots; the gyro is the same chip.
    assert one.parameters.accel_offset == names("ACC", 0)
    assert one.parameters.gyro_offset == names("GYRO", 1)
    assert (one.gyro_id, one.accel_id) == (BMI, BMI)
    assert two.parameters.accel_offset == names("ACC", 1)
    assert two.parameters.gyro_offset == names("GYRO", 0)
    assert one.parameters.accel_scale == ("CAL_ACC0_XSCALE", "CAL_ACC0_YSCALE", "CAL_ACC0_ZSCALE")


def test_what_was_learned_about_a_device_goes_before_the_order_of_the_slots() -> None:
    slots = (Slot(0, 11, True), Slot(1, 22, True), Slot(3, 33, True))
    memory = SlotMemory()
    assert choose_slot(memory, "gyro", 1, slots).number == 0
    memory.learn("gyro", 11, 2)
    assert choose_slot(memory, "gyro", 2, slots).number == 0
    assert choose_slot(memory, "gyro", 1, slots).number == 1
    assert choose_slot(memory, "accel", 1, slots).number == 0
    memory.learn("gyro", 22, NO_IMU)
    assert choose_slot(memory, "gyro", 1, slots).number == 3
    memory.learn("gyro", 33, NO_IMU)
    assert (
        choose_slot(memory, "gyro", 1, slots).number == 1
    )  # what acted on nobody is tried again when nothing else is left
    memory.learn("gyro", 22, 3)
    memory.learn("gyro", 33, 3)
    memory.learn("gyro", 22, 3)
    assert memory.known("gyro", 33) is None
    assert choose_slot(memory, "gyro", 1, slots).number == 3
    assert choose_slot(memory, "gyro", 2, slots).number == 0


@pytest.mark.parametrize(
    ("changed", "instance", "words"),
    [
        ({"CAL_GYRO0_ID": 0}, 1, "no IMU 1: only 0 of CAL_GYRO0_ID to CAL_GYRO3_ID"),
        ({"CAL_ACC0_ID": 0}, 1, "no IMU 1: only 0 of CAL_ACC0_ID"),
        ({}, 2, "no IMU 2: only 1 of CAL_ACC0_ID to CAL_ACC3_ID"),
        ({"CAL_GYRO0_PRIO": 0}, 1, "CAL_GYRO0_PRIO = 0"),
        ({"CAL_ACC0_PRIO": 0}, 1, "CAL_ACC0_PRIO = 0"),
        ({"CAL_ACC0_YSCALE": 0.0}, 1, "CAL_ACC0_YSCALE is 0"),
        ({"CAL_GYRO0_ZOFF": math.nan}, 1, "CAL_GYRO0_ZOFF is nan"),
        ({"SENS_BOARD_X_OFF": math.inf}, 1, "SENS_BOARD_X_OFF is inf"),
        ({"CAL_GYRO0_ROT": 2, "CAL_ACC0_ROT": 4}, 1, "CAL_GYRO0_ROT is unlike CAL_ACC0_ROT"),
    ],
)
def test_what_cannot_be_worked_with_is_refused_with_a_reason(
    changed: dict[str, float], instance: int, words: str
) -> None:
    with pytest.raises(AutopilotError, match=words):
        read(ScriptedPx4(parameters=changed), instance)


# --- rotation


def turned(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """Aerospace 3-2-1 as three elementary rotations, sensor to vehicle."""
    z, y, x = map(math.radians, (yaw, pitch, roll))
    about_z = np.array([[math.cos(z), -math.sin(z), 0], [math.sin(z), math.cos(z), 0], [0, 0, 1]])
    about_y = np.array([[math.cos(y), 0, math.sin(y)], [0, 1, 0], [-math.sin(y), 0, math.cos(y)]])
    about_x = np.array([[1, 0, 0], [0, math.cos(x), -math.sin(x)], [0, math.sin(x), math.cos(x)]])
    matrix: np.ndarray = about_z @ about_y @ about_x
    return matrix


@pytest.mark.parametrize(
    ("device", "changed", "expected"),
    [
        (ICM, {}, np.eye(3)),
        (ICM, {"SENS_BOARD_ROT": 2}, turned(90, 0, 0)),
        (SIM, {"SENS_BOARD_ROT": 4, "CAL_GYRO0_ROT": 2, "CAL_ACC0_ROT": 2}, turned(180, 0, 0)),
        (ICM, {"SENS_BOARD_ROT": 4, "CAL_GYRO0_ROT": 2, "CAL_ACC0_ROT": 2}, turned(90, 0, 0)),
        (CAN, {"SENS_BOARD_ROT": 4}, np.eye(3)),
        (CAN, {"CAL_GYRO0_ROT": 8, "CAL_ACC0_ROT": 8}, turned(0, 0, 180)),
        (ICM, {"SENS_BOARD_ROT": 38}, turned(293, 68, 90)),
        (ICM, {"SENS_BOARD_ROT": 77}, np.eye(3)),
        (
            ICM,
            {"SENS_BOARD_X_OFF": -2.9, "SENS_BOARD_Y_OFF": 5.1, "SENS_BOARD_Z_OFF": 1.0, "SENS_BOARD_ROT": 24},
            turned(1.0, 5.1, -2.9) @ turned(0, 90, 0),
        ),
    ],
    ids=["none", "board", "simulated", "external", "CAN is external", "external 180", "38", "other", "level"],
)  # fmt: skip
def test_level_offsets_are_inside_the_rotation(device: int, changed: dict[str, float], expected: np.ndarray) -> None:
    found = read(ScriptedPx4(devices=(device,), parameters=changed))
    np.testing.assert_allclose(found.orientation, expected, atol=1e-7)


# --- rivals, and what is odd


def test_rivals_are_found_and_told() -> None:
    found = read(ScriptedPx4(parameters={"IMU_GYRO_CAL_EN": 1, "SENS_IMU_AUTOCAL": 1}))
    assert [(rival.parameter, rival.value) for rival in found.rivals] == [
        ("IMU_GYRO_CAL_EN", 1),
        ("SENS_IMU_AUTOCAL", 1),
    ]
    assert [warning.split(":")[0] for warning in found.warnings] == ["IMU_GYRO_CAL_EN = 1", "SENS_IMU_AUTOCAL = 1"]


@pytest.mark.parametrize(("x", "unsure"), [(0.0, False), (0.009, True), (0.0101, True), (0.02, False)])
def test_small_accelerometer_offsets_may_not_be_in_use(x: float, unsure: bool) -> None:
    memory = SlotMemory()
    px4 = ScriptedPx4(parameters={"CAL_ACC0_XOFF": x})
    assert read(px4, memory=memory).accel_offset_may_be_unused == unsure
    memory.brought_into_use(names("ACC", 0), (f32(x), 0.0, 0.0), 0)
    assert not read(px4, memory=memory).accel_offset_may_be_unused


def test_accelerometer_offsets_below_a_milli_g_in_all_are_warned_about() -> None:
    found = read(ScriptedPx4())
    (warning,) = warnings_about(found, changes_for(found, None, (0.005, -0.004, 0.006)))
    assert "0.89 mg in all" in warning
    assert "PX4 starts without them" in warning
    assert warnings_about(found, changes_for(found, None, (0.005, -0.004, 0.009))) == ()
    assert warnings_about(found, changes_for(found, (0.001, 0.0, 0.0), None)) == ()


def test_new_accelerometer_offsets_leave_a_stale_tilt_and_new_gyro_offsets_do_not() -> None:
    found = read(ScriptedPx4())
    assert PX4().stale_tilt_deg(changes_for(found, None, (0.1, 0.0, 0.0))) == pytest.approx(0.585, abs=0.001)
    assert PX4().stale_tilt_deg(changes_for(found, None, (0.05, 0.0, 0.0))) == 0.0  # 0.29 deg: no restart for that
    assert PX4().stale_tilt_deg([Change("SENS_BOARD_X_OFF", 0.0, 0.2)]) == pytest.approx(0.2)
    assert PX4().stale_tilt_deg(changes_for(found, (0.05, 0.0, 0.0), None)) == 0.0


# --- changes that PX4 would ignore


def small_changes(found: ImuCalibration) -> list[Change]:
    return changes_for(found, (0.0005, -0.0003, 0.0008), (0.003, 0.002, -0.004))


def in_use(px4: ScriptedPx4, sensor: str) -> list[float]:
    return list(px4.used[sensor, px4.devices[0]])


async def test_plain_writes_of_small_changes_are_ignored() -> None:
    async with aboard(ScriptedPx4()) as stage:
        found = await read_calibration(stage.client, 1)
        plain = [Change(c.parameter, c.before, c.after) for c in small_changes(found)]
        await stage.writer.apply(plain)
        await asyncio.sleep(3.0)
        assert in_use(stage.px4, "GYRO") == [0.0, 0.0, 0.0]
        assert in_use(stage.px4, "ACC") == [0.0, 0.0, 0.0]


async def test_small_changes_get_in_by_way_of_a_far_value_and_back_out_the_same_way() -> None:
    async with aboard(ScriptedPx4()) as stage:
        changes = small_changes(await read_calibration(stage.client, 1))
        await stage.writer.apply(changes)
        await asyncio.sleep(1.5)
        after = {c.parameter: c.after for c in changes}
        assert in_use(stage.px4, "GYRO") == [after[name] for name in names("GYRO", 0)]
        assert in_use(stage.px4, "ACC") == [after[name] for name in names("ACC", 0)]
        await stage.writer.undo(changes)
        await asyncio.sleep(1.5)
        assert in_use(stage.px4, "GYRO") == [0.0, 0.0, 0.0]
        assert in_use(stage.px4, "ACC") == [0.0, 0.0, 0.0]
        assert all(stage.px4.parameters[name] == 0.0 for name in after)


@pytest.mark.parametrize("since_s", [0.0, 0.3, 0.6, 0.9, 1.2])
async def test_whenever_px4_looked_at_its_parameters_last_the_small_change_gets_in(since_s: float) -> None:
    async with aboard(ScriptedPx4()) as stage:
        changes = small_changes(await read_calibration(stage.client, 1))
        stage.px4.changed()  # another parameter: it looks at once, and then not for a second
        await asyncio.sleep(0.005 + since_s)
        await stage.writer.apply(changes)
        await asyncio.sleep(1.5)
        after = {c.parameter: c.after for c in changes}
        assert in_use(stage.px4, "GYRO") == [after[name] for name in names("GYRO", 0)]
        assert in_use(stage.px4, "ACC") == [after[name] for name in names("ACC", 0)]


@pytest.mark.parametrize("number", range(1, 9))
async def test_a_write_that_fails_anywhere_leaves_the_old_values_in_use(number: int) -> None:
    count = 0

    def refuse(name: str, value: float) -> float | None:
        nonlocal count
        count += 1
        if count == number:
            px4._refuse(px4.requests[-1], 3)
            return None
        return value

    px4 = ScriptedPx4(parameters={"CAL_GYRO0_YOFF": 0.004, "CAL_ACC0_ZOFF": 0.3})
    px4.on_set = refuse
    before = dict(px4.parameters)
    async with aboard(px4) as stage:
        changes = small_changes(await read_calibration(stage.client, 1))
        with pytest.raises(WriteFailedError) as caught:
            await stage.writer.apply(changes)
        assert caught.value.left_changed == ()
        await asyncio.sleep(1.5)
        assert px4.parameters == before
        assert in_use(px4, "GYRO") == [0.0, f32(0.004), 0.0]
        assert in_use(px4, "ACC") == [0.0, 0.0, f32(0.3)]


async def test_what_is_seen_on_the_way_may_put_everything_back() -> None:
    async with aboard(ScriptedPx4()) as stage:
        changes = small_changes(await read_calibration(stage.client, 1))
        seen: list[list[float]] = []

        async def verify(parameter: str) -> str | None:
            await asyncio.sleep(0.1)
            seen.append(in_use(stage.px4, "GYRO"))
            return "it acts on another IMU" if parameter.startswith("CAL_GYRO") else None

        with pytest.raises(
            WriteFailedError, match="wrong slot, orientation or scale: it acts on another IMU"
        ) as caught:
            await stage.writer.apply(changes, lambda parameter: functools.partial(verify, parameter))
        assert caught.value.kind == "wrong slot, orientation or scale"
        assert max(seen[-1]) == pytest.approx(0.0228)
        await asyncio.sleep(1.5)
        assert in_use(stage.px4, "GYRO") == [0.0, 0.0, 0.0]


async def test_armed_between_the_two_steps_nothing_more_is_written_until_it_is_disarmed() -> None:
    async with aboard(ScriptedPx4()) as stage:
        changes = small_changes(await read_calibration(stage.client, 1))

        async def verify() -> None:
            stage.px4.armed = True
            await asyncio.sleep(1.5)

        with pytest.raises(WriteFailedError) as caught:
            await stage.writer.apply(changes, lambda _parameter: verify)
        assert caught.value.kind == "armed in the middle"
        assert set(caught.value.left_changed) == {"CAL_ACC0_ZOFF"}
        assert not any(armed for _, _, armed in stage.px4.sets)
        with pytest.raises(NotDisarmedError):
            await stage.writer.restore(changes)
        stage.px4.armed = False
        await asyncio.sleep(4.5)  # 3 s after the last armed heartbeat it counts as disarmed
        await stage.writer.restore(changes)
        await asyncio.sleep(1.5)
        assert in_use(stage.px4, "GYRO") == [0.0, 0.0, 0.0]
