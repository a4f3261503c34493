"""Faults that keep a real firmware from arming: its text, our line with the culprit, the remedy, and then it arms."""

from __future__ import annotations

import asyncio
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.companion_process import CompanionProcess
from sim.sitl.daemon import companion_daemon
from sim.sitl.ground import GroundStation
from tests.sitl.ardupilot_bench import bench
from tests.sitl.px4_bench import SAVED_S, flying
from tests.sitl.test_ardupilot_second_imu import SECOND

pytestmark = pytest.mark.sitl

MANUAL = '\n[calibration]\nmin_still_s = 10\nmax_s = 40\nat_arm = "off"\n'
WITHIN_S = 120.0
MENDED_WITHIN_S = 300.0
SIX_DEG_S = math.radians(6.0)
ACCEPTED = mavlink.MAV_RESULT_ACCEPTED


async def finding(daemon: CompanionProcess, text: str, culprit: str, within_s: float = WITHIN_S) -> dict[str, Any]:
    """Wait until the status has a finding with this text of the firmware and these words of ours."""
    loop = asyncio.get_running_loop()
    give_up_s, found = loop.time() + within_s, []
    while loop.time() < give_up_s:
        status = await daemon.ask("status")
        found = status["diagnosis"]
        for one in found:
            if text in one["text"] and culprit in one["line"]:
                print(f"{one['line']} -> {one['remedy']}; headline {status['headline']}")
                return dict(one)
        await asyncio.sleep(1.0)
    raise AssertionError(f"{text}, {culprit}: found {found}; {daemon.log()}")


async def arms(ground: GroundStation, within_s: float = WITHIN_S) -> None:
    """Wait until the aircraft can be armed; disarm it again."""
    loop = asyncio.get_running_loop()
    give_up_s = loop.time() + within_s
    while (result := await ground.arm()) != ACCEPTED:
        texts = ground.texts_since(loop.time() - 5.0)
        assert loop.time() < give_up_s, (result, texts)
        await asyncio.sleep(5.0)
    await ground.arm(arm=False)


async def mended(daemon: CompanionProcess, ground: GroundStation) -> None:
    """Carry out the remedies one after another, as a pilot does, until nothing is left to fix; the aircraft arms."""
    loop = asyncio.get_running_loop()
    give_up_s, status = loop.time() + MENDED_WITHIN_S, {}
    while loop.time() < give_up_s:
        status = await daemon.ask("status")
        if not status["diagnosis"] and await ground.arm() == ACCEPTED:
            await ground.arm(arm=False)
            return
        fixes = [one for one in status["diagnosis"] if one["fix"]]
        if fixes:
            reply = await daemon.ask("fix")
            print(f"{fixes[0]['line']}; fix: {fixes[0]['fix']}: {reply['state']}: {reply['reason']}")
        await asyncio.sleep(5.0)
    raise AssertionError((status["diagnosis"], daemon.log()))


@pytest.mark.parametrize(
    ("parameter", "change", "text", "culprit"),
    [
        (
            "SIM_GYR2_BIAS_Z",
            math.radians(6.0),
            "Gyros inconsistent",
            "IMU 2 z is 6.0 deg/s off (limit 5.0), IMU 1 agrees",
        ),
        ("SIM_ACC2_BIAS_Y", 1.0, "Accels inconsistent", "IMU 2 y is 0.99 m/s^2 off (limit 0.75), IMU 1 agrees"),
    ],
)
def test_the_odd_imu_is_named_and_calibrating_lets_the_aircraft_arm(
    tmp_path: Path, parameter: str, change: float, text: str, culprit: str
) -> None:
    async def main() -> None:
        async with bench(tmp_path, script=True) as b, b.daemon(SECOND + MANUAL) as daemon:
            await b.ground.put("CMPG_ENABLE", 0.0)  # the script is here for its floats
            await b.ground.put(parameter, b.before[parameter] + change)
            found = await finding(daemon, text, culprit)
            assert "companion fix" in found["remedy"]
            assert await b.ground.arm() != ACCEPTED
            await mended(daemon, b.ground)

    asyncio.run(main())


def test_a_gyro_that_changed_since_its_calibration_is_to_be_replaced_or_left_out(tmp_path: Path) -> None:
    async def main() -> None:
        async with bench(tmp_path, script=True) as b, b.daemon(SECOND + MANUAL) as daemon:
            await b.ground.put("CMPG_ENABLE", 0.0)
            assert (await daemon.calibrate(MENDED_WITHIN_S))["state"] == "done"
            await b.ground.put("SIM_GYR2_BIAS_Z", b.before["SIM_GYR2_BIAS_Z"] + SIX_DEG_S)
            found = await finding(daemon, "Gyros inconsistent", "IMU 2 z is 6.0 deg/s off")
            assert "changed by 6.0 deg/s since its calibration" in found["line"]
            assert found["remedy"] == "replace IMU 2 or set INS_USE2 = 0"
            await b.ground.put("INS_USE2", 0.0)
            await mended(daemon, b.ground)

    asyncio.run(main())


def test_the_turned_compass_is_named_and_leaving_it_out_lets_the_aircraft_arm(tmp_path: Path) -> None:
    async def main() -> None:
        async with bench(tmp_path) as b, b.daemon(MANUAL) as daemon:
            await b.ground.put("SIM_MAG2_ORIENT", 1.0)  # ROTATION_YAW_45
            found = await finding(daemon, "Compasses inconsistent", "compass 2 heading is")
            off = re.search(r"compass 2 heading is (\d+) deg off", found["line"])
            assert off is not None
            assert abs(int(off[1]) - 45) <= 6  # its offsets did not turn with it
            assert found["remedy"].endswith("or set COMPASS_USE2 = 0")
            await b.ground.put("COMPASS_USE2", 0.0)
            await mended(daemon, b.ground)

    asyncio.run(main())


