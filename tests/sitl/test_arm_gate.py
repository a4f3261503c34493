"""The gate on real firmware with the real daemon (autopilots 5.2, 5.3, 9.2).

Each takes some minutes of real time: the estimators of the firmware settle at their own pace.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.lua import ARMING_SCRIPT
from sim.companion_process import CompanionProcess
from sim.motions import Handling
from sim.sitl.ardupilot import ArduPilotSitl
from sim.sitl.daemon import companion_daemon
from sim.sitl.ground import GroundStation
from sim.sitl.px4 import Px4Sitl, free_instance
from sim.sitl.residuals import ground_station
from sim.sitl.vehicle import SitlVehicle
from tests.sitl.craft import BINARIES, missing, world

ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
FORCE = 21196.0
GATE = '\n[calibration]\nat_arm = "gate"\nmax_s = 60.0\n'
SILENT = "Companion silent: arming blocked"

pytestmark = pytest.mark.sitl


def binary(kind: str) -> Path:
    reason = missing(kind)
    if reason is not None:
        pytest.skip(reason)
    return Path(os.environ[BINARIES[kind]])


def said(ground: GroundStation, since_s: float = 0.0) -> str:
    return " | ".join(m.text for m in ground.all(mavlink.MAVLink_statustext_message, since_s=since_s))


async def arm(ground: GroundStation, vehicle: SitlVehicle, force: float = 0.0) -> tuple[bool, str]:
    """Try to arm; return success and texts; disarm again."""
    since_s = asyncio.get_running_loop().time()
    result = await ground.command(ARM, 1.0, force, target=(vehicle.system_id, 1), wait_s=15.0)
    await vehicle.sleep(2.5)
    words = said(ground, since_s)
    if result == mavlink.MAV_RESULT_ACCEPTED:
        await ground.command(ARM, 0.0, FORCE, target=(vehicle.system_id, 1))
        await vehicle.sleep(1.5)
    return result == mavlink.MAV_RESULT_ACCEPTED, words


async def until_ready(daemon: CompanionProcess, within_s: float = 240.0) -> None:
    """Wait until the companion would let it arm."""
    await until_arming(daemon, lambda arming: arming["verdict"] == "accept", within_s)


async def until_arming(
    daemon: CompanionProcess, wanted: Callable[[dict[str, Any]], bool], within_s: float = 60.0
) -> None:
    """Wait for what its status says of arming."""
    loop = asyncio.get_running_loop()
    deadline_s = loop.time() + within_s
    while True:
        status = await daemon.status()
        if status is not None and wanted(status["arming"]):
            return
        assert loop.time() < deadline_s, (status, daemon.log())
        await asyncio.sleep(1.0)


async def until_it_arms(ground: GroundStation, vehicle: SitlVehicle, within_s: float = 120.0) -> str:
    """Try until every other reason of the firmware is gone; what was said at last."""
    loop = asyncio.get_running_loop()
    deadline_s = loop.time() + within_s
    while True:
        armed, words = await arm(ground, vehicle)
        if armed:
            return words
        assert loop.time() < deadline_s, words
        await asyncio.sleep(3.0)


async def seconds_until_said(ground: GroundStation, vehicle: SitlVehicle, words: str, within_s: float = 20.0) -> float:
    """Time until ArduPilot's pre-arm checks give a reason; on its clock, which a busy machine slows down."""
    begun_s = vehicle.physics_s
    while vehicle.physics_s < begun_s + within_s:
        since_s = asyncio.get_running_loop().time()
        await ground.command(mavlink.MAV_CMD_RUN_PREARM_CHECKS, wait_s=1.0)
        await asyncio.sleep(0.25)
        if words in said(ground, since_s):
            return vehicle.physics_s - begun_s
    raise AssertionError(f"{words!r} was not said within {within_s:g} s")


@contextlib.asynccontextmanager
async def flying(vehicle: SitlVehicle) -> AsyncIterator[GroundStation]:
    async with vehicle, ground_station(vehicle) as ground:
        await ground.wait_for(lambda: bool(ground.vehicle_heartbeats()), 60.0, "a heartbeat")
        yield ground


async def test_px4_arms_only_with_a_fresh_calibration_and_a_living_companion(tmp_path: Path) -> None:
    instance = free_instance()
    parameters = {"COM_ARM_AUTH_REQ": 1, "COM_ARM_AUTH_ID": instance + 1, "MAV_1_FORWARD": 1}
    path = binary("px4-sitl")
    vehicle = Px4Sitl(path, world(), tmp_path / "px4", parameters=parameters, instance=instance)
    async with flying(vehicle) as ground:
        await vehicle.sleep(40.0)
        assert "No response" in (await arm(ground, vehicle))[1]
        async with companion_daemon(vehicle, tmp_path / "daemon", more=GATE) as daemon:
            await until_arming(daemon, lambda arming: "hold still" in arming["words"])
            armed, words = await arm(ground, vehicle)
            assert not armed
            assert "Temporarily rejected" in words
            assert "Not armed: hold still" in words
            await until_ready(daemon)
            assert "Authorized for the next 10 seconds" in await until_it_arms(ground, vehicle)
            await vehicle.sleep(11.0)  # what was granted runs out, by its clock
            vehicle.move([Handling(start_s=vehicle.now_s + 0.2, duration_s=12.0, seed=3)])
            await asyncio.sleep(4.0)
            armed, words = await arm(ground, vehicle)
            assert not armed
            assert "Not armed: hold still" in words
            await asyncio.sleep(10.0)
            await until_ready(daemon)
            daemon.kill()
            for force in (0.0, FORCE):
                armed, words = await arm(ground, vehicle, force)
                assert not armed
                assert "No response" in words


async def test_ardupilots_script_lets_it_arm_only_with_a_fresh_calibration_and_a_living_companion(
    tmp_path: Path,
) -> None:
    path = binary("ardupilot-sitl")
    vehicle = ArduPilotSitl(path, world(), tmp_path / "ap")
    (tmp_path / "ap" / "scripts").mkdir(parents=True)
    (tmp_path / "ap" / "scripts" / ARMING_SCRIPT.name).write_bytes(ARMING_SCRIPT.read_bytes())
    async with flying(vehicle) as ground:
        await asyncio.sleep(40.0)
        assert SILENT in (await arm(ground, vehicle))[1]
        async with companion_daemon(vehicle, tmp_path / "daemon", more=GATE) as daemon:
            await seconds_until_said(ground, vehicle, "Companion: hold still")
            assert not (await arm(ground, vehicle))[0]
            await until_ready(daemon)
            assert "Arming motors" in await until_it_arms(ground, vehicle)
            vehicle.move([Handling(start_s=vehicle.now_s + 0.2, duration_s=12.0, seed=3)])
            # Heard by the companion within a second or two; on a busy machine later.
            await seconds_until_said(ground, vehicle, "Companion: hold still", 8.0)
            assert not (await arm(ground, vehicle))[0]
            await asyncio.sleep(10.0)
            await until_ready(daemon)
            await until_it_arms(ground, vehicle)
            daemon.kill()
            # Its last word is half a second old at most, the script looks every 0.2 s, we every 0.3 s.
            assert 2.4 < await seconds_until_said(ground, vehicle, SILENT) < 4.0
            armed, words = await arm(ground, vehicle)
            assert not armed
            assert SILENT in words
            assert (await arm(ground, vehicle, FORCE))[0]  # a forced arming passes by: documented
