from __future__ import annotations

import asyncio
import dataclasses
import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.ardupilot import ArduPilotParameters
from companion.autopilot.firmware.firmwares import read_calibration
from companion.autopilot.firmware.imu_calibration import (
    ImuCalibration,
    Thermal,
    accel_offset_after,
    changes_for,
    gyro_offset_after,
    output_step,
)
from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.errors import AutopilotError, AutopilotRebootedError, CalibrationRefusedError
from companion.links.mavlink.link import MavlinkLink
from tests.support.scripted_autopilot import ScriptedAutopilot, f32, flying_on
from tests.support.virtual_time import run_virtual

IMU1 = {
    "INS_GYROFFS_X": 0.001,
    "INS_GYROFFS_Y": 0.002,
    "INS_GYROFFS_Z": 0.003,
    "INS_ACCOFFS_X": 0.1,
    "INS_ACCOFFS_Y": 0.2,
    "INS_ACCOFFS_Z": 0.3,
    "INS_ACCSCAL_X": 1.01,
    "INS_ACCSCAL_Y": 0.99,
    "INS_ACCSCAL_Z": 1.0,
    "INS_GYR_ID": 2752772,
    "INS_ACC_ID": 2753028,
    "INS_TCAL1_ENABLE": 0,
    "INS_USE": 1,
    "INS_GYR_CAL": 0,
    "AHRS_ORIENTATION": 0,
}