def test_missing_gnss_is_named_and_its_return_lets_the_aircraft_arm(tmp_path: Path) -> None:
    async def main() -> None:
        async with bench(tmp_path) as b, b.daemon(MANUAL) as daemon:
            await b.ground.put("SIM_GPS1_ENABLE", 0.0)
            await b.ground.command(mavlink.MAV_CMD_DO_SET_MODE, 1.0, 5.0)  # LOITER needs a position
            found = await finding(daemon, "GPS 1: Bad fix", "GPS 1: Bad fix")
            assert found["remedy"].startswith("wait under open sky")
            assert await b.ground.arm() != ACCEPTED
            await b.ground.put("SIM_GPS1_ENABLE", 1.0)
            await arms(b.ground)

    asyncio.run(main())


PX4_TEXT = "SYS_STATUS: "  # PX4 sends its texts to ground stations only


def test_px4s_odd_accelerometer_is_named_and_calibrating_lets_the_aircraft_arm(tmp_path: Path) -> None:
    async def main() -> None:
        folder = tmp_path / "daemon"
        folder.mkdir()
        async with (
            flying(tmp_path / "px4") as (vehicle, ground),
            companion_daemon(vehicle, folder, more=MANUAL) as daemon,
        ):
            # PX4 compares with the mean of all: of two IMUs each differs by half of the error.
            await ground.put("COM_ARM_IMU_ACC", 0.4)
            gyro, accel = vehicle.true_bias(2, vehicle.now_s)
            vehicle.imus[1].turn_on(gyro, np.add(accel, (0.0, 1.0, 0.0)))
            found = await finding(daemon, PX4_TEXT + "accelerometer", "IMU 2 y is 0.9")
            assert "(limit 0.40), IMU 1 agrees" in found["line"]
            assert "companion fix" in found["remedy"]
            assert await ground.arm() != ACCEPTED
            await mended(daemon, ground)

    asyncio.run(main())


def test_px4s_odd_gyro_is_named_and_leaving_it_out_lets_the_aircraft_arm(tmp_path: Path) -> None:
    async def main() -> None:
        folder = tmp_path / "daemon"
        folder.mkdir()
        async with flying(tmp_path / "px4") as (vehicle, ground):
            await ground.put("COM_ARM_IMU_GYR", 0.04)
            # PX4 would mend it by itself, and reads this parameter at a start.
            await ground.put("IMU_GYRO_CAL_EN", 0.0)
            await vehicle.sleep(SAVED_S)
            await vehicle.power_cycle()
            async with companion_daemon(vehicle, folder, more=MANUAL) as daemon:
                gyro, accel = vehicle.true_bias(2, vehicle.now_s)
                vehicle.imus[1].turn_on(np.add(gyro, (0.0, 0.0, SIX_DEG_S)), accel)
                found = await finding(daemon, PX4_TEXT + "gyro", "IMU 2 z is 6.")
                assert "(limit 2.3), IMU 1 agrees" in found["line"]
                assert found["remedy"] == "replace IMU 2 or set CAL_GYRO1_PRIO = 0"
                assert await ground.arm() != ACCEPTED
                await ground.put("CAL_GYRO1_PRIO", 0.0)
                await arms(ground)

    asyncio.run(main())


def test_px4s_missing_gnss_is_named_and_its_return_lets_the_aircraft_arm(tmp_path: Path) -> None:
    async def main() -> None:
        folder = tmp_path / "daemon"
        folder.mkdir()
        async with (
            flying(tmp_path / "px4") as (vehicle, ground),
            companion_daemon(vehicle, folder, more=MANUAL) as daemon,
        ):
            await ground.put("COM_ARM_WO_GPS", 0.0)  # a position is required
            vehicle.backend.gnss = False
            found = await finding(daemon, PX4_TEXT, "unhealthy")
            assert found["remedy"].startswith("wait under open sky")
            assert await ground.arm() != ACCEPTED
            vehicle.backend.gnss = True
            await arms(ground)

    asyncio.run(main())


RISE_K, TCONST_S, LASTS_K, BOOT_S = 20.0, 100.0, 3.0, 5.0


async def test_the_countdown_of_a_cold_start_holds_the_truth(tmp_path: Path) -> None:
    """By the simulator's law of temperature; a calibration lasts from 3 K below the end."""
    async with bench(tmp_path) as b:
        ramp = {"SIM_IMUT_START": 5.0, "SIM_IMUT_END": 5.0 + RISE_K, "SIM_IMUT_TCONST": TCONST_S}
        await b.ground.put_all({**ramp, "SIM_IMUT_FIXED": 0.0})
        await b.vehicle.sleep(3.0)  # until it is stored
        await b.vehicle.power_cycle()
        lasts_s = asyncio.get_running_loop().time() + TCONST_S * math.log(RISE_K / LASTS_K)
        holds: list[bool] = []
        async with b.daemon(MANUAL) as daemon:
            while (left_s := lasts_s - asyncio.get_running_loop().time()) > 0.0:
                if (shown := (await daemon.ask("status"))["arming"]["warm_up"]) is not None:
                    holds.append(shown["low_s"] - BOOT_S <= left_s <= shown["high_s"] + BOOT_S)
                    print(f"{left_s:.0f} s left; {shown}", flush=True)
                await asyncio.sleep(5.0)
            await asyncio.sleep(TCONST_S)
            assert (await daemon.ask("status"))["arming"]["warm_up"] is None
        assert len(holds) > 10
        assert np.mean(holds) >= 0.9
