"""`companion flight --fetch` from real firmware: the file is the one in its folder, whatever happened on the way."""

from __future__ import annotations

import asyncio
import os
import time
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
ARMED_S = 30.0
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
            await vehicle.sleep(30.0)
            await ground.arm(force=True)
            await vehicle.sleep(ARMED_S)
            await ground.arm(arm=False, force=True)
            await vehicle.sleep(5.0)
            files = [path for path in (tmp_path / "firmware").rglob("*") if path.suffix in (".BIN", ".ulg")]
            latest = max(files, key=lambda path: path.stat().st_mtime)
            print(latest, latest.stat().st_size)
            folder = tmp_path / "daemon"
            folder.mkdir()
            async with companion_daemon(vehicle, folder, more=QUIET, url=link.url) as daemon:
                fetching = await asyncio.create_subprocess_exec(
                    *daemon.command("flight", "--fetch", "--json"), stdout=-1, stderr=-1
                )
                assert fetching.stderr is not None
                began_s = time.monotonic()
                await until_percent(fetching.stderr, 20)
                link.loss = 1.0
                await asyncio.sleep(12.0)
                link.loss = 0.05
                await until_percent(fetching.stderr, 50)
                daemon.kill()
                _, said = await fetching.communicate()
                assert fetching.returncode == 3, said
                print("killed after", time.monotonic() - began_s)
            async with companion_daemon(vehicle, folder, more=QUIET, url=link.url) as daemon:
                link.loss = 0.0
                began_s = time.monotonic()
                fetching = await asyncio.create_subprocess_exec(
                    *daemon.command("flight", "--fetch", "--json"), stdout=-1, stderr=-1
                )
                out, err = await fetching.communicate()
                print("fetched after", time.monotonic() - began_s, out[:300], err[-1500:])
                fetched = next((folder / "state" / "logs").iterdir(), None) if (folder / "state").exists() else None
                print(fetched, list(folder.rglob("*.BIN")), list(folder.rglob("*.ulg")), list(folder.rglob("*.part")))
                (fetched,) = [path for path in folder.rglob("*") if path.parent.name == "logs"]
                whole = fetched.read_bytes()
                assert len(whole) > 300_000
                assert latest.read_bytes()[: len(whole)] == whole
                print(len(whole), latest.stat().st_size, sorted(p.name for p in latest.parent.iterdir()))

    asyncio.run(main())
