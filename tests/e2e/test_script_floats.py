"""The IMUs of an ArduPilot whose integers tell nothing, in floats from the script that we install on it."""

from __future__ import annotations

import asyncio
from pathlib import Path

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config.sections import Imu
from companion.estimation.machine import What
from sim.ardupilot.double import ArduPilotDouble
from sim.ardupilot.parameters import offset_names
from sim.imu_model import DEG_H, MG, AxisNoise, ImuModel, ImuSpec
from sim.px4.double import PX4Double
from tests.e2e.test_calibration import calibrated
from tests.support.rig import Rig
from tests.support.wire import Wire

FLOATS = "floats of the script"
QUIET = ImuSpec(name="quiet", gyro=AxisNoise(white=3.0 * DEG_H), accel=AxisNoise(white=20e-3 * MG))
"""Noise of 0.1 integer steps behind the autopilot's filter: the integers stand still."""
BIASES = (((100.0, -60.0, 170.0), (1.0, -2.0, 3.0)), ((-80.0, 40.0, 150.0), (-2.0, 1.0, 4.0)))
"""deg/h and mg of IMU 2 and 3, inside the dead band of the integers."""


def three_imus(folder: Path, *, script: bool, max_s: float = 60.0) -> Rig:
    """Make a daemon that calibrates all three IMUs of an ArduPilot."""
    rig = Rig(folder, max_s=max_s, min_still_s=min(max_s, 10.0), seed=3)
    imus = [Imu(name=f"fc{k}", source="autopilot", instance=k, profile="icm42688p") for k in (1, 2, 3)]
    rig.config = msgspec.structs.replace(rig.config, imu=imus)
    others = [
        ImuModel(
            rig.aircraft,
            QUIET,
            seed=13 + k,
            gyro_bias_rad_s=[value * DEG_H for value in gyro],
            accel_bias_m_s2=[value * MG for value in accel],
        )
        for k, (gyro, accel) in enumerate(BIASES)
    ]
    # On for an hour: the figures asked of it are without what a warm-up might do.
    rig.autopilot = ArduPilotDouble(
        rig.aircraft, [rig.model, *others], parameters={"INS_GYR_CAL": 0.0}, seed=3, up_s=3600.0, script=script
    )
    rig.wire, rig.radio = Wire(rig.link, rig.double, seed=3), Wire(rig.ground, rig.double.ground, seed=4)
    return rig


def messages(rig: Rig) -> list[str | None]:
    imus = rig.service.devices.imus.values()
    return [None if imu.stream.kind is None else imu.stream.kind.name for imu in imus]


async def test_every_imu_is_calibrated_from_floats_without_a_write_before_the_result(tmp_path: Path) -> None:
    async with three_imus(tmp_path, script=True).running() as rig:
        await rig.until(lambda: messages(rig) == ["HIGHRES_IMU", FLOATS, FLOATS], 15.0)
        _, record = await calibrated(rig, What.BOTH)
        assert [imu.name for imu in record.imus] == ["fc1", "fc2", "fc3"]
        for instance, imu in zip((2, 3), record.imus[1:], strict=True):
            left = rig.double.residual(instance, rig.now_s)
            assert np.abs(left.gyro_rad_s).max() / DEG_H < 4.0
            assert np.abs(left.accel_m_s2).max() / MG < 0.15  # the gradienter of this rig is good to 0.1 mg
            outcomes = {imu.written[name].outcome for name in offset_names(instance, "gyro")}
            assert outcomes == {"verified"}
        # Six offsets of each IMU, and the gyros' again over the firmware's own calibration.
        assert len(rig.double.writes) == 3 * 9


async def test_without_the_script_the_quiet_ones_are_left_alone_and_the_words_name_it(tmp_path: Path) -> None:
    async with three_imus(tmp_path, script=False, max_s=12.0).running() as rig:
        await rig.until(lambda: messages(rig) == ["HIGHRES_IMU", "SCALED_IMU2", "SCALED_IMU3"], 15.0)
        _, record = await calibrated(rig, What.GYROS)
        assert [imu.name for imu in record.imus if imu.gyro_bias_rad_s is not None] == ["fc1"]
        for imu in record.imus[1:]:
            assert "companion autopilot script" in " ".join(imu.warnings), imu.warnings
        written = {write.name for write in rig.double.writes}
        assert not written & {*offset_names(2, "gyro"), *offset_names(3, "gyro")}


