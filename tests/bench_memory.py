"""Memory of the daemon with everything on, after its start and after a calibration.

A process of its own on a live virtual aircraft (devices on pseudo-terminals, the autopilot on UDP), with a real broker,
a phone at the page, and recording on. Beside it the obvious script with the same devices' libraries. The figures
are the kernel's: RSS is all that is resident, PSS the share of it where other processes use the same pages (libraries).
USS is the memory that the end of the process would free.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import subprocess
import sys
import tempfile
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple

from companion.errors import DaemonUnreachableError
from companion.links.system.connection import ask
from tests.bench_arming import running
from tests.support.broker import Broker
from tests.support.installed import install
from tests.support.live_aircraft import live_aircraft

LIMIT_MIB: Final = 60.0
SETTLED_S: Final = 3.0
PERIOD_S: Final = 15.0
WITHIN_S: Final = 180.0

EVERYTHING: Final = """
recordings_mb = 64
[calibration]
min_still_s = 5
max_s = 8
at_arm = "gate"
[web]
bind = "127.0.0.1:0"
[fleet]
"""
CHILDREN: Final = {"page": "companion.web", "MQTT": "companion.mqtt"}
PEERS: Final = {
    "floor: asyncio, msgspec, numpy and dialect": """
import asyncio, msgspec, numpy
from pymavlink.dialects.v20 import ardupilotmega
""",
    "peer: mavutil": """
from pymavlink import mavutil
link = mavutil.mavlink_connection("udpout:127.0.0.1:9", source_system=1, source_component=191)
link.mav.heartbeat_send(18, 8, 0, 0, 4)
""",
    "peer: mavutil, pyserial, numpy and paho": """
import threading, serial, numpy, paho.mqtt.client as mqtt
from pymavlink import mavutil
link = mavutil.mavlink_connection("udpout:127.0.0.1:9", source_system=1, source_component=191)
link.mav.heartbeat_send(18, 8, 0, 0, 4)
client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
""",
    "peer: the same with mcap and a page by http.server": """
import threading, serial, numpy, http.server, mcap.writer, paho.mqtt.client as mqtt
from pymavlink import mavutil
link = mavutil.mavlink_connection("udpout:127.0.0.1:9", source_system=1, source_component=191)
link.mav.heartbeat_send(18, 8, 0, 0, 4)
client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
page = http.server.ThreadingHTTPServer(("127.0.0.1", 0), http.server.BaseHTTPRequestHandler)
""",
}
"""Idle; none of them has read a byte yet."""


class Memory(NamedTuple):
    resident: float
    shared_out: float
    own: float
    most: float

    def __str__(self) -> str:
        return f"{self.resident:6.1f} {self.shared_out:6.1f} {self.own:6.1f} {self.most:6.1f}"


def memory(process_id: int) -> Memory:
    """Memory of one process now: RSS, PSS, USS, and peak RSS."""
    kib = _kib(Path(f"/proc/{process_id}/smaps_rollup").read_text())
    own = kib["Private_Clean"] + kib["Private_Dirty"]
    most = _kib(Path(f"/proc/{process_id}/status").read_text())["VmHWM"]
    return Memory(*(value / 1024.0 for value in (kib["Rss"], kib["Pss"], own, most)))


def child_of(process_id: int, module: str) -> int:
    """The process of `python -m MODULE` that this one has started."""
    for child in Path(f"/proc/{process_id}/task/{process_id}/children").read_text().split():
        if module in Path(f"/proc/{child}/cmdline").read_text().split("\0"):
            return int(child)
    raise LookupError(module)


def _kib(text: str) -> Mapping[str, int]:
    rows = (line.split() for line in text.splitlines() if line.endswith(" kB"))
    return {row[0].rstrip(":"): int(row[1]) for row in rows}


@contextlib.asynccontextmanager
async def daemon(folder: Path) -> AsyncIterator[tuple[int, Path]]:
    """The companion as installed, with the folder's configuration: its process id, and its control socket."""
    command = [sys.executable, "-m", "companion", "-c", str(folder / "companion.toml"), "run"]
    environment = install(folder / "warm")
    with (folder / "daemon.log").open("w") as log, running(command, env=environment, stderr=log) as process:
        yield process.pid, folder / "control.sock"


