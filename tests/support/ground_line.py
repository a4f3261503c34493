"""A virtual aircraft with the real daemon on board, and its telemetry radio's end on the ground."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
import sys
import time
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from companion.links.mavlink.signing import read_key, ticks_of
from sim.companion_process import CompanionProcess
from sim.devices import VectorNavBinary
from sim.motions import Motion
from sim.pty_device import PtyDevice
from sim.scenario import Firmware, Scenario, demo
from sim.serve import configuration
from sim.station import open_udp


class Said(NamedTuple):
    """Output of a command, and its exit code."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)


class GroundLine(NamedTuple):
    """`port` is the autopilot's second telemetry port: UDP on the loopback, answering whoever spoke last."""

    scenario: Scenario
    port: int
    daemon: CompanionProcess
    started: list[asyncio.subprocess.Process]
    """Every command, so that none outlives a test."""

    async def ground(self, command: str, *words: str, chosen: bool = True, within_s: float = 150.0) -> Said:
        """`companion ground COMMAND --url ... WORDS`; `chosen`: with --system 1, so that it looks for no others."""
        return await finish(await self.start(command, *words, chosen=chosen), within_s)

    async def start(self, command: str, *words: str, chosen: bool = True) -> asyncio.subprocess.Process:
        system = ("--system", "1") if chosen else ()
        process = await ground(command, "--url", f"udpout:127.0.0.1:{self.port}", *system, *words)
        self.started.append(process)
        return process


async def ground(*words: str) -> asyncio.subprocess.Process:
    return await asyncio.create_subprocess_exec(
        sys.executable, "-m", "companion", "ground", *words,
        stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip


async def _end(started: list[asyncio.subprocess.Process]) -> None:
    """A test that fails leaves nothing running; and no pipes, of which a later test would be accused."""
    for process in started:
        if process.returncode is None:
            process.kill()
            await process.communicate()


async def finish(process: asyncio.subprocess.Process, within_s: float = 150.0) -> Said:
    async with asyncio.timeout(within_s):
        out, err = await process.communicate()
    assert process.returncode is not None
    return Said(process.returncode, out.decode(), err.decode())


@contextlib.asynccontextmanager
async def ground_line(
    folder: Path,
    firmware: Firmware,
    *,
    motions: Sequence[Motion] = (),
    daemon: bool = True,
    signing_key: Path | None = None,
) -> AsyncIterator[GroundLine]:
    """Devices on ptys, the autopilot double with two UDP ports, and the daemon as a process; calibrates on request.

    With a key file autopilot and daemon sign, and take nothing else.
    """
    # Noise of a step and more: PX4's integers tell the mean also from the few seconds that come of a busy machine.
    made = demo(seed=25, firmware=firmware, motions=motions, part="bmi088")
    # An eighth of its usual rate, which costs processor time all the while.
    scenario = dataclasses.replace(made, imu=VectorNavBinary(made.serial_imu, rate_hz=25.0))
    async with contextlib.AsyncExitStack() as stack:
        scenario.aircraft.begin(asyncio.get_running_loop().time())
        for name, device in (("imu", scenario.imu), ("gradienter", scenario.gradienter), ("compass", scenario.compass)):
            await stack.enter_async_context(PtyDevice(device, folder / name))
        link = await open_udp(scenario.autopilot, listen=("127.0.0.1", 0))
        stack.callback(link.close)
        radio = await open_udp(scenario.autopilot.ground, listen=("127.0.0.1", 0))
        stack.callback(radio.close)
        autopilot = asyncio.create_task(scenario.autopilot.run())
        stack.callback(autopilot.cancel)
        text = configuration(scenario, directory=folder, udp=link.local).replace("udpin:", "udpout:")
        if signing_key is not None:
            text = text.replace("[mavlink]\n", f'[mavlink]\nsigning_key_file = "{signing_key}"\n', 1)
            scenario.autopilot.require_signatures(read_key(signing_key), ticks_of(time.time()))
        text += '[calibration]\nmin_still_s = 3\nmax_s = 4\nat_arm = "off"\n'
        (folder / "companion.toml").write_text(text)
        process = CompanionProcess(folder)
        if daemon:
            await stack.enter_async_context(process)
            await process.ready()
        started: list[asyncio.subprocess.Process] = []
        stack.push_async_callback(_end, started)
        yield GroundLine(scenario, radio.local[1], process, started)
