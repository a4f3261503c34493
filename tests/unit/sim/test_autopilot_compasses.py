"""Compasses of both doubles: messages against vectors that were calculated by hand."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import Pose, Site, VirtualAircraft
from sim.earth import mounting_matrix
from sim.firmware.compass import SimCompass
from tests.support.px4_stage import LATEST_S, PX4Stage
from tests.unit.sim.test_autopilot_parameters import ParameterStage

SITE = Site(field_gauss=math.hypot(0.3005, 0.4005), inclination_deg=math.degrees(math.atan2(0.4005, 0.3005)))
HARD, SOFT = (10.0, -20.0, 30.5), np.array([[1.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 0.5]])
RAW = (300.5 * 4 / 3 - 10.0, -300.5 * 2 / 3 + 20.0, 801.0 - 30.5)  # mG, nose to the north: 390.67, -180.33, 770.5
RIGHT = mounting_matrix(0.0, 0.0, 90.0)  # The sensor's x points to the right, its y backwards
CORRECT, WITH_IRON = np.array([0.3005, 0.0, 0.4005]), 1e-3 * np.array(RAW)
HIGHRES, RAW_IMU, SCALED, SCALED2, SCALED3 = 105, 27, 26, 116, 129


def made(kind: type[Any], *compasses: SimCompass, heading_deg: float = 0.0, **parameters: float) -> Any:
    aircraft = VirtualAircraft(Pose(heading_deg=heading_deg), SITE)
    return kind(aircraft=aircraft, compasses=compasses or None, parameters=parameters, spec="perfect")


async def shown(stage: ParameterStage | PX4Stage, message_id: int, **written: float) -> list[float] | None:
    """Write parameters, wait until everybody has read them, and request a message: its field; None: none comes."""
    for name, value in written.items():
        await (stage.set if isinstance(stage, PX4Stage) else stage.companion.set_parameter)(name, value)
    await asyncio.sleep(2.0 * LATEST_S)
    since_s = asyncio.get_running_loop().time()
    await stage.companion.command(mavlink.MAV_CMD_REQUEST_MESSAGE, message_id)
    seen: list[Any] = stage.companion.all(mavlink.mavlink_map[message_id], since_s=since_s)
    return [seen[-1].xmag, seen[-1].ymag, seen[-1].zmag] if seen else None


async def test_a_spot_bends_the_field_by_the_attitude() -> None:
    along_the_nose = SimCompass(spot=lambda body_from_ned: 100.0 * body_from_ned[0])
    async with made(ParameterStage, along_the_nose, heading_deg=90.0) as stage:
        assert await shown(stage, HIGHRES) == pytest.approx([0.1, -0.3005, 0.4005])


async def test_ardupilot_corrects_its_fields_by_offsets_matrix_and_scale_and_cuts_them_off() -> None:
    async with made(ParameterStage, SimCompass(HARD, SOFT)) as stage:
        assert await shown(stage, RAW_IMU) == await shown(stage, SCALED) == [390, -180, 770]
        offset = {"COMPASS_OFS_X": 10.0, "COMPASS_OFS_Y": -20.0, "COMPASS_OFS_Z": 30.0}
        assert await shown(stage, RAW_IMU, **offset) == [400, -200, 800]
        assert await shown(stage, RAW_IMU, COMPASS_DIA_Z=0.5, COMPASS_ODI_X=0.5) == [300, 0, 400]
        assert await shown(stage, RAW_IMU, COMPASS_SCALE=1.25) == [375, 0, 500]
        assert await shown(stage, HIGHRES, COMPASS_SCALE=1.6, COMPASS_OFS_Z=30.5) == pytest.approx(CORRECT, abs=1e-6)


async def test_ardupilot_numbers_its_messages_by_priority_and_its_parameters_by_compass() -> None:
    order = {"COMPASS_PRIO1_ID": 131874, "COMPASS_PRIO2_ID": 97539}
    both = SimCompass(HARD, SOFT), SimCompass(mounting=RIGHT, external=True)
    async with made(ParameterStage, *both, COMPASS_ORIENT=2, **order) as stage:
        assert await shown(stage, RAW_IMU) == [0, -300, 400]
        assert await shown(stage, RAW_IMU, COMPASS_ORIENT2=2) == [300, 0, 400]  # Yaw 90
        assert [await shown(stage, number) for number in (SCALED2, SCALED3)] == [[390, -180, 770], None]
        assert await shown(stage, HIGHRES, COMPASS_USE=0) == pytest.approx(WITH_IRON)
        assert await shown(stage, SCALED2, COMPASS_PRIO1_ID=97539, COMPASS_PRIO2_ID=131874) == [390, -180, 770]
        stage.double.reboot(1.0)
        assert await shown(stage, SCALED2) == [300, 0, 400]


async def test_noise_comes_ten_times_a_second_unless_the_compass_is_stuck() -> None:
    compass = SimCompass(noise_mgauss=2.0)
    async with made(ParameterStage, compass) as stage:
        await stage.companion.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, HIGHRES, 20_000)
        for compass.stuck in (False, True):
            await asyncio.sleep(60.0)
            x_gauss = [message.xmag for message in stage.companion.all(mavlink.MAVLink_highres_imu_message)]
            assert len(set(x_gauss)) == pytest.approx(600, abs=3)
        assert np.std(x_gauss[:3000]) == pytest.approx(0.002, rel=0.1)


async def test_px4_shows_raw_fields_in_sensor_axes_and_the_corrected_one_of_the_preferred_compass() -> None:
    outside, bias = SimCompass(HARD, SOFT, mounting=RIGHT, external=True), np.array([0.01, 0.0, -0.02])
    async with made(PX4Stage, SimCompass(), outside, CAL_MAG1_ROT=2) as stage:
        assert [await shown(stage, number) for number in (SCALED, SCALED2)] == [[300, 0, 400], [-180, -390, 770]]
        assert await shown(stage, HIGHRES) == pytest.approx(WITH_IRON, abs=1e-6)
        stage.double.mag_bias_gauss = bias
        right = {"CAL_MAG1_XOFF": 0.02, "CAL_MAG1_YOFF": 0.01, "CAL_MAG1_ZOFF": -0.0305, "CAL_MAG1_XODIAG": -0.5}
        assert await shown(stage, HIGHRES, **right, CAL_MAG1_ZSCALE=0.5) == pytest.approx(CORRECT, abs=1e-6)
        stage.double.mag_bias_gauss = bias
        assert await shown(stage, HIGHRES) == pytest.approx(CORRECT - bias, abs=1e-6)
        assert await shown(stage, HIGHRES, CAL_MAG1_PRIO=0, CAL_MAG0_XOFF=0.1) == pytest.approx([0.2005, 0.0, 0.4005])


async def test_px4_ignores_small_changes_after_a_restart_too() -> None:
    async with made(PX4Stage) as stage:
        small = await shown(stage, HIGHRES, CAL_MAG0_ZOFF=0.0049, CAL_MAG0_XSCALE=1.0099, CAL_MAG0_YODIAG=0.0099)
        assert small == pytest.approx(CORRECT)
        stage.double.reboot(1.0)
        assert await shown(stage, HIGHRES) == pytest.approx(CORRECT)
        assert await shown(stage, HIGHRES, CAL_MAG0_ZOFF=0.01) == pytest.approx([0.3005, 0.0, 0.3905])
        assert await shown(stage, HIGHRES, CAL_MAG0_ZOFF=0.0145) == pytest.approx([0.3005, 0.0, 0.3905])
        stage.double.reboot(1.0)
        assert await shown(stage, HIGHRES) == pytest.approx([0.3005, 0.0, 0.386])
        large = await shown(stage, HIGHRES, CAL_MAG0_XSCALE=1.02, CAL_MAG0_YODIAG=0.02)
        assert large == pytest.approx([0.3005 * 1.02 + 0.386 * 0.02, 0.0, 0.386 + 0.3005 * 0.02])


@pytest.mark.parametrize("kind", [ParameterStage, PX4Stage])
async def test_both_set_offsets_by_a_known_heading(kind: type[Any]) -> None:
    own = {"COMPASS_ORIENT": 2} if kind is ParameterStage else {"CAL_MAG0_ROT": 100, "CAL_MAG0_YAW": 90.0}
    compass = SimCompass(HARD, mounting=RIGHT, external=True)
    async with made(kind, compass, heading_deg=40.0, **own) as stage:
        assert await stage.companion.command(mavlink.MAV_CMD_FIXED_MAG_CAL_YAW, 43.0) == 0
        x, y, _ = await shown(stage, HIGHRES) or (0.0, 0.0, 0.0)
        assert math.degrees(math.atan2(-y, x)) == pytest.approx(43.0, abs=0.3)  # The accelerometer's bias tilts it
        stage.double.arm()
        assert await stage.companion.command(mavlink.MAV_CMD_FIXED_MAG_CAL_YAW, 40.0) == (kind is PX4Stage)  # Rejected
