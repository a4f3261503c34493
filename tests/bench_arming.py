"""Delay of the daemon's answer to a question at arming: idle, busy, and with a crowd at the page.

The daemon is a process of its own with two integer IMUs of a PX4 double, a serial IMU, gradienter and compass, in gate
mode. A relay between the two puts MAV_CMD_ARM_AUTHORIZATION_REQUEST into the autopilot's bytes. The kernel
dates the answer, so that only the daemon's own delay counts. Beside it, asked at the same instants, a
bare asyncio process that echoes: what the machine itself costs.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

EVERY_S: Final = 0.2
READY_S: Final = 180.0
SO_TIMESTAMPNS: Final = 35
ECHO: Final = """
import asyncio, sys
class Echo(asyncio.DatagramProtocol):
    def connection_made(self, transport): self.transport = transport
    def datagram_received(self, data, address): self.transport.sendto(data, address)
async def main():
    loop = asyncio.get_running_loop()
    transport, _ = await loop.create_datagram_endpoint(Echo, local_addr=("127.0.0.1", 0))
    print(transport.get_extra_info("sockname")[1], flush=True)
    await asyncio.Event().wait()
asyncio.run(main())
"""
CROWD: Final = """
import asyncio, sys
async def visitor(number):
    while True:
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", int(sys.argv[1]))
            if number % 3 == 0:
                writer.write(b"GET / HTTP/1.1\\r\\nHost: 127.0.0.1\\r\\nX: ")
                for _ in range(1600):
                    writer.write(bytes(65536))
                    await writer.drain()
            elif number % 3 == 1:
                writer.write(b"GET / HTTP/1.1\\r\\nHost: 127.0.0.1\\r\\n\\r\\n")
            await reader.read()
            writer.close()
        except OSError:
            await asyncio.sleep(0.1)
async def main():
    await asyncio.gather(*(visitor(number) for number in range(1000)))
asyncio.run(main())
"""
"""A thousand visitors of the page: a third sends 100 MB of headers, a third loads the page, a third says nothing."""


class Relay:
    """Carries datagrams between the autopilot double and the daemon, and asks in between."""

    def __init__(self, echo_port: int) -> None:
        self.autopilot, self.daemon, self.echo = self._socket(), self._socket(), self._socket()
        self.echo.connect(("127.0.0.1", echo_port))
        self.daemon_port = free_port()
        self._autopilot_address: tuple[str, int] | None = None
        self._sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._heard = mavlink.MAVLink(None)
        self._heard.robust_parsing = True

    @staticmethod
    def _socket() -> socket.socket:
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        made.bind(("127.0.0.1", 0))
        made.setblocking(False)
        return made

    def run(self, seconds: float, *, ask: bool) -> tuple[list[float], list[float]]:
        """Relay for so long; delays in s of the daemon's answers and of the echoes (inf: none came)."""
        end_s, next_s = time.time() + seconds, time.time() + EVERY_S
        answers: list[float] = []
        echoes: list[float] = []
        asked_s: float | None = None
        echoed_s: float | None = None
        while (now_s := time.time()) < end_s:
            if ask and now_s >= next_s:
                answers += [float("inf")] if asked_s is not None else []
                echoes += [float("inf")] if echoed_s is not None else []
                request = mavlink.MAVLink_command_long_message(1, 0, 3001, 0, 0, 0, 0, 0, 0, 0, 0).pack(self._sender)
                asked_s = time.time()
                self.daemon.sendto(request, ("127.0.0.1", self.daemon_port))
                echoed_s = time.time()
                self.echo.send(b"?")
                next_s += EVERY_S
            ready, _, _ = select.select([self.autopilot, self.daemon, self.echo], [], [], 0.01)
            for one in ready:
                data, stamp_s, sender = receive(one)
                if one is self.autopilot:
                    self._autopilot_address = sender
                    self.daemon.sendto(data, ("127.0.0.1", self.daemon_port))
                elif one is self.echo:
                    if echoed_s is not None:
                        echoes.append(stamp_s - echoed_s)
                        echoed_s = None
                else:
                    if asked_s is not None and self._is_answer(data):
                        answers.append(stamp_s - asked_s)
                        asked_s = None
                    if self._autopilot_address is not None:
                        self.autopilot.sendto(data, self._autopilot_address)
        return answers, echoes

    def _is_answer(self, data: bytes) -> bool:
        messages = self._heard.parse_buffer(data) or ()
        return any(isinstance(m, mavlink.MAVLink_command_ack_message) and m.command == 3001 for m in messages)


