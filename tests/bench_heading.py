"""How long a sample of the serial IMU takes to become a heading on the wire, on an idle machine and on a busy one.

The daemon is a process of its own with a serial IMU at 200 Hz, gradienter, compass and an ArduPilot double, pushing at
50 Hz. Counted is from just before the write of a frame's last byte to the pseudo-terminal until the kernel has the
VISION_POSITION_ESTIMATE that carries this very sample; which one that is tells its time stamp.
"""

from __future__ import annotations

import argparse
import asyncio
import bisect
import contextlib
import os
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.pty_device import PtyDevice
from sim.scenario import demo
from sim.serve import configuration, serve
from tests.bench_arming import companion_status, free_port, load, quantile, receive, running

READY_S: Final = 120.0
MORE: Final = """
[push]
attitude = "yaw"
attitude_rate_hz = 50.0
[calibration]
min_still_s = 5
max_s = 8
at_arm = "off"
"""


class Relay(threading.Thread):
    """Carries datagrams between the autopilot double and the daemon, and notes those with a heading."""

    def __init__(self, autopilot: tuple[str, int], daemon: tuple[str, int]) -> None:
        super().__init__(daemon=True)
        self.headings: list[tuple[int, float]] = []
        """Stamp in us of the daemon's clock, and when the kernel had it."""
        self._ends = (self._socket(autopilot), self._socket(None))
        self._daemon = daemon
        self._heard = mavlink.MAVLink(None)
        self._heard.robust_parsing = True
        self._autopilot: tuple[str, int] | None = None

    @staticmethod
    def _socket(address: tuple[str, int] | None) -> socket.socket:
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.setsockopt(socket.SOL_SOCKET, 35, 1)  # SO_TIMESTAMPNS
        made.bind(address or ("127.0.0.1", 0))
        return made

    def run(self) -> None:
        import select

        autopilot, daemon = self._ends
        while True:
            ready, _, _ = select.select([autopilot, daemon], [], [])
            for one in ready:
                data, stamp_s, sender = receive(one)
                if one is autopilot:
                    self._autopilot = sender
                    daemon.sendto(data, self._daemon)
                    continue
                for message in self._heard.parse_buffer(data) or ():
                    if isinstance(message, mavlink.MAVLink_vision_position_estimate_message):
                        self.headings.append((message.usec, stamp_s))
                if self._autopilot is not None:
                    autopilot.sendto(data, self._autopilot)


@contextlib.contextmanager
def noting_writes(path: Path, writes: list[tuple[float, float]]) -> Iterator[None]:
    """Note the monotonic and the wall clock just before each write of one device."""
    write = PtyDevice._write

    def noted(self: PtyDevice, data: bytes) -> None:
        if self.path == path and data:
            writes.append((time.monotonic(), time.time()))
        write(self, data)

    PtyDevice._write = noted  # type: ignore[method-assign]
    try:
        yield
    finally:
        PtyDevice._write = write  # type: ignore[method-assign]


def delays(writes: list[tuple[float, float]], headings: list[tuple[int, float]]) -> list[float]:
    """Of each heading since the write of its sample."""
    times = [monotonic_s for monotonic_s, _ in writes]
    found = []
    for stamp_us, arrived_s in headings:
        index = bisect.bisect_right(times, stamp_us * 1e-6) - 1
        if index >= 0:
            found.append(arrived_s - writes[index][1])
    return found


async def measure(relay: Relay, writes: list[tuple[float, float]], words: str, seconds: float) -> None:
    begun, first = len(relay.headings), len(writes)
    await asyncio.sleep(seconds)
    headings = relay.headings[begun:]
    found = delays(writes[max(first - 50, 0) :], headings)
    p50, p99, longest = (1e3 * quantile(found, share) for share in (0.5, 0.99, 1.0))
    print(f"{words:22} {(len(writes) - first) / seconds:5.0f} samples/s, {len(headings) / seconds:4.1f} headings/s: "
          f"p50 {p50:.2f}, p99 {p99:.2f}, max {longest:.2f} ms; load {os.getloadavg()[0]:.1f}", flush=True)  # fmt: skip


async def bench(folder: Path, seconds: float, busy: int, nice: int) -> None:
    loop = asyncio.get_running_loop()
    udp, daemon = ("127.0.0.1", free_port()), ("127.0.0.1", free_port())
    relay = Relay(udp, daemon)
    relay.start()
    scenario = demo(unix_s=time.time())
    writes: list[tuple[float, float]] = []
    config = folder / "companion.toml"
    config.write_text(configuration(scenario, directory=folder, udp=daemon) + MORE)
    with noting_writes(folder / "imu", writes), contextlib.ExitStack() as stack:
        up = asyncio.Event()
        serving = asyncio.create_task(serve(scenario, directory=folder, udp=udp, started=up))
        await up.wait()
        command = ["nice", "-n", str(nice), sys.executable, "-m", "companion", "-c", str(config)]
        stack.enter_context(running([*command, "run"], stderr=(folder / "daemon.log").open("w")))
        asked = None
        end_s = loop.time() + READY_S
        while not relay.headings:
            await asyncio.sleep(1.0)
            if loop.time() > end_s:
                raise SystemExit(f"no heading came:\n{(folder / 'daemon.log').read_text()}")
            status = await asyncio.to_thread(companion_status, config)
            if status is not None and asked is None:
                asked = stack.enter_context(running([*command, "calibrate", "--wait"]))
        await asyncio.sleep(3.0)
        await measure(relay, writes, "idle, disarmed", seconds)
        scenario.autopilot.arm()
        await asyncio.sleep(2.0)
        await measure(relay, writes, "idle, armed", seconds)
        with load(busy):
            await asyncio.sleep(3.0)
            await measure(relay, writes, f"{busy} busy processes", seconds)
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


def main() -> None:
    options = argparse.ArgumentParser(prog="python -m tests.bench_heading", description=__doc__)
    options.add_argument("--seconds", type=float, default=20.0, help="of each measurement")
    options.add_argument("--busy", type=int, default=2 * (os.cpu_count() or 1), help="processes that make the load")
    options.add_argument("--nice", type=int, default=0, help="of the daemon; its service has a negative one")
    given = options.parse_args()
    with tempfile.TemporaryDirectory() as text:
        asyncio.run(bench(Path(text), given.seconds, given.busy, given.nice))


if __name__ == "__main__":
    main()