async def last_reply(control: Path, request: dict[str, Any]) -> dict[str, Any]:
    """The end of what the daemon answers on its control socket.

    Raises:
        RuntimeError: an error.
    """
    async for reply in ask(control, request):
        last = reply
    if last["kind"] == "error":
        raise RuntimeError(last["reason"])
    return last


async def status_when(control: Path, good: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """The first status that is good.

    Raises:
        TimeoutError: none came.
    """
    async with asyncio.timeout(WITHIN_S):
        while True:
            with contextlib.suppress(DaemonUnreachableError):
                status: dict[str, Any] = (await last_reply(control, {"command": "status"}))["status"]
                if good(status):
                    return status
            await asyncio.sleep(0.2)


@contextlib.asynccontextmanager
async def visited(port: int) -> AsyncIterator[None]:
    """Visit the page: the page once, and its event stream throughout."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: close\r\n\r\n".encode())
    page = await reader.read()
    assert page.startswith(b"HTTP/1.1 200"), page[:200]
    writer.close()
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(f"GET /events HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
    assert (await reader.readline()).startswith(b"HTTP/1.1 200")

    async def read() -> None:
        while await reader.read(65536):
            pass

    reading = asyncio.create_task(read())
    try:
        yield
    finally:
        reading.cancel()
        await asyncio.gather(reading, return_exceptions=True)
        writer.close()


async def of_companion(folder: Path, calibrations: int) -> dict[str, Memory]:
    """Measure the companion with everything on: started, and after each calibration, one a quarter of a minute."""
    found: dict[str, Memory] = {}
    broker = await Broker(folder).start()
    try:
        everything = EVERYTHING + broker.section()
        async with live_aircraft(folder, everything), daemon(folder) as (process_id, control):
            heard = await status_when(
                control, lambda now: bool(now["vehicle"]["armed"] == "disarmed" and now["page"]["url"])
            )
            async with visited(int(heard["page"]["url"].rstrip("/").rpartition(":")[2])):
                await asyncio.sleep(SETTLED_S)
                of = {"companion": process_id} | {
                    f"{name}'s process": child_of(process_id, module) for name, module in CHILDREN.items()
                }
                found |= {f"{name}, everything on, started": memory(one) for name, one in of.items()}
                await status_when(control, lambda now: bool(now["arming"]["verdict"] == "accept"))
                for number in range(1, calibrations + 1):
                    next_s = asyncio.get_running_loop().time() + PERIOD_S
                    record = (await last_reply(control, {"command": "calibrate", "wait": True}))["record"]
                    assert record["state"] == "done", record["reason"]
                    await asyncio.sleep(SETTLED_S)
                    found |= {f"{name}, calibrations: {number}": memory(one) for name, one in of.items()}
                    if number < calibrations:
                        await asyncio.sleep(max(0.0, next_s - asyncio.get_running_loop().time()))
                after = await status_when(control, lambda now: bool(now["mqtt"]["connected"]))
                assert after["recording"]["ring"]["bytes"] > 0, after["recording"]
    finally:
        broker.kill()
    return found


def of_peers(environment: Mapping[str, str]) -> dict[str, Memory]:
    """Each idle, when all its libraries are there."""
    found = {}
    for words, code in PEERS.items():
        command = [sys.executable, "-c", f"{code}\nimport time; print('there', flush=True); time.sleep(60)"]
        with running(command, env=environment, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "there\n"
            found[words] = memory(process.pid)
    return found


def table(calibrations: int = 1) -> None:
    """Print what the companion keeps, beside its peers."""
    with tempfile.TemporaryDirectory() as text:
        ours = asyncio.run(of_companion(Path(text), calibrations))
    rows = {**of_peers(os.environ), **ours}
    print(f"\n{'memory (MiB)':52} {'RSS':>6} {'PSS':>6} {'USS':>6} {'most':>6}")
    for words, found in rows.items():
        print(f"{words:52} {found}")
    resident = max(found.resident for name, found in ours.items() if name.startswith("companion"))
    print(f"limit {LIMIT_MIB:g} MiB: RSS {resident:.1f} MiB, {'held' if resident <= LIMIT_MIB else 'NOT HELD'}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--calibrations", type=int, default=1, help="how many, one after the other")
    table(parser.parse_args().calibrations)