def receive(one: socket.socket) -> tuple[bytes, float, tuple[str, int]]:
    """A datagram, when the kernel had it, and from whom."""
    data, ancillary, _, sender = one.recvmsg(2048, 256)
    for level, kind, value in ancillary:
        if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS:
            seconds, nanoseconds = struct.unpack("qq", value[:16])
            return data, seconds + 1e-9 * nanoseconds, sender
    return data, time.time(), sender


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextlib.contextmanager
def running(words: list[str], **how: object) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(words, text=True, **how)  # type: ignore[call-overload]
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(10.0)
        except subprocess.TimeoutExpired:
            process.kill()


@contextlib.contextmanager
def load(processes: int) -> Iterator[None]:
    with contextlib.ExitStack() as stack:
        for _ in range(processes):
            stack.enter_context(running([sys.executable, "-c", "while True: pass"]))
        yield


def companion_status(config: Path) -> dict[str, object] | None:
    asked = subprocess.run(
        [sys.executable, "-m", "companion", "-c", str(config), "status", "--json"], capture_output=True, check=False
    )
    return json.loads(asked.stdout) if asked.returncode == 0 else None


def quantile(delays_s: list[float], share: float) -> float:
    return sorted(delays_s)[min(int(share * len(delays_s)), len(delays_s) - 1)]


def measure(relay: Relay, words: str, seconds: float, say: Callable[[str], None]) -> None:
    answers, echoes = relay.run(seconds, ask=True)
    lost = sum(delay == float("inf") for delay in answers)
    loads = os.getloadavg()[0]
    for name, delays in (("daemon", answers), ("bare asyncio echo", echoes)):
        p50, p99, longest = (1e3 * quantile(delays, share) for share in (0.5, 0.99, 1.0))
        say(f"{words:28} {name:18} {len(delays):5} asked  p50 {p50:6.2f}  p99 {p99:6.2f}  max {longest:6.2f} ms")
    say(f"{words:28} load average {loads:.1f}, unanswered {lost}, daemon/echo p99 "
        f"{quantile(answers, 0.99) / quantile(echoes, 0.99):.1f}")  # fmt: skip


def main() -> None:
    options = argparse.ArgumentParser(prog="python -m tests.bench_arming", description=__doc__)
    options.add_argument("--seconds", type=float, default=30.0, help="of each of the two measurements")
    options.add_argument("--busy", type=int, default=4 * (os.cpu_count() or 1), help="processes that make the load")
    options.add_argument("--nice", type=int, default=0, help="of the daemon; its service has a negative one")
    given = options.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # what was started must not outlive it
    with tempfile.TemporaryDirectory() as text, contextlib.ExitStack() as stack:
        folder = Path(text)
        echo = stack.enter_context(running([sys.executable, "-c", ECHO], stdout=subprocess.PIPE))
        assert echo.stdout is not None
        relay = Relay(int(echo.stdout.readline()))
        udp = f"127.0.0.1:{relay.autopilot.getsockname()[1]}"
        sim = [sys.executable, "-m", "sim", "all", "--firmware", "px4", "--udp", udp, "--dir", str(folder)]
        with (folder / "sim.log").open("w") as log:
            stack.enter_context(running(sim, stdout=log))
        config = folder / "companion.toml"
        up_s = time.monotonic() + 20.0
        while "[mavlink]" not in (folder / "sim.log").read_text():
            if time.monotonic() > up_s:
                raise SystemExit("the simulator did not come up")
            time.sleep(0.1)
        wanted = (folder / "sim.log").read_text()
        wanted = wanted.replace(f"udpin:{udp}", f"udpin:127.0.0.1:{relay.daemon_port}")
        wanted += '\n[calibration]\nat_arm = "gate"\n'
        page_port = free_port()
        wanted += f'[web]\nbind = "127.0.0.1:{page_port}"\n'
        wanted += '\n[[imu]]\nname = "fc2"\nsource = "autopilot"\ninstance = 2\nprofile = "icm42688p"\n'
        config.write_text(wanted)
        command = ["nice", "-n", str(given.nice), sys.executable, "-m", "companion", "-c", str(config), "run"]
        stack.enter_context(running(command, stderr=(folder / "daemon.log").open("w")))
        end_s = time.monotonic() + READY_S
        while time.monotonic() < end_s:
            relay.run(3.0, ask=False)
            status = companion_status(config)
            arming = status.get("arming") if status else None
            if isinstance(arming, dict) and arming.get("verdict") == "accept":
                break
        else:
            raise SystemExit(f"the gate did not open:\n{(folder / 'daemon.log').read_text()}\n{status}")
        measure(relay, "idle", given.seconds, print)
        with load(given.busy):
            relay.run(5.0, ask=False)
            measure(relay, f"{given.busy} busy processes", given.seconds, print)
        with running([sys.executable, "-c", CROWD, str(page_port)]):
            relay.run(5.0, ask=False)
            measure(relay, "a crowd at the page", given.seconds, print)


if __name__ == "__main__":
    main()
