"""Real child processes beside a calibration: it ends well whatever happens to one, and the child returns."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Final, Self

import pytest

from companion.daemon.interfaces.child import Child
from companion.daemon.interfaces.control import ControlServer
from companion.daemon.job import Job
from companion.estimation.machine import State, What
from sim.motions import Handling
from tests.support.broker import broker, peer
from tests.support.mqtt_daemon import is_
from tests.support.rig import Rig

pytestmark = pytest.mark.real_clock

CONNACK: Final = bytes([0x20, 3, 0, 0, 0])
HUGE: Final = bytes([0x30, 0xFF, 0xFF, 0xFF, 0x7F]) + b"\0\1a"
"""Head of a PUBLISH of 256 MB: MQTT 5, 2.1.4."""
SMALL: Final = bytes([0x30, 8, 0, 4]) + b"flood"[:4] + b"\0x"
CHUNK: Final = bytes(1 << 16)


class HostileBroker:
    """Listens as a broker does, and behaves as `manner` says: "huge", "flood", "silent" or "closing"."""

    def __init__(self) -> None:
        self.manner = "silent"
        self.connections = 0
        self._server: asyncio.Server

    async def __aenter__(self) -> Self:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", 0)
        return self

    async def __aexit__(self, *_: object) -> None:
        self._server.close()

    @property
    def port(self) -> int:
        return int(self._server.sockets[0].getsockname()[1])

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        with contextlib.suppress(OSError):
            if self.manner == "silent":
                await reader.read()
            elif self.manner != "closing":
                await reader.read(1000)
                writer.write(CONNACK)
                head, body = (HUGE, CHUNK) if self.manner == "huge" else (b"", SMALL * 1000)
                writer.write(head)
                while True:
                    writer.write(body)
                    await writer.drain()
        writer.close()


@contextlib.asynccontextmanager
async def beside(rig: Rig) -> AsyncIterator[Child]:
    """The rig with its child, MQTT's or the page's, as a real process, which asks by the control socket."""
    rig.start_child, rig.offload = Child, asyncio.to_thread
    async with rig.running(), ControlServer(rig.config.control.path, rig.service.faces.answer):
        await rig.ready()
        child = rig.service.faces.mqtt or rig.service.faces.page
        assert child is not None
        yield child


async def calibrated(rig: Rig, during: State | None = None, fault: Callable[[], None] = lambda: None) -> str:
    """Calibrate, with a fault when the calibration is in a state; return how it ended."""
    manager = rig.service.calibrating.manager
    if during is not None:
        # However long it has stood still before, on a busy machine: from here on it has to wait, and to measure.
        rig.aircraft.add(Handling(start_s=rig.aircraft.time_at(rig.now_s), duration_s=1.0, seed=1))
        await asyncio.sleep(0.5)
    job = manager.start_calibration(What.BOTH, "test")
    assert isinstance(job, Job)
    async with asyncio.timeout(120.0):
        while during is not None and manager.state is not during:
            assert not job.finished.done(), f"never {during}"
            await asyncio.sleep(0.002)
        fault()
        return (await job.finished).outcome


def rig_of(folder: Path, section: str) -> Rig:
    return Rig(folder, min_still_s=2.0, max_s=8.0, more=f'[control]\nsocket = "{folder}/c.sock"\n{section}')


async def test_a_hostile_broker_costs_at_most_the_mqtt_process(tmp_path: Path) -> None:
    async with HostileBroker() as hostile:
        section = f'[mqtt]\nhost = "127.0.0.1"\nport = {hostile.port}\n'
        async with beside(rig := rig_of(tmp_path, section)) as child:
            for manner in ("huge", "flood", "silent", "closing"):
                hostile.manner, before = manner, hostile.connections
                assert await calibrated(rig) == "done"
                async with asyncio.timeout(120.0):
                    while hostile.connections == before:
                        await asyncio.sleep(0.05)
                assert _rss_mib() < 400.0, "the message is held in the child, not here"
            async with asyncio.timeout(120.0):
                while child.process_id is None:
                    await asyncio.sleep(0.05)


def _rss_mib() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGESIZE") / 1024**2


@pytest.mark.parametrize(("state", "blow"), [(State.WRITING, signal.SIGSTOP), (State.VERIFYING, signal.SIGKILL)])
async def test_a_child_that_is_killed_or_stopped_returns(tmp_path: Path, state: State, blow: signal.Signals) -> None:
    async with broker(tmp_path) as one, peer(one) as watcher:
        async with beside(rig := rig_of(tmp_path, one.section())) as child:
            await watcher.until("companion/1/status", is_(b"online"))
            struck = child.process_id
            assert struck is not None
            assert await calibrated(rig, state, lambda: os.kill(struck, blow)) == "done"
            async with asyncio.timeout(60.0):
                while child.process_id in (None, struck):
                    await asyncio.sleep(0.05)
            done = await watcher.until("companion/1/calibration/state")
            assert done.json["state"] == "done"
        await watcher.until("companion/1/status", is_(b"offline"))