async def test_armed_it_is_quiet_and_the_integers_are_there_instead(tmp_path: Path) -> None:
    async with three_imus(tmp_path, script=True).running() as rig:
        await rig.until(lambda: messages(rig)[1:] == [FLOATS, FLOATS], 15.0)
        rig.double.arm()
        await rig.until(lambda: messages(rig)[1:] == ["SCALED_IMU2", "SCALED_IMU3"], 10.0)
        rig.double.disarm()
        await rig.until(lambda: messages(rig)[1:] == [FLOATS, FLOATS], 10.0)


async def test_nothing_is_asked_of_the_script_for_an_imu_that_has_better(tmp_path: Path) -> None:
    rig = three_imus(tmp_path, script=True)
    rig.config = msgspec.structs.replace(rig.config, imu=rig.config.imu[:1])
    async with rig.running():
        await rig.until(lambda: messages(rig) == ["HIGHRES_IMU"], 15.0)
        asked = rig.double.channels[0].received["TUNNEL"]
        await asyncio.sleep(10.0)
        assert rig.double.channels[0].received["TUNNEL"] == asked


@pytest.mark.parametrize("name", [b"OTHERS", b"CMP_IMU"])
async def test_somebody_elses_float_arrays_are_no_samples(tmp_path: Path, name: bytes) -> None:
    async with three_imus(tmp_path, script=False).running() as rig:
        await rig.until(lambda: messages(rig)[1:] == ["SCALED_IMU2", "SCALED_IMU3"], 15.0)
        version = 2 if name == b"CMP_IMU" else 1
        for count in range(40):
            values = [0.001 * count, *[float("nan")] * 20, *[1.0] * 37]
            array = mavlink.MAVLink_debug_float_array_message(count * 50_000, name, version, values)
            rig.double.channels[0].send(array)
            await asyncio.sleep(0.05)
        assert messages(rig)[1:] == ["SCALED_IMU2", "SCALED_IMU3"]


def px4(folder: Path, *, console: bool, max_s: float = 60.0) -> Rig:
    """Make a PX4 with two quiet IMUs, of which the second is in integers only."""
    rig = Rig(folder, firmware="px4", max_s=max_s, min_still_s=10.0, seed=3)
    imus = [Imu(name=f"fc{k}", source="autopilot", instance=k, profile="icm42688p") for k in (1, 2)]
    rig.config = msgspec.structs.replace(rig.config, imu=imus)
    models = [
        ImuModel(
            rig.aircraft,
            QUIET,
            seed=13 + k,
            gyro_bias_rad_s=[value * DEG_H for value in gyro],
            accel_bias_m_s2=[value * MG for value in accel],
        )
        for k, (gyro, accel) in enumerate(BIASES)
    ]
    parameters = {"MAV_1_FORWARD": 1.0, "IMU_GYRO_CAL_EN": 0.0, "SENS_IMU_AUTOCAL": 0.0}
    rig.autopilot = PX4Double(
        rig.aircraft, models, parameters=parameters, console=console, seed=3, up_s=3600.0, default_streams=False
    )
    rig.wire, rig.radio = Wire(rig.link, rig.autopilot, seed=3), Wire(rig.ground, rig.autopilot.ground, seed=4)
    return rig


async def test_px4s_console_tells_the_second_imu_without_a_write_before_the_result(tmp_path: Path) -> None:
    async with px4(tmp_path, console=True).running() as rig:
        await rig.until(lambda: messages(rig) == ["HIGHRES_IMU+bias", "SCALED_IMU2"], 30.0)
        await calibrated(rig, What.BOTH)
        left = rig.px4.residual(2, rig.now_s)
        assert np.abs(left.gyro_rad_s).max() / DEG_H < 6.0
        assert np.abs(left.accel_m_s2).max() / MG < 0.15
