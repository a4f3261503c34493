"""The firmwares' own calibrations on the tilted aircraft (autopilots 3, 4.6, 9.3). Named to run late."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.imu_model import DEG_H
from tests.sitl.craft import Autopilot, Craft

CALIBRATE = mavlink.MAV_CMD_PREFLIGHT_CALIBRATION


@pytest.mark.only("ardupilot")
def test_the_gyro_calibration_of_ardupilot_swallows_the_earths_rate_and_answers_when_it_is_done(
    autopilot: Autopilot,
) -> None:
    async def main(craft: Craft) -> None:
        ground, loop = craft.ground, asyncio.get_running_loop()
        names = tuple(f"INS_GYROFFS_{axis}" for axis in "XYZ")
        others = tuple(f"INS_GYR2OFFS_{axis}" for axis in "XYZ")
        async with ground.restored(*names, *others):
            begun_s = loop.time()
            assert await ground.command(CALIBRATE, 1.0, wait_s=35.0) == mavlink.MAV_RESULT_ACCEPTED
            assert 0.4 < loop.time() - begun_s < 5.0
            found = np.array([await ground.get(name) for name in names])
            # White noise of one window of a quarter second: some 15 deg/h.
            np.testing.assert_allclose(found / DEG_H, craft.expected(1)[:3] / DEG_H, atol=70.0)

    autopilot.run(main)


@pytest.mark.only("ardupilot")
def test_while_ardupilot_calibrates_its_gyros_telemetry_stops_and_offsets_read_zero(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground, loop = craft.ground, asyncio.get_running_loop()
        names = tuple(f"INS_{gyro}OFFS_{axis}" for gyro in ("GYR", "GYR2") for axis in "XYZ")
        highres: int = mavlink.MAVLINK_MSG_ID_HIGHRES_IMU
        async with ground.restored(*names):
            await ground.put("INS_GYROFFS_X", 0.001)
            assert await ground.stream(highres, 50.0) == mavlink.MAV_RESULT_ACCEPTED
            await asyncio.sleep(1.0)
            begun_s = loop.time()
            calibrating = asyncio.create_task(ground.command(CALIBRATE, 1.0, wait_s=35.0))
            await asyncio.sleep(0.1)
            meanwhile = []
            while not calibrating.done():
                meanwhile.append(await ground.get("INS_GYROFFS_X"))
                await asyncio.sleep(0.05)
            await asyncio.sleep(0.5)
            seen = ground.all(mavlink.MAVLink_highres_imu_message, since_s=begun_s - 0.5)
            await ground.stream(highres, 0.0)
            assert 0.0 in meanwhile
            assert set(meanwhile[:-1]) <= {0.0, meanwhile[-1]}
            assert await ground.get("INS_GYROFFS_X") not in (0.0, 0.001)
            gaps_s = np.diff([message.time_usec for message in seen]) * 1e-6
            assert 0.4 < gaps_s.max() < 5.0
            assert np.median(gaps_s) < 0.05

    autopilot.run(main)


@pytest.mark.only("ardupilot")
def test_a_repeated_gyro_calibration_of_ardupilot_is_answered_early_while_it_still_measures(
    autopilot: Autopilot,
) -> None:
    async def main(craft: Craft) -> None:
        ground, loop = craft.ground, asyncio.get_running_loop()
        names = tuple(f"{name}_{axis}" for name in ("INS_GYROFFS", "INS_GYR2OFFS") for axis in "XYZ")
        async with ground.restored(*names):
            begun_s = loop.time()
            command = mavlink.MAVLink_command_long_message(ground.vehicle, 1, CALIBRATE, 0, 1.0, *[0.0] * 6)
            for _ in range(2):
                ground.send(command)
                await asyncio.sleep(0.05)

            def answers() -> list[float]:
                acks = ground.timed(mavlink.MAVLink_command_ack_message, since_s=begun_s)
                return [t_s - begun_s for t_s, ack in acks if ack.command == CALIBRATE and ack.result == 0]

            await ground.wait_for(lambda: len(answers()) >= 2, 35.0, "both answers")
            early_s, last_s = answers()[:2]
            assert last_s > 0.4
            assert last_s - early_s > 0.1

    autopilot.run(main)


@pytest.mark.only("px4")
def test_the_gyro_calibration_of_px4_says_done_and_leaves_small_biases_whole(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground, loop = craft.ground, asyncio.get_running_loop()
        since_s = loop.time()
        assert await ground.command(CALIBRATE, 1.0) == mavlink.MAV_RESULT_ACCEPTED
        assert loop.time() - since_s < 0.6  # at the start, not at the end
        await ground.wait_for(lambda: "calibration done" in ground.texts_since(since_s), 30.0, "[cal]")
        assert "calibration started: 2 gyro" in ground.texts_since(since_s)
        for instance in (0, 1):
            for axis in "XYZ":
                assert await ground.get(f"CAL_GYRO{instance}_{axis}OFF") == pytest.approx(0.0, abs=1e-6)

    autopilot.run(main)
