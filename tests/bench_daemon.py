"""Processor cost of the whole daemon, beside a bare read loop and the obvious script.

The load (`tests.bench_daemon_load`, in processes of its own that are not counted): VectorNav binary at 1 kHz, a
gradienter at 10 Hz and a compass at 8 Hz through pseudo-terminals, and 200 MAVLink messages a second through UDP, each
datagram one message. The readers, each a process of its own, one after the other, round by round:

- bare loop: epoll, and `os.read` or `recv` of whatever is ready, at its arrival; nothing else. The floor;
- bare asyncio: the same reads, as readers of asyncio's event loop;
- obvious script: `tests/obvious_script.py`, threads with pyserial and `mavutil`, which sends an attitude at 50 Hz;
- daemon: `companion run` with serial IMU, the autopilot's IMU, gradienter and compass; calibrated, aligned, and pushing
  the attitude ("full") at 50 Hz; without a recording, and with the ring of recordings.

Counted is the processor time, user and system, of all threads of the process, by the kernel's scheduler, over the same
seconds of the same load after a warm-up. A ratio is that of the medians; behind it stand the least and the largest of
the rounds. The machine may be busy: what somebody else does on it moves both sides of a ratio alike.

    python -m tests.bench_daemon                    three rounds of 20 s: some eight minutes
    python -m tests.bench_daemon --imu imu_line     with the project's own line at 200 Hz instead
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import multiprocessing
import os
import select
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

from companion.links.serial.port import SerialOpener
from sim.scenario import Scenario
from sim.serve import configuration
from tests import obvious_script
from tests.bench_arming import companion_status, free_port, running
from tests.bench_daemon_load import MESSAGES_HZ, feed_imu, feed_rest, imu_device, scenario

READ_BYTES: Final = 65536
WARM_S: Final = 2.0
SETTLED_S: Final = 5.0
"""Time after the daemon's first heading."""
READY_S: Final = 120.0
MORE: Final = """
[push]
attitude = "full"
attitude_rate_hz = 50.0
[calibration]
min_still_s = 5
max_s = 10
"""
FLOOR, SCRIPT, DAEMON, RECORDING = "bare loop", "obvious script", "daemon", "daemon, recording"
TABLE_S: Final = 6.0
"""Of a round as `make bench` has it."""

Ports = dict[str, tuple[str, int]]


def cpu_s(pid: int) -> float:
    """Processor time that the living threads of a process have had, to the nanosecond."""
    total_ns = 0
    for task in Path(f"/proc/{pid}/task").iterdir():
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            total_ns += int((task / "schedstat").read_text().split()[0])
    return total_ns * 1e-9


# --- the readers that are not the daemon


def _opened(ports: Ports) -> list[int]:
    async def open_all() -> list[int]:
        return [await SerialOpener(path, baud, "none").open() for path, baud in ports.values()]

    return asyncio.run(open_all())


def _socket(udp: tuple[str, int]) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.bind(udp)
    made.setblocking(False)
    return made


def bare_loop(ports: Ports, udp: tuple[str, int], imu: str, pipe: Connection) -> None:
    """The least that anybody can do who wants all bytes when they come."""
    descriptors, endpoint, asked = _opened(ports), _socket(udp), pipe.fileno()
    waiting = select.epoll()
    for descriptor in (*descriptors, endpoint.fileno(), asked):
        waiting.register(descriptor, select.EPOLLIN)
    datagrams = endpoint.fileno()
    reads = received = 0
    pipe.send(None)
    while True:
        for descriptor, _ in waiting.poll():
            if descriptor == datagrams:
                endpoint.recv(READ_BYTES)
                received += 1
            elif descriptor != asked:
                os.read(descriptor, READ_BYTES)
                reads += 1
            else:
                pipe.recv()
                pipe.send({"reads": reads, "mavlink": received})


def bare_asyncio(ports: Ports, udp: tuple[str, int], imu: str, pipe: Connection) -> None:
    counts: Counter[str] = Counter()
    descriptors = _opened(ports)

    class Datagrams(asyncio.DatagramProtocol):
        def datagram_received(self, data: bytes, addr: object) -> None:
            counts["mavlink"] += 1

    def read(descriptor: int) -> None:
        os.read(descriptor, READ_BYTES)
        counts["reads"] += 1

    def answer() -> None:
        pipe.recv()
        pipe.send(dict(counts))

    async def main() -> None:
        loop = asyncio.get_running_loop()
        await loop.create_datagram_endpoint(Datagrams, local_addr=udp)
        for descriptor in descriptors:
            loop.add_reader(descriptor, read, descriptor)
        loop.add_reader(pipe.fileno(), answer)
        pipe.send(None)
        await loop.create_future()

    asyncio.run(main())


