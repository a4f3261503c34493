"""The aircraft under the autopilots: it moves, it loses power, and the firmware tells of both."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.firmware.messages import SCALED_IMU
from sim.imu_model import MG
from sim.motions import Handling, Turn
from tests.sitl.craft import Autopilot, Craft

SYSTEM_TIME = mavlink.MAVLink_system_time_message
OFFSET = {"ardupilot": "INS_GYROFFS_Y", "px4": "CAL_GYRO1_YOFF"}
SPEED = {"ardupilot": 100.0, "px4": 250.0}


def test_a_motion_of_the_aircraft_shows_in_the_telemetry_and_ends(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        async def fastest_deg_s() -> float:
            rows = await craft.ground.imu(SCALED_IMU[0], 2.5, rate_hz=SPEED[craft.firmware])
            return float(np.degrees(np.abs(rows[:, :3]).max()))

        assert await fastest_deg_s() < 0.5
        craft.move(Handling(start_s=craft.now_s + 0.3, duration_s=2.0, angle_deg=4.0))
        assert await fastest_deg_s() > 3.0
        assert await fastest_deg_s() < 0.5

    autopilot.run(main)


def test_a_turn_is_measured_by_the_gyros_to_its_size_and_undone(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground = craft.ground
        for sign in (1.0, -1.0):
            await ground.stream(SCALED_IMU[0].id, SPEED[craft.firmware])
            since_s = asyncio.get_running_loop().time()
            craft.move(Turn(start_s=craft.now_s + 0.5, duration_s=2.0, pitch_deg=6.0 * sign))
            await asyncio.sleep(3.2)
            seen = ground.all(SCALED_IMU[0], since_s=since_s)
            times = np.array([m.time_boot_ms for m in seen]) * 1e-3
            rates = np.array([m.ygyro for m in seen]) * 1e-3
            # Level in roll but for 3 degrees, so pitch rate is the body's y rate times cos 3 deg.
            turned = np.degrees(np.sum((rates[1:] + rates[:-1]) / 2.0 * np.diff(times)))
            assert turned == pytest.approx(6.0 * sign * np.cos(np.radians(3.0)), abs=0.35)
        after = (await ground.imu(SCALED_IMU[0], 2.0, rate_hz=SPEED[craft.firmware])).mean(axis=0)
        np.testing.assert_allclose(after[3:] / MG, craft.expected(1)[3:] / MG, atol=1.2)

    autopilot.run(main)


def test_a_power_cycle_keeps_parameters_and_starts_the_clock_from_zero(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground = craft.ground
        name = OFFSET[craft.firmware]
        async with ground.restored(name):
            await ground.put(name, 0.0123)
            await ground.stream(SYSTEM_TIME.id, 5.0)
            since_s = asyncio.get_running_loop().time()
            before = await ground.wait_message(SYSTEM_TIME, 5.0, since_s=since_s)
            await craft.reboot()
            since_s = asyncio.get_running_loop().time()
            await ground.stream(SYSTEM_TIME.id, 5.0)
            after = await ground.wait_message(SYSTEM_TIME, 5.0, since_s=since_s)
            assert before.time_boot_ms > 20_000
            assert after.time_boot_ms < 20_000
            assert await ground.get(name) == pytest.approx(0.0123, rel=1e-6)
        if craft.firmware == "px4":  # back below its threshold only with a boot
            await craft.reboot()

    autopilot.run(main, 120.0)


def test_the_commanded_reboot_brings_it_back_too(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground, loop = craft.ground, asyncio.get_running_loop()
        await ground.stream(SYSTEM_TIME.id, 5.0)
        await asyncio.sleep(1.0)
        since_s = loop.time()
        result = await ground.command(mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, 1.0)
        if craft.real and craft.firmware == "px4":  # a simulated board has no reset to pull: cut its power instead
            assert result == mavlink.MAV_RESULT_DENIED
            return
        assert result == mavlink.MAV_RESULT_ACCEPTED
        await asyncio.sleep(1.0)
        begun_s = loop.time()
        await ground.wait_for(lambda: len(ground.vehicle_heartbeats(begun_s)) >= 3, 60.0, "heartbeats")
        await ground.stream(SYSTEM_TIME.id, 5.0)
        message = await ground.wait_message(SYSTEM_TIME, 5.0, since_s=loop.time())
        assert message.time_boot_ms * 1e-3 < loop.time() - since_s + 1.0

    autopilot.run(main, 120.0)
