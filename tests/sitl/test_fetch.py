"""`companion flight --fetch` from real firmware: the file is the one in its folder, whatever happened on the way."""

from __future__ import annotations

import asyncio
import json
import os
from asyncio.subprocess import PIPE
from pathlib import Path

import pytest

from sim.sitl.ardupilot import ArduPilotSitl
from sim.sitl.daemon import companion_daemon
from sim.sitl.lossy_link import LossyLink
from sim.sitl.px4 import UDP_COMPANION, Px4Sitl, free_instance
from sim.sitl.residuals import ground_station
from sim.sitl.vehicle import SitlVehicle
from tests.sitl.craft import BINARIES, missing, world

pytestmark = pytest.mark.sitl
ARMED_S = {"ardupilot-sitl": 30.0, "px4-sitl": 3.0}
"""Makes 1.6 MB, and, where everything is logged at a simulator's rates, 2 MB."""
SETTLE_S = 25.0
LEAST_BYTES = 500_000
QUIET = '\n[calibration]\nat_arm = "off"\n'


def vehicle_of(kind: str, folder: Path) -> tuple[SitlVehicle, LossyLink]:
    binary = Path(os.environ[BINARIES[kind]])
    if kind == "px4-sitl":
        instance = free_instance()
        link = LossyLink(near_port=UDP_COMPANION + instance)
        return Px4Sitl(binary, world(), folder, parameters={"SDLOG_MODE": 0}, instance=instance), link
    link = LossyLink()
    return ArduPilotSitl(binary, world(), folder, companion=link.near), link


async def until_percent(words: asyncio.StreamReader, least: int) -> None:
    async with asyncio.timeout(120.0):
        while int((await words.readuntil(b" %")).split()[-2]) < least:
            pass


@pytest.mark.parametrize("kind", ["ardupilot-sitl", "px4-sitl"])
def test_the_log_is_the_firmwares_own_after_a_cable_out_and_a_kill(tmp_path: Path, kind: str) -> None:
    reason = missing(kind)
    if reason is not None:
        pytest.skip(reason)

    async def main() -> None:
        vehicle, link = vehicle_of(kind, tmp_path / "firmware")
        async with link, vehicle, ground_station(vehicle) as ground:
            await ground.wait_for(lambda: len(ground.vehicle_heartbeats()) > 1, 60.0, "a heartbeat")
            await vehicle.sleep(SETTLE_S)
            await ground.arm(force=True)
            await vehicle.sleep(ARMED_S[kind])
            await ground.arm(arm=False, force=True)
            await vehicle.sleep(5.0)
            logs = [path for path in (tmp_path / "firmware").rglob("*") if path.suffix in (".BIN", ".ulg")]
            latest = max(logs, key=lambda path: path.stat().st_mtime)
            folder = tmp_path / "daemon"
            folder.mkdir()
            async with companion_daemon(vehicle, folder, more=QUIET, url=link.url) as daemon:
                first = await asyncio.create_subprocess_exec(
                    *daemon.command("flight", "--fetch"), stdout=PIPE, stderr=PIPE
                )
                assert first.stderr is not None
                await until_percent(first.stderr, 20)
                link.loss = 1.0
                await asyncio.sleep(12.0)
                link.loss = 0.02
                await until_percent(first.stderr, 50)
                daemon.kill()
                await first.communicate()
                assert first.returncode == 3
            link.loss = 0.0
            (half,) = (folder / "state" / "logs").iterdir()
            there = half.read_bytes()
            assert half.suffix == ".part"
            assert latest.read_bytes().startswith(there)
            async with companion_daemon(vehicle, folder, more=QUIET, url=link.url) as daemon:
                began_s = asyncio.get_running_loop().time()
                second = await asyncio.create_subprocess_exec(
                    *daemon.command("flight", "--fetch", "--json"), stdout=PIPE, stderr=PIPE
                )
                out, said = await second.communicate()
                took_s = asyncio.get_running_loop().time() - began_s
            answer = json.loads(out)
            print(answer["reason"], said.decode()[-200:])
            (whole,) = (folder / "state" / "logs").iterdir()
            fetched = whole.read_bytes()
            print(f"{len(there)} of {len(fetched)} bytes before, the rest in {took_s:.0f} s")
            assert len(fetched) > LEAST_BYTES
            # ArduPilot goes on with it, as nothing has ended it.
            assert latest.read_bytes().startswith(fetched)
            assert [path for path in latest.parent.iterdir() if path.suffix == latest.suffix] == [latest]

    asyncio.run(main())