def script(ports: Ports, udp: tuple[str, int], imu: str, pipe: Connection) -> None:
    """`tests.obvious_script`, and a main thread that waits."""
    counts = obvious_script.start(ports, imu, f"udpin:{udp[0]}:{udp[1]}")
    pipe.send(None)
    while True:
        pipe.recv()
        pipe.send(dict(counts))


READERS: Final[dict[str, Callable[[Ports, tuple[str, int], str, Connection], None]]] = {
    FLOOR: bare_loop,
    "bare asyncio": bare_asyncio,
    SCRIPT: script,
}


# --- one measurement


class Worker:
    def __init__(self, target: Callable[..., None], *arguments: object) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, there = context.Pipe()
        self.process = context.Process(target=target, args=(*arguments, there), daemon=True)
        self.process.start()
        there.close()
        self.answer(READY_S)

    def answer(self, within_s: float = 10.0) -> Any:
        if not self.pipe.poll(within_s):
            raise TimeoutError(f"{self.process.name}: no answer within {within_s:g} s")
        return self.pipe.recv()

    def ask(self, word: str) -> Any:
        self.pipe.send(word)
        return self.answer()

    def end(self) -> None:
        self.process.terminate()
        self.process.join(5.0)
        self.process.kill()


class Load:
    def __init__(self, folder: Path, imu: str, stack: contextlib.ExitStack) -> None:
        self.folder, self.imu = folder, imu
        self.udp = ("127.0.0.1", free_port())
        self._inertial = self._start(stack, feed_imu, folder / "imu", imu)
        self._rest = self._start(stack, feed_rest, folder, self.udp)

    @staticmethod
    def _start(stack: contextlib.ExitStack, target: Callable[..., None], *arguments: object) -> Worker:
        worker = Worker(target, *arguments)
        stack.callback(worker.end)
        return worker

    def ports(self, world: Scenario) -> Ports:
        device = imu_device(world, self.imu)
        found = {"imu": (str(self.folder / "imu"), device.baud)}
        for name in ("gradienter", "compass"):
            found[name] = (str(self.folder / name), getattr(world, name).baud)
        return found

    def counts(self) -> dict[str, Any]:
        found: dict[str, Any] = self._rest.ask("counts")
        return found

    def pushed(self) -> int:
        return int(self.counts()["received"].get("VISION_POSITION_ESTIMATE", 0))


@contextlib.contextmanager
def loaded(imu: str) -> Iterator[Load]:
    with tempfile.TemporaryDirectory() as text, contextlib.ExitStack() as stack:
        yield Load(Path(text), imu, stack)


def measure(pid: int, load: Load, seconds: float) -> tuple[float, float, float]:
    """Share of a core in per cent, messages a second that were sent, and attitudes a second that came back."""
    before, since_s, spent_s = load.counts(), time.monotonic(), cpu_s(pid)
    time.sleep(seconds)
    spent_s, span_s, after = cpu_s(pid) - spent_s, time.monotonic() - since_s, load.counts()
    pushed = [each["received"].get("VISION_POSITION_ESTIMATE", 0) for each in (before, after)]
    return 100.0 * spent_s / span_s, (after["sent"] - before["sent"]) / span_s, (pushed[1] - pushed[0]) / span_s


def of_reader(name: str, imu: str, seconds: float, notes: dict[str, str]) -> float:
    """Share of a core that a reader takes, in per cent."""
    with loaded(imu) as load:
        reader = Worker(READERS[name], load.ports(scenario()), load.udp, imu)
        try:
            time.sleep(WARM_S)
            before = reader.ask("counts")
            share, sent_hz, pushed_hz = measure(reader.process.pid or 0, load, seconds)
            after = reader.ask("counts")
        finally:
            reader.end()
    rates = ", ".join(f"{(after[key] - before.get(key, 0)) / seconds:.0f} {key}/s" for key in sorted(after))
    notes[name] = f"{rates}; {sent_hz:.0f} MAVLink messages/s sent, {pushed_hz:.1f} attitudes/s came back"
    return share


