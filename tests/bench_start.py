"""`python -m tests.bench_start`: how fast the daemon is there, what it keeps in memory, and how soon its record is.

Cold start: from starting the process to its first HEARTBEAT in the kernel, on loopback UDP. One case has an autopilot's
IMU, a serial IMU, gradienter and compass on pseudo-terminals, the gate at arming, MQTT, page and recording. The other
has nothing but an autopilot's IMU. Beside it, round by round, so that a busy machine treats all alike:
Python and the libraries by themselves, and the obvious scripts that others would write.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests import bench_memory, bench_record
from tests.bench_arming import receive
from tests.support.first_heartbeat import modules_at_first_heartbeat
from tests.support.installed import install

HEARTBEAT_WITHIN_S: Final = 30.0
START_LIMIT_S: Final = 0.5

MINIMAL: Final = """
[mavlink]
url = "udpout:127.0.0.1:{port}"
[[imu]]
name = "fc"
source = "autopilot"
[control]
socket = "{folder}/control.sock"
[storage]
directory = "{folder}/state"
"""
FULL: Final = (
    MINIMAL
    + """
recordings_mb = 64
[[imu]]
name = "own"
source = "serial"
port = "{folder}/imu"
protocol = "vectornav"
[gradienter]
port = "{folder}/gradienter"
protocol = "inclinometer_xy"
law = "axis"
[compass]
port = "{folder}/compass"
protocol = "hmr3300"
[calibration]
at_arm = "gate"
[mqtt]
host = "127.0.0.1"
port = {broker}
[fleet]
[web]
bind = "127.0.0.1:0"
"""
)

MAVUTIL: Final = """
import time
from pymavlink import mavutil
link = mavutil.mavlink_connection("udpout:127.0.0.1:{port}", source_system=1, source_component=191)
link.mav.heartbeat_send(18, 8, 0, 0, 4)
time.sleep(60)
"""
OBVIOUS: Final = "import threading, serial, numpy, paho.mqtt.client" + MAVUTIL
MAVSDK: Final = """
import asyncio
from mavsdk import Configuration, ComponentType
from mavsdk.asyncio import Mavsdk
async def main():
    wanted = Configuration.create_with_component_type(ComponentType.COMPANION_COMPUTER)
    wanted.system_id, wanted.component_id = 1, 191
    async with Mavsdk(wanted) as sdk:
        await sdk.add_any_connection("udpout://127.0.0.1:{port}")
        await asyncio.sleep(60)
asyncio.run(main())
"""


class StartBench:
    """A folder with ports that say nothing, a broker that does not answer, and a socket that hears heartbeats."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._ports = []
        for name in ("imu", "gradienter", "compass"):
            ours, theirs = os.openpty()
            self._ports += [ours, theirs]
            (folder / name).symlink_to(os.ttyname(theirs))
        self._broker = socket.create_server(("127.0.0.1", 0))
        self.heard = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.heard.setsockopt(socket.SOL_SOCKET, 35, 1)  # SO_TIMESTAMPNS
        self.heard.bind(("127.0.0.1", 0))
        self.heard.settimeout(HEARTBEAT_WITHIN_S)
        self.port = int(self.heard.getsockname()[1])

    def config(self, text: str) -> Path:
        """The file of a configuration that fits."""
        path = self.folder / f"{'full' if 'mqtt' in text else 'minimal'}.toml"
        path.write_text(text.format(port=self.port, folder=self.folder, broker=self._broker.getsockname()[1]))
        return path

    def heartbeat(self, command: Sequence[str], environment: Mapping[str, str]) -> tuple[float, float]:
        """Seconds from starting a process to its first heartbeat, by the clock and of its processor time."""
        self._drain()
        parser = mavlink.MAVLink(None)
        parser.robust_parsing = True
        begun_s = time.time()
        with ended(subprocess.Popen(command, env=dict(environment), stderr=subprocess.DEVNULL)) as process:
            while True:
                data, stamp_s, _ = receive(self.heard)
                if any(message.get_type() == "HEARTBEAT" for message in parser.parse_buffer(data) or ()):
                    return stamp_s - begun_s, processor_s(process.pid)

    def _drain(self) -> None:
        self.heard.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                self.heard.recv(4096)
        self.heard.settimeout(HEARTBEAT_WITHIN_S)

    def close(self) -> None:
        for port in self._ports:
            os.close(port)
        self._broker.close()
        self.heard.close()


