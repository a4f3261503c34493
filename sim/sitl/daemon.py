"""The real daemon on a real firmware: configuration, serial devices and process in one."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

from sim.companion_process import CompanionProcess
from sim.scenario import Scenario
from sim.serve import configuration, serve
from sim.sitl.vehicle import FirmwareVehicle, SitlVehicle

READY_WITHIN_S = 40.0
PORTS_WITHIN_S = 5.0
_IMU = '[[imu]]\nname = "fc{0}"\nsource = "autopilot"\ninstance = {0}\nprofile = "icm42688p"\n\n'


def daemon_configuration(vehicle: FirmwareVehicle, folder: Path, more: str = "", url: str | None = None) -> str:
    """A companion.toml for the vehicle's IMUs with the ports in the folder; `more` is added at the end."""
    host, port = vehicle.url.removeprefix("udpin:").rsplit(":", 1)
    text = configuration(vehicle.scenario, directory=folder, udp=(host, int(port)))
    text = text.replace(vehicle.url, url or vehicle.url)
    # The autopilot's IMUs only: the serial one has nothing to do with the firmware.
    head, _, tail = text.partition("[[imu]]")
    imus = "".join(_IMU.format(instance) for instance in vehicle.instances)
    return head + imus + tail[tail.index("[gradienter]") :] + more


@contextlib.asynccontextmanager
async def devices(scenario: Scenario, folder: Path) -> AsyncIterator[Path]:
    """`imu`, `gradienter` and `compass` of the aircraft as ports in a folder, which exists."""
    up = asyncio.Event()
    serving = asyncio.create_task(serve(scenario, directory=folder, started=up), name="devices")
    try:
        async with asyncio.timeout(PORTS_WITHIN_S):
            await up.wait()
        yield folder
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


@contextlib.asynccontextmanager
async def companion_daemon(
    vehicle: SitlVehicle, folder: Path, *, more: str = "", url: str | None = None
) -> AsyncIterator[CompanionProcess]:
    """`companion run` with the aircraft's devices on the vehicle's companion link, once it knows the vehicle.

    Args:
        vehicle: running; nobody else listens on its companion link.
        folder: for the ports, the configuration, the log and the companion's storage; exists.
        more: further lines of its configuration.
        url: of its link to the vehicle, where something lies between (None: the vehicle's own).
    """
    (folder / "companion.toml").write_text(daemon_configuration(vehicle, folder, more, url), encoding="utf-8")
    async with devices(vehicle.scenario, folder), CompanionProcess(folder) as daemon:
        await daemon.ready(READY_WITHIN_S)
        yield daemon
