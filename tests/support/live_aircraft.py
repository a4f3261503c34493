"""A virtual aircraft on a real clock: its devices on ptys, its autopilot on UDP, and a configuration that fits."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

from sim.pty_device import PtyDevice
from sim.scenario import Scenario, demo
from sim.serve import configuration
from sim.station import open_udp

QUICK = '\n[calibration]\nmin_still_s = 2\nmax_s = 4\nat_arm = "off"\n'
"""Short, and nothing happens that nobody asked for."""


@contextlib.asynccontextmanager
async def live_aircraft(folder: Path, more: str = QUICK, *, seed: int = 1) -> AsyncIterator[Scenario]:
    """Bring an aircraft to life and write `companion.toml` into the folder, with `more` at its end."""
    scenario = demo(seed=seed)
    scenario.aircraft.begin(asyncio.get_running_loop().time())
    async with contextlib.AsyncExitStack() as stack:
        for name, device in scenario.ports.items():
            await stack.enter_async_context(PtyDevice(device, folder / name))
        link = await open_udp(scenario.autopilot, listen=("127.0.0.1", 0))
        stack.callback(link.close)
        autopilot = asyncio.create_task(scenario.autopilot.run(), name="autopilot")
        stack.push_async_callback(_end, autopilot)
        text = configuration(scenario, directory=folder, udp=link.local).replace("udpin:", "udpout:") + more
        (folder / "companion.toml").write_text(text, encoding="utf-8")
        yield scenario


async def _end(task: asyncio.Task[None]) -> None:
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