@contextlib.contextmanager
def ended(process: subprocess.Popen[bytes]) -> Iterator[subprocess.Popen[bytes]]:
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(10.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def processor_s(process_id: int) -> float:
    return 1e-9 * sum(int(task.read_text().split()[0]) for task in Path(f"/proc/{process_id}/task").glob("*/schedstat"))


class Start(NamedTuple):
    words: str
    command: list[str]
    environment: dict[str, str]
    beats: bool = True
    """Wait for a heartbeat; else for the end of the process."""


def starts(bench: StartBench, folder: Path) -> list[Start]:
    """All rows of the table; the first is what a start of Python costs."""
    warm, cold = install(folder / "warm"), install(folder / "cold", bytecode=False)
    python = [sys.executable]
    full, minimal = (["-m", "companion", "-c", str(bench.config(text)), "run"] for text in (FULL, MINIMAL))
    libraries = "import asyncio, msgspec, numpy; from pymavlink.dialects.v20 import ardupilotmega"
    found = [
        Start("floor: python -c pass", [*python, "-c", "pass"], warm, beats=False),
        Start("floor: import numpy", [*python, "-c", "import numpy"], warm, beats=False),
        Start("floor: import pymavlink's dialect", [*python, "-c", libraries.rpartition(";")[2].strip()], warm,
              beats=False),
        Start("floor: asyncio, msgspec, numpy and dialect", [*python, "-c", libraries], warm, beats=False),
        Start("companion run, everything on", [*python, *full], warm),
        Start("companion run, autopilot's IMU only", [*python, *minimal], warm),
        Start("companion run, everything on, no bytecode", [*python, *full], cold),
        Start("peer: mavutil, one heartbeat", [*python, "-c", MAVUTIL.format(port=bench.port)], warm),
        Start("peer: mavutil, pyserial, numpy and paho", [*python, "-c", OBVIOUS.format(port=bench.port)], warm),
    ]  # fmt: skip
    if _has_mavsdk():
        found.append(Start("peer: mavsdk.asyncio", [*python, "-c", MAVSDK.format(port=bench.port)], warm))
    return found


def _has_mavsdk() -> bool:
    from importlib.util import find_spec

    return find_spec("mavsdk") is not None


def cold_start(rounds: int) -> None:
    with tempfile.TemporaryDirectory() as text:
        bench = StartBench(Path(text))
        rows = starts(bench, Path(text))
        wall: dict[str, list[float]] = {row.words: [] for row in rows}
        spent: dict[str, list[float]] = {row.words: [] for row in rows}
        for number in range(-1, rounds):
            for row in rows:
                wall_s, processor = _start(bench, row)
                if number >= 0:  # the first of all fills the kernel's caches
                    wall[row.words].append(wall_s)
                    spent[row.words].append(processor)
        bench.close()
    floor_s = min(wall[rows[3].words])
    print(
        f"\n{'cold start to first heartbeat':44} {'best':>6} {'median':>7} {'worst':>6} s {'CPU':>5} s {'x floor':>8}"
    )
    for row in rows:
        times = wall[row.words]
        print(f"{row.words:44} {min(times):6.3f} {statistics.median(times):7.3f} {max(times):6.3f}   "
              f"{min(spent[row.words]):5.2f}   {min(times) / floor_s:8.2f}")  # fmt: skip
    full_s = statistics.median(wall[rows[4].words])
    print(f"limit {START_LIMIT_S} s: median {full_s:.3f} s, {_verdict(full_s <= START_LIMIT_S)}; "
          f"load average {os.getloadavg()[0]:.1f}")  # fmt: skip


def _verdict(good: bool) -> str:
    return "held" if good else "NOT HELD"


def _start(bench: StartBench, row: Start) -> tuple[float, float]:
    if row.beats:
        return bench.heartbeat(row.command, row.environment)
    before = os.times()
    begun_s = time.time()
    subprocess.run(row.command, env=row.environment, check=True)
    after = os.times()
    spent_s = after.children_user + after.children_system - before.children_user - before.children_system
    return time.time() - begun_s, spent_s


_IMPORT: Final = re.compile(r"import time:\s*(-?\d+) \|\s*-?\d+ \|\s*(\S+)")


def import_costs(rounds: int) -> None:
    """Print the cost of the imports up to the first heartbeat, by package: the least of some rounds for each module."""
    least: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as text:
        bench = StartBench(Path(text))
        warm, config = install(Path(text) / "warm"), bench.config(FULL)
        for _ in range(rounds):
            _, words = modules_at_first_heartbeat(config, warm)
            for match in _IMPORT.finditer(words):
                least[match[2]] = min(float(match[1]) * 1e-3, least.get(match[2], float("inf")))
        bench.close()
    # What is imported inside a thread, or while another import runs, is taken off twice.
    least = {name: max(cost_ms, 0.0) for name, cost_ms in least.items()}
    total_ms = sum(least.values())
    print(f"\n{len(least)} modules are imported up to the first heartbeat, everything on: {total_ms:.0f} ms")
    for title, depth, most in (("package", 1, 20), ("room", 2, 12)):
        cost_ms: Counter[str] = Counter()
        number: Counter[str] = Counter()
        for name, ms in least.items():
            group = ".".join(name.split(".")[:depth])
            if depth == 1 or name.startswith("companion."):
                cost_ms[group] += ms  # type: ignore[assignment]
                number[group] += 1
        print(f"{title:28} {'ms':>6} {'modules':>8} {'share so far':>13}")
        so_far_ms = 0.0
        for group, ms in cost_ms.most_common(most):
            so_far_ms += ms
            print(f"{group:28} {ms:6.1f} {number[group]:8d} {so_far_ms / total_ms:13.0%}")


def main(rounds: int = 5, calibrations: int = 3) -> None:
    """All tables; the fewest rounds that say something."""
    cold_start(rounds)
    import_costs(min(rounds, 5))
    bench_memory.table()
    bench_record.table(calibrations)


if __name__ == "__main__":
    options = argparse.ArgumentParser(prog="python -m tests.bench_start", description=__doc__)
    options.add_argument("--rounds", type=int, default=15, help="starts of each kind")
    options.add_argument("--calibrations", type=int, default=10, help="of which the record is waited for")
    given = options.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # what was started must not outlive it
    main(given.rounds, given.calibrations)