def daemon_config(load: Load, *, recording: bool) -> Path:
    world = scenario()
    # What fits the simulated devices, but for the IMU's rate and with it its line.
    made = configuration(world, directory=load.folder, udp=load.udp)
    ports = load.ports(world)
    made = made.replace(f"baud = {world.imu.baud}", f"baud = {ports['imu'][1]}", 1)
    made = made.replace(f'protocol = "{world.imu.protocol}"', f'protocol = "{load.imu}"', 1)
    if not recording:
        made = made.replace("[storage]\n", "[storage]\nrecordings_mb = 0\n")
    path = load.folder / "companion.toml"
    path.write_text(made + MORE)
    return path


@contextlib.contextmanager
def daemon(load: Load, *, recording: bool) -> Iterator[int]:
    """The daemon's process, once it pushes attitudes: started, calibrated, aligned."""
    config, log = daemon_config(load, recording=recording), load.folder / "daemon.log"
    command = [sys.executable, "-m", "companion", "-c", str(config)]
    with contextlib.ExitStack() as stack:
        running_daemon = stack.enter_context(running([*command, "run"], stderr=log.open("w")))
        until_s = time.monotonic() + READY_S
        asked: subprocess.Popen[bytes] | None = None
        while load.pushed() == 0:
            if time.monotonic() > until_s or running_daemon.poll() is not None:
                raise SystemExit(f"the daemon does not push:\n{log.read_text()}")
            if asked is None and companion_status(config) is not None:
                asked = subprocess.Popen(
                    [sys.executable, "-m", "companion", "-c", str(config), "calibrate"],
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )
                stack.callback(asked.kill)
            time.sleep(0.5)
        if asked is not None:
            asked.wait(READY_S)
        time.sleep(SETTLED_S)
        yield running_daemon.pid


def of_daemon(name: str, imu: str, seconds: float, notes: dict[str, str]) -> float:
    """Share of a core that the daemon takes, in per cent."""
    with loaded(imu) as load, daemon(load, recording=name == RECORDING) as pid:
        share, sent_hz, pushed_hz = measure(pid, load, seconds)
        status = companion_status(load.folder / "companion.toml") or {}
    lines = [str(each["summary"]) for each in status.get("devices", []) if isinstance(each, dict)]  # type: ignore[attr-defined]
    notes[name] = f"{sent_hz:.0f} MAVLink messages/s sent, {pushed_hz:.1f} attitudes/s came back; " + "; ".join(lines)
    return share


# --- the table


def table(rounds: int, seconds: float, imu: str) -> None:
    shares: dict[str, list[float]] = {name: [] for name in (*READERS, DAEMON, RECORDING)}
    notes: dict[str, str] = {}
    for _ in range(rounds):
        for name, found in shares.items():
            measured = of_reader if name in READERS else of_daemon
            found.append(measured(name, imu, seconds, notes))
    stream = "VectorNav at 1 kHz" if imu == "vectornav" else "$IMU lines at 200 Hz"
    print(f"\nprocessor time, {stream}, tilt at 10 Hz, heading at 8 Hz, {MESSAGES_HZ:.0f} MAVLink messages/s; "
          f"{rounds} rounds of {seconds:g} s, load {os.getloadavg()[0]:.1f}:")  # fmt: skip
    print(f"  {'one':20} {'% of a core':>11}   {'x bare loop':24} x obvious script")
    for name, found in shares.items():
        ratios = [_ratio(found, shares[peer]) for peer in (FLOOR, SCRIPT)]
        print(f"  {name:20} {statistics.median(found):11.2f}   {ratios[0]:24} {ratios[1]}")
    for name, words in notes.items():
        print(f"  {name}: {words}")


def _ratio(found: list[float], peer: list[float]) -> str:
    by_round = [ours / theirs for ours, theirs in zip(found, peer, strict=True)]
    middle = statistics.median(found) / statistics.median(peer)
    return f"{middle:.2f} ({min(by_round):.2f} to {max(by_round):.2f})"


def main() -> None:
    options = argparse.ArgumentParser(prog="python -m tests.bench_daemon", description=__doc__)
    options.formatter_class = argparse.RawDescriptionHelpFormatter
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument("--seconds", type=float, default=20.0, help="of each measurement")
    options.add_argument("--imu", choices=("vectornav", "imu_line"), default="vectornav")
    given = options.parse_args()
    table(given.rounds, given.seconds, given.imu)


if __name__ == "__main__":
    main()