def offsets_after(
    calibration: ImuCalibration, gyro: tuple[float, float, float], accel: tuple[float, float, float]
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    return gyro_offset_after(calibration, gyro), accel_offset_after(calibration, accel)


def read(parameters: dict[str, float], instance: int = 1, autopilot: ScriptedAutopilot | None = None) -> ImuCalibration:
    async def main() -> ImuCalibration:
        link = MavlinkLink()
        vehicle = Vehicle(link)
        client = ParameterClient(link, vehicle)
        autopilot_ = autopilot or ScriptedAutopilot()
        autopilot_.parameters = {name: f32(value) for name, value in parameters.items()}
        async with flying_on(link, autopilot_):
            await vehicle.found.wait()
            await asyncio.sleep(2.0)
            try:
                return await read_calibration(client, instance)
            finally:
                vehicle.close()

    return run_virtual(main())


def test_names_of_the_instances_of_which_the_first_is_irregular() -> None:
    one, two, three = ArduPilotParameters(1), ArduPilotParameters(2), ArduPilotParameters(3)
    assert one.gyro_offset == ("INS_GYROFFS_X", "INS_GYROFFS_Y", "INS_GYROFFS_Z")
    assert one.accel_offset[1] == "INS_ACCOFFS_Y"
    assert one.accel_scale[2] == "INS_ACCSCAL_Z"
    assert (one.gyro_id, one.accel_id, one.use) == ("INS_GYR_ID", "INS_ACC_ID", "INS_USE")
    assert one.gyro_caltemp == "INS_GYR1_CALTEMP"
    assert [each.hover_bias for each in (one, two)] == ["INS_ACC_VRFB_Z", "INS_ACC2_VRFB_Z"]
    assert two.gyro_offset[0] == "INS_GYR2OFFS_X"
    assert two.accel_offset[0] == "INS_ACC2OFFS_X"
    assert two.accel_scale[0] == "INS_ACC2SCAL_X"
    assert (two.gyro_id, two.accel_id, two.use) == ("INS_GYR2_ID", "INS_ACC2_ID", "INS_USE2")
    assert (two.gyro_caltemp, two.tcal_enable) == ("INS_GYR2_CALTEMP", "INS_TCAL2_ENABLE")
    assert three.accel_offset[2] == "INS_ACC3OFFS_Z"
    assert one.tcal_enable == "INS_TCAL1_ENABLE"
    four = ArduPilotParameters(4)
    assert four.gyro_offset == ("INS4_GYROFFS_X", "INS4_GYROFFS_Y", "INS4_GYROFFS_Z")
    assert (four.gyro_id, four.gyro_caltemp, four.use) == ("INS4_GYR_ID", "INS4_GYR_CALTEMP", "INS4_USE")
    for names in (one, two, three, four):
        for name in (*names.gyro_offset, *names.accel_scale, names.tcal_enable):
            assert len(name) <= 16
    with pytest.raises(AutopilotError, match="IMU 6"):
        ArduPilotParameters(6)


def test_reads_what_is_there() -> None:
    calibration = read(IMU1)
    assert calibration.gyro_offset_rad_s == (f32(0.001), f32(0.002), f32(0.003))
    assert calibration.accel_offset_m_s2 == (f32(0.1), f32(0.2), f32(0.3))
    assert calibration.accel_scale == (f32(1.01), f32(0.99), 1.0)
    assert (calibration.gyro_id, calibration.accel_id) == (2752772, 2753028)
    assert (calibration.thermal, calibration.rivals) == (Thermal(values={"INS_TCAL1_ENABLE": 0.0}), ())
    assert np.array_equal(calibration.orientation, np.eye(3))
    assert calibration.warnings == ()


def board_x(orientation: int, name: str = "AHRS_ORIENTATION", **angles: float) -> list[float]:
    """Direction of the board's x axis in the vehicle."""
    others = {each: value for each, value in IMU1.items() if each != "AHRS_ORIENTATION"}
    calibration = read(others | {name: orientation} | angles)
    pointing: list[float] = (calibration.orientation @ np.array([1.0, 0.0, 0.0])).tolist()
    return pointing


@pytest.mark.parametrize(
    ("orientation", "expected"),
    [
        (2, (0, 1, 0)),
        (6, (0, -1, 0)),
        (24, (0, 0, -1)),
        (12, (-1, 0, 0)),
        (42, (1, 0, 0)),
        (41, (math.cos(math.radians(7)), 0, -math.sin(math.radians(7)))),
    ],
)
def test_ahrs_orientation_turns_the_board(orientation: int, expected: tuple[float, float, float]) -> None:
    assert board_x(orientation) == pytest.approx(expected, abs=1e-7)


def test_orientations_101_and_102_are_the_custom_rotations_1_and_2() -> None:
    yaw_30 = (math.cos(math.radians(30)), math.sin(math.radians(30)), 0)
    first = board_x(101, CUST_ROT_ENABLE=1, CUST_ROT1_ROLL=0, CUST_ROT1_PITCH=0, CUST_ROT1_YAW=30)
    assert first == pytest.approx(yaw_30, abs=1e-7)
    second = board_x(102, CUST_ROT_ENABLE=1, CUST_ROT2_ROLL=20, CUST_ROT2_PITCH=90, CUST_ROT2_YAW=0)
    assert second == pytest.approx((0, 0, -1), abs=1e-7)


def test_orientation_100_of_4_1_and_before_has_angles_of_its_own() -> None:
    turned = board_x(100, AHRS_CUSTOM_ROLL=0, AHRS_CUSTOM_PIT=0, AHRS_CUSTOM_YAW=180)
    assert turned == pytest.approx((-1, 0, 0), abs=1e-7)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"INS_TCAL1_ENABLE": 2}, "INS_TCAL1_ENABLE is 2.*learning"),
        ({"INS_ACC_ID": 0}, "no IMU 1: INS_ACC_ID = 0"),
        ({"INS_GYR_ID": 0}, "no IMU 1: INS_GYR_ID = 0"),
        ({"INS_ACCSCAL_Y": 0.0}, "INS_ACCSCAL_Y is 0"),
        ({"INS_GYROFFS_Z": math.nan}, "INS_GYROFFS_Z is nan"),
        ({"AHRS_ORIENTATION": 77}, "AHRS_ORIENTATION is 77, expected a known orientation"),
        ({"AHRS_ORIENTATION": 101, "CUST_ROT_ENABLE": 0}, "AHRS_ORIENTATION is 101, expected CUST_ROT_ENABLE = 1"),
    ],
)
def test_what_cannot_be_worked_with_is_refused_with_a_reason(changed: dict[str, float], words: str) -> None:
    with pytest.raises(AutopilotError, match=words):
        read(IMU1 | changed)


def test_a_board_orientation_under_its_later_name() -> None:
    assert board_x(2, "BRD_ORIENTATION") == pytest.approx([0.0, 1.0, 0.0])


def test_an_instance_that_does_not_exist() -> None:
    with pytest.raises(AutopilotError, match="no IMU 3: INS_GYR3OFFS_X does not exist"):
        read(IMU1, 3)


def test_a_1_mb_board_without_temperature_calibration_by_param_error_or_by_silence() -> None:
    missing = {name: value for name, value in IMU1.items() if name != "INS_TCAL1_ENABLE"}
    for param_errors in (True, False):
        assert read(missing, autopilot=ScriptedAutopilot(param_errors=param_errors)).thermal == Thermal()


def only_warning(**changed: float) -> str:
    (warning,) = read(IMU1 | changed).warnings
    return warning


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"INS_GYR_CAL": 1}, "INS_GYR_CAL = 1: the next boot"),
        ({"INS_GYR_CAL": 2}, "INS_GYR_CAL = 2: the autopilot may measure the gyros at any time"),
        ({"INS_ACCOFFS_X": 0, "INS_ACCOFFS_Y": 0, "INS_ACCOFFS_Z": 0}, "3D Accel calibration needed"),
        ({"INS_ACCSCAL_X": 1.3}, "INS_ACCSCAL_X is 1.3, expected 0.8 to 1.2"),
        ({"INS_USE": 0}, "INS_USE = 0"),
    ],
)
def test_what_spoils_a_calibration_later_is_a_warning(changed: dict[str, float], words: str) -> None:
    assert words in only_warning(**changed)


