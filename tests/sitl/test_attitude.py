"""Real firmware takes our heading: EKF3 with EK3_SRC1_YAW = 6, EKF2 with EV yaw, by what they say of themselves.

The compass of the companion is told to lie by 12 degrees, fewer than would be refused, and the autopilot's own does
not: a heading that follows the lie is ours and no other.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import os
import signal
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, Literal

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.lua import ARMING_SCRIPT
from sim.companion_process import CompanionProcess
from sim.motions import Turn
from sim.serve import configuration
from sim.sitl.daemon import READY_WITHIN_S, devices
from sim.sitl.ground import GroundStation
from sim.sitl.residuals import ground_station
from sim.sitl.vehicle import SitlVehicle
from tests.sitl.craft import BINARIES, binary_vehicle, missing

pytestmark = pytest.mark.sitl

LIE_DEG = 12.0
MORE = '\n[push]\nattitude = "full"\n[calibration]\nmin_still_s = 10\nmax_s = 15\nat_arm = "off"\n'
CALIBRATED_WITHIN_S = 180.0
FOLLOWS_DEG = 3.0
Kind = Literal["ardupilot-sitl", "px4-sitl"]


class AttitudeBench:
    """A binary, the daemon with the serial IMU and a compass that lies, and a ground station."""

    def __init__(self, vehicle: SitlVehicle, ground: GroundStation, daemon: CompanionProcess) -> None:
        self.vehicle, self.ground, self.daemon = vehicle, ground, daemon

    async def set_up(self, *, net: bool = True) -> dict[str, Any]:
        """Follow `companion autopilot params` from a ground station; without `net` no second set of sources."""
        shown = await self.ask("autopilot", "params")
        wanted = {row["parameter"]: row["wanted"] for row in shown["parameters"] if row["wanted"] is not None}
        await self.ground.put_all(
            {name: value for name, value in wanted.items() if net or name[:8] not in ("EK3_SRC2", "EK3_SRC3")}
        )
        shown = await self.ask("autopilot", "params")
        assert shown["state"] == ("applied" if net else "not applied"), shown
        return shown

    async def ask(self, *words: str) -> dict[str, Any]:
        """A command of the companion with --json."""
        process = await asyncio.create_subprocess_exec(
            *self.daemon.command(*words, "--json"), stdout=asyncio.subprocess.PIPE
        )
        output, _ = await process.communicate()
        answer: dict[str, Any] = json.loads(output)
        return answer

    async def attitude(self) -> dict[str, Any]:
        status = await self.ask("status")
        found: dict[str, Any] = status["attitude"]
        return found

    async def pushing(self, within_s: float = 60.0) -> None:
        async with asyncio.timeout(within_s):
            while not (await self.attitude())["pushing"]:
                await asyncio.sleep(1.0)

    async def stream(self, message_id: int, rate_hz: float) -> None:
        """A message of the autopilot for the ground station."""
        self.ground.send(
            mavlink.MAVLink_command_long_message(
                self.vehicle.system_id,
                1,
                mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
                0,
                message_id,
                1e6 / rate_hz,
                *[0.0] * 5,
            )
        )
        await asyncio.sleep(1.0)

    async def prearm_words(self) -> str:
        """Ask ArduPilot for its pre-arm checks; return the reasons."""
        since_s = asyncio.get_running_loop().time()
        self.ground.send(
            mavlink.MAVLink_command_long_message(
                self.vehicle.system_id, 1, mavlink.MAV_CMD_RUN_PREARM_CHECKS, 0, *[0.0] * 7
            )
        )
        await self.vehicle.sleep(3.0)
        return self.ground.texts_since(since_s)

    async def theirs_deg(self) -> float:
        """The autopilot's heading less the true one."""
        since_s = asyncio.get_running_loop().time()
        while True:
            message = await self.ground.wait_message(mavlink.MAVLink_attitude_message, 10.0, since_s=since_s)
            if message.get_srcComponent() == 1:
                break
            since_s = asyncio.get_running_loop().time()
        truth = self.vehicle.aircraft.angles_rad(self.vehicle.now_s)[2]
        return math.degrees(math.remainder(message.yaw - truth, 2.0 * math.pi))

    async def until_follows(self, wrong_deg: float, within_s: float) -> float:
        """Wait until the autopilot's heading is off by so much."""
        found = math.nan
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                while not abs(found - wrong_deg) < FOLLOWS_DEG:
                    await asyncio.sleep(0.5)
                    found = await self.theirs_deg()
        return found

    def turn(self, heading_deg: float) -> None:
        self.vehicle.move([Turn(start_s=self.vehicle.now_s + 0.5, duration_s=4.0, heading_deg=heading_deg)])


