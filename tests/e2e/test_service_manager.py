"""The daemon as a service: a real process, its signals, and what the service manager hears of it."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import signal
from collections.abc import AsyncIterator, Sequence
from pathlib import Path

import pytest

from sim.ardupilot.parameters import offset_names
from sim.companion_process import CompanionProcess
from sim.scenario import Scenario
from tests.support.live_aircraft import QUICK, live_aircraft
from tests.support.notify_socket import NotifySocket

pytestmark = pytest.mark.real_clock

WATCHDOG_S = 2.0
# One task waits for ever; the limits are short so that the test is.
HANGING = """
import asyncio, sys
from companion.daemon.process import service
from companion.daemon.process.service import main
from companion.component.component import MavlinkComponent
from companion.links.serial import bytestream

service.ESTIMATOR_S = service.COMPONENT_S = 3.0
bytestream.BEAT_WITHIN_S, service.MARGIN_S = 3.0, 0.0

async def for_ever(*_):
    await asyncio.Event().wait()

{patch}
sys.exit(main(sys.argv[2]))  # -c FILE run
"""

NOTHING_THERE = """
[mavlink]
url = "udpout:127.0.0.1:9"
[[imu]]
name = "fc"
source = "autopilot"
[gradienter]
port = "tcp://127.0.0.1:9"
protocol = "inclinometer_xy"
law = "axis"
[compass]
port = "/nowhere/compass"
protocol = "hmr3300"
[control]
socket = "{folder}/control.sock"
[storage]
directory = "{folder}/state"
"""


@contextlib.asynccontextmanager
async def service(
    folder: Path, *, entry: Sequence[str] = ("-m", "companion"), more: str = QUICK
) -> AsyncIterator[tuple[Scenario, CompanionProcess, NotifySocket]]:
    async with live_aircraft(folder, more) as scenario:
        with NotifySocket(folder / "notify") as manager:
            environment = manager.environment(WATCHDOG_S)
            async with CompanionProcess(folder, environment=environment, entry=entry) as daemon:
                await manager.until("READY")
                yield scenario, daemon, manager


async def test_ready_status_watchdog_and_stop(tmp_path: Path) -> None:
    async with service(tmp_path) as (_, daemon, manager):
        # Ready means that it can be talked to, and not a moment earlier.
        assert await daemon.status() is not None
        await manager.until("STATUS", "ArduPilot")
        await manager.until("STATUS", "gradienter, compass good")
        assert "disarmed" in manager.status
        assert manager.status.startswith(("WAIT", "HOLD STILL", "NOT"))
        await manager.until("WATCHDOG", count=5)
        fed = manager.times("WATCHDOG")
        assert max(after - before for before, after in itertools.pairwise(fed)) < WATCHDOG_S
        daemon.signal(signal.SIGTERM)
        assert await daemon.ended(10.0) == 0
        assert manager.times("STOPPING")
        assert len(manager.times("READY")) == 1
        assert not (tmp_path / "control.sock").exists()


async def test_a_task_that_hangs_starves_the_watchdog_and_is_named(tmp_path: Path) -> None:
    name = "MAVLink component"
    entry = ("-c", HANGING.replace("{patch}", "MavlinkComponent.run = for_ever"))
    async with service(tmp_path, entry=entry) as (_, daemon, manager):
        await manager.until("STATUS", f"HUNG: {name}")
        starved_s = asyncio.get_running_loop().time()
        statuses = len(manager.messages)
        await asyncio.sleep(1.5 * WATCHDOG_S)
        # The loop turns and the status goes on, but nobody feeds the watchdog any more.
        assert max(manager.times("WATCHDOG")) < starved_s
        assert len(manager.messages) >= statuses
        (line,) = [line for line in daemon.log().splitlines() if "watchdog:" in line]
        assert f"watchdog: {name} did not run for" in line
        assert "waits in" in line


async def test_where_the_whole_process_stands_still_is_in_the_log(tmp_path: Path) -> None:
    """The loop itself is blocked, nobody is fed, and the manager's SIGABRT finds out where."""
    patch = "import time\ndef block(*_):\n    time.sleep(1000)\nMavlinkComponent._step = block"
    async with service(tmp_path, entry=("-c", HANGING.replace("{patch}", patch))) as (_, daemon, manager):
        await asyncio.sleep(WATCHDOG_S)
        assert len(manager.times("WATCHDOG")) <= 1
        daemon.signal(signal.SIGABRT)
        assert await daemon.ended(10.0) == -signal.SIGABRT
        assert "Fatal Python error: Aborted" in daemon.log()
        assert ", line " in daemon.log()
        assert " in block" in daemon.log()


async def test_ports_and_autopilots_that_are_not_there_are_no_reason_to_restart(tmp_path: Path) -> None:
    """Waiting for a device keeps the watchdog alive; only an endless wait counts as hung."""
    entry = ("-c", HANGING.replace("{patch}", ""))
    (tmp_path / "companion.toml").write_text(NOTHING_THERE.format(folder=tmp_path))
    with NotifySocket(tmp_path / "notify") as manager:
        environment = manager.environment(WATCHDOG_S)
        async with CompanionProcess(tmp_path, environment=environment, entry=entry) as daemon:
            await manager.until("READY")
            await manager.until("WATCHDOG", count=20)
            fed = manager.times("WATCHDOG")
            assert max(after - before for before, after in itertools.pairwise(fed)) < WATCHDOG_S
            assert "watchdog:" not in daemon.log()
            assert "compass: " in manager.status


def offsets(scenario: Scenario) -> dict[str, float]:
    return {
        name: scenario.autopilot.parameter(name)
        for instance in (1, 2)
        for kind in ("gyro", "accel")
        for name in offset_names(instance, kind)
    }


async def calibrate(daemon: CompanionProcess) -> None:
    """Start a calibration and leave it alone."""
    await daemon.ready()
    asking = await asyncio.create_subprocess_exec(
        *daemon.command("calibrate", "--no-wait"), stdout=asyncio.subprocess.DEVNULL
    )
    assert await asking.wait() == 0


async def test_sigterm_in_a_write_leaves_the_old_values(tmp_path: Path) -> None:
    async with service(tmp_path) as (scenario, daemon, manager):
        before = offsets(scenario)
        await calibrate(daemon)
        async with asyncio.timeout(60.0):
            while offsets(scenario) == before:  # the double has no event for a write
                await asyncio.sleep(0.02)
        daemon.signal(signal.SIGTERM)
        await manager.until("STOPPING")
        daemon.signal(signal.SIGTERM)  # an impatient second one cuts nothing off
        assert await daemon.ended(30.0) == 0
        assert offsets(scenario) == before
        assert "Calibration cancelled" in daemon.log()
        assert "already stopping" in daemon.log()
        # Nothing is left for the next start to put in order.
        async with CompanionProcess(tmp_path) as again:
            await again.ready()
            status = await again.status()
            assert status is not None
            assert not status["putting_back"]
            assert status["fault"] is None
            assert status["last"]["state"] == "cancelled"