def test_neither_ardupilot_nor_px4_is_not_supported() -> None:
    with pytest.raises(AutopilotError, match="neither ArduPilot nor PX4"):
        read(IMU1, autopilot=ScriptedAutopilot(autopilot=mavlink.MAV_AUTOPILOT_GENERIC))


def test_a_restart_while_reading_is_no_calibration() -> None:
    autopilot = ScriptedAutopilot()
    tasks: list[asyncio.Task[None]] = []

    def restart(message: object) -> bool:
        if getattr(message, "param_id", "") == "INS_ACCOFFS_Y" and not tasks:
            tasks.append(asyncio.ensure_future(autopilot.reboot(0.5)))
        return True

    autopilot.on_message = restart
    with pytest.raises(AutopilotRebootedError):
        read(IMU1, autopilot=autopilot)


def plain(**changes: object) -> ImuCalibration:
    calibration = ImuCalibration(
        instance=1,
        parameters=ArduPilotParameters(1),
        gyro_offset_rad_s=(0.001, 0.002, 0.003),
        accel_offset_m_s2=(0.1, 0.2, 0.3),
        accel_scale=(1.0, 1.0, 1.0),
        gyro_id=1,
        accel_id=1,
        orientation=np.eye(3),
        zero_is_uncalibrated=True,
    )
    return dataclasses.replace(calibration, **changes)  # type: ignore[arg-type]


def test_the_documented_run() -> None:
    # A real run: bias 0.3 read as +0.29928 with offset 0.001; offset 0.301 then reads -0.00092 (autopilots 9.1).
    calibration = plain(accel_offset_m_s2=(0.001, 0.0, 0.0))
    (x, _, _) = accel_offset_after(calibration, (0.30020, 0.0, 0.0))
    assert x == pytest.approx(0.301, abs=3e-4)


def test_a_zero_accelerometer_vector_is_written_as_almost_zero() -> None:
    calibration = plain()
    after = accel_offset_after(calibration, (-0.1, -0.2, -0.3))
    assert any(after)
    assert max(map(abs, after)) < 1e-3 * 9.8e-3  # a thousandth of a milli-g
    assert offsets_after(plain(gyro_offset_rad_s=(0.0, 0.0, 0.0)), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))[0] == (0, 0, 0)


def test_changes_come_accelerometers_first_and_only_what_is_asked() -> None:
    calibration = plain()
    names = [change.parameter for change in changes_for(calibration, (0.01, 0.0, 0.0), (0.1, 0.0, 0.0))]
    assert names == [f"INS_ACCOFFS_{a}" for a in "XYZ"] + [f"INS_GYROFFS_{a}" for a in "XYZ"]
    only = changes_for(calibration, (0.01, 0.0, 0.0), None)
    assert [change.parameter for change in only] == [f"INS_GYROFFS_{a}" for a in "XYZ"]
    assert only[0].after == f32(0.011)
    gyro, accel = output_step(calibration, only)
    assert gyro == pytest.approx((-0.01, 0.0, 0.0), abs=1e-8)
    assert accel == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("gyro", "accel", "words"),
    [
        ((0.09, 0, 0), (0, 0, 0), r"gyro residual X is 5\.16 deg/s, allowed are 5"),
        ((0, 0, 0), (0, 0, -1.1), r"accelerometer residual Z is -1\.1 m/s\^2, allowed are 1"),
        ((math.nan, 0, 0), (0, 0, 0), "gyro residual X is nan"),
        ((0, 0, 0), (0, math.inf, 0), "accelerometer residual Y is inf"),
    ],
)
def test_absurd_residuals_are_refused(
    gyro: tuple[float, float, float], accel: tuple[float, float, float], words: str
) -> None:
    with pytest.raises(CalibrationRefusedError, match=words):
        offsets_after(plain(), gyro, accel)


def test_absurd_whole_offsets_are_refused() -> None:
    with pytest.raises(CalibrationRefusedError, match="accelerometer offset X"):
        accel_offset_after(plain(accel_offset_m_s2=(3.0, 0, 0)), (0.9, 0, 0))
    with pytest.raises(CalibrationRefusedError, match="gyro offset Y"):
        offsets_after(plain(gyro_offset_rad_s=(0, 0.34, 0)), (0, 0.05, 0), (0, 0, 0))