@contextlib.asynccontextmanager
async def bench(kind: Kind, folder: Path, **options: Any) -> AsyncIterator[AttitudeBench]:
    """Everything running, nothing calibrated."""
    reason = missing(kind)
    if reason is not None:
        pytest.skip(reason)
    vehicle = binary_vehicle(kind, folder / "firmware", **options)
    daemon_folder = folder / "daemon"
    daemon_folder.mkdir()
    host, port = vehicle.url.removeprefix("udpin:").rsplit(":", 1)
    text = configuration(vehicle.scenario, directory=daemon_folder, udp=(host, int(port)))
    text = text.replace('reference = "magnetic"', f'reference = "magnetic"\noffset_deg = {LIE_DEG}')
    (daemon_folder / "companion.toml").write_text(text + MORE, encoding="utf-8")
    async with vehicle, ground_station(vehicle) as ground:
        await ground.wait_for(lambda: bool(ground.vehicle_heartbeats()), 60.0, "a heartbeat")
        await vehicle.sleep(25.0)
        async with devices(vehicle.scenario, daemon_folder), CompanionProcess(daemon_folder) as daemon:
            await daemon.ready(READY_WITHIN_S)
            yield AttitudeBench(vehicle, ground, daemon)


async def test_ekf3_takes_the_heading(tmp_path: Path) -> None:
    async with bench("ardupilot-sitl", tmp_path) as on:
        loop = asyncio.get_running_loop()
        await on.set_up(net=False)
        assert (await on.ground.get("EK3_SRC1_YAW"), await on.ground.get("VISO_TYPE")) == (6.0, 1.0)
        await on.vehicle.sleep(3.0)
        booted_s = loop.time()
        await on.vehicle.power_cycle()
        await on.vehicle.sleep(20.0)
        await on.stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, 10.0)
        await on.stream(mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT, 5.0)
        report = await on.ground.wait_message(mavlink.MAVLink_ekf_status_report_message, 5.0)
        assert not report.flags & mavlink.EKF_POS_HORIZ_ABS  # no heading, no GNSS
        assert "yaw aligned" not in on.ground.texts_since(booted_s)
        record = await on.daemon.calibrate(CALIBRATED_WITHIN_S)
        assert record["state"] == "done", record["reason"]
        await on.pushing()
        found = await on.until_follows(LIE_DEG, 20.0)
        print(f"EKF3's heading less the true one: {found:.2f} deg, ours {LIE_DEG} by its compass")
        assert abs(found - LIE_DEG) < FOLLOWS_DEG
        assert "EKF3 IMU0 yaw aligned" in on.ground.texts_since(booted_s)
        since_s = loop.time()
        await on.ground.wait_for(
            lambda: any(
                one.flags & mavlink.EKF_POS_HORIZ_ABS
                for one in on.ground.all(mavlink.MAVLink_ekf_status_report_message, since_s=since_s)
            ),
            60.0,
            "GNSS in use, now that there is a heading",
        )
        on.turn(100.0)
        await on.vehicle.sleep(8.0)
        found = await on.theirs_deg()
        print(f"after a turn by 100 deg: {found:.2f} deg; {await on.attitude()}")
        assert abs(found - LIE_DEG) < FOLLOWS_DEG
        # Without the stream it does not arm; with it again, after an alignment, nothing objects to it.
        on.daemon.signal(signal.SIGSTOP)
        await on.vehicle.sleep(2.0)
        assert "VisOdom: not healthy" in await on.prearm_words()
        on.daemon.signal(signal.SIGCONT)
        await on.pushing()
        await on.vehicle.sleep(2.0)
        assert "VisOdom" not in await on.prearm_words()


@pytest.mark.parametrize("script", [True, False], ids=["script", "command"])
async def test_ekf3_goes_back_to_its_compass_when_our_heading_ends(tmp_path: Path, script: bool) -> None:
    """The script does it within a second, even after kill -9; without a script the companion asks for it."""
    if script:
        scripts = tmp_path / "firmware" / "scripts"
        scripts.mkdir(parents=True)
        (scripts / ARMING_SCRIPT.name).write_bytes(ARMING_SCRIPT.read_bytes())
    async with bench("ardupilot-sitl", tmp_path, parameters={"CMPG_ENABLE": 0} if script else {}) as on:
        shown = await on.set_up()
        print(shown["net"])
        await on.vehicle.sleep(3.0)
        await on.vehicle.power_cycle()
        await on.vehicle.sleep(35.0)
        assert (await on.ask("autopilot", "params"))["net"]["kind"] == ("script" if script else "command")
        await on.stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, 10.0)
        await on.until_follows(0.0, 30.0)  # its compass, as long as there is no other
        record = await on.daemon.calibrate(CALIBRATED_WITHIN_S)
        assert record["state"] == "done", record["reason"]
        await on.pushing()
        found = await on.until_follows(LIE_DEG, 40.0)
        print(f"EKF3's heading less the true one: {found:.2f} deg, ours {LIE_DEG} by its compass")
        assert abs(found - LIE_DEG) < FOLLOWS_DEG
        await on.vehicle.sleep(3.0)
        begun_s, physics_s = asyncio.get_running_loop().time(), on.vehicle.physics_s
        on.daemon.signal(signal.SIGKILL if script else signal.SIGTERM)
        found = await on.until_follows(0.0, 30.0)
        print(f"{found:.2f} deg, {on.vehicle.physics_s - physics_s:.1f} s after the end")
        assert abs(found) < FOLLOWS_DEG
        if script:
            assert "Heading: compass, none from companion" in on.ground.texts_since(begun_s)


async def ev_yaw(vehicle: SitlVehicle) -> bool:
    """cs_ev_yaw of EKF2's own status, asked for on its console."""
    listener = Path(os.environ[BINARIES["px4-sitl"]]).with_name("px4-listener")
    instance = str(getattr(vehicle, "instance"))  # noqa: B009 - only PX4 has one
    process = await asyncio.create_subprocess_exec(
        str(listener), "--instance", instance, "estimator_status_flags", "-n", "1",
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.DEVNULL,
    )  # fmt: skip
    output, _ = await process.communicate()
    lines = [line for line in output.decode().splitlines() if "cs_ev_yaw:" in line]
    assert lines, output.decode()
    return "True" in lines[0]


async def test_ekf2_takes_the_heading(tmp_path: Path) -> None:
    async with bench("px4-sitl", tmp_path) as on:
        await on.set_up()
        assert await on.ground.get("EKF2_EV_CTRL") == 8.0
        await on.vehicle.sleep(4.0)
        await on.vehicle.power_cycle()
        await on.vehicle.sleep(20.0)
        await on.stream(mavlink.MAVLINK_MSG_ID_ATTITUDE, 10.0)
        assert abs(await on.theirs_deg()) < 10.0  # its own magnetometer's
        assert not await ev_yaw(on.vehicle)
        record = await on.daemon.calibrate(CALIBRATED_WITHIN_S)
        assert record["state"] == "done", record["reason"]
        await on.pushing()
        found = await on.until_follows(LIE_DEG, 30.0)
        attitude = await on.attitude()
        print(f"EKF2's heading less the true one: {found:.2f} deg, ours {LIE_DEG} by its compass; {attitude}")
        assert abs(found - LIE_DEG) < FOLLOWS_DEG
        assert await ev_yaw(on.vehicle)
        assert attitude["timesync_answers"] > 100
        on.turn(100.0)
        await on.vehicle.sleep(8.0)
        found = await on.theirs_deg()
        print(f"after a turn by 100 deg: {found:.2f} deg; {await on.attitude()}")
        assert abs(found - LIE_DEG) < FOLLOWS_DEG
        on.daemon.signal(signal.SIGTERM)
        await on.daemon.ended(20.0)
        await on.vehicle.sleep(1.5)
        assert not await ev_yaw(on.vehicle)  # it stops after 0.4 s without
