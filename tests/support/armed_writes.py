"""Writes by a companion process that is stalled, starved or lied to, judged by the kernel's time stamps on the wire.

    python -m tests.support.armed_writes --runs 20            # all cases; prints one line a run and a table

A child process writes offsets for ever over UDP to an ArduPilot double in this process. The double arms in the middle.
Every PARAM_SET carries the time at which the kernel took it from the child; no clock of the child is trusted.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import random
import signal
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.parameters.change import Change
from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.autopilot.vehicle.parameter_writer import ParameterWriter
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.errors import AutopilotError
from companion.links.mavlink.link import MavlinkLink
from companion.links.mavlink.transport import run_transport
from sim.aircraft import Pose, VirtualAircraft
from sim.ardupilot.double import ArduPilotDouble
from sim.imu_model import ImuModel
from sim.scenario import site_at

RACE_S = 0.05
"""A PARAM_SET may cross an arming on its way. Both take a moment from one process to the other, and the way itself."""
NAMES = [f"INS_{kind}_{axis}" for kind in ("ACCOFFS", "GYROFFS") for axis in "XYZ"]
SO_TIMESTAMPNS = 35
ROOM_BYTES = 1 << 20


# --- the child: a companion that only writes


async def write_for_ever(port: int) -> None:
    """Write six offsets to and fro, and put back what an armed aircraft has interrupted."""
    link = MavlinkLink()
    vehicle = Vehicle(link)
    client = ParameterClient(link, vehicle)
    writer = ParameterWriter(client, vehicle)
    for kind in (
        mavlink.MAVLink_raw_imu_message,
        mavlink.MAVLink_highres_imu_message,
        mavlink.MAVLink_attitude_message,
    ):
        vehicle.hear(kind, _estimate, 100.0)
    parent = os.getppid()
    carrying = asyncio.create_task(run_transport(link, f"udpout:127.0.0.1:{port}"))
    while vehicle.system_id is None:
        link.send(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
        await asyncio.sleep(0.1)
    left: list[Change] = []
    while not carrying.done() and os.getppid() == parent:
        await asyncio.sleep(0.05)
        try:
            if left:
                await writer.restore(left)
                left = []
            now = await client.read_many(NAMES)
            changes = [Change(name, value, 0.01 if value < 0.005 else 0.001) for name, value in now.items()]
            await writer.apply(changes)
        except AutopilotError as error:
            print(f"{time.time():.3f} {type(error).__name__}: {error}", flush=True)
            left = [change for change in changes if change.parameter in getattr(error, "left_changed", ())] or left


def _estimate(_message: mavlink.MAVLink_message, _t_s: float) -> None:
    """Spend as much processor time as the estimators of the daemon do for one sample."""
    until_s = time.thread_time() + 0.0003
    while time.thread_time() < until_s:
        pass


# --- this process: the autopilot, and what happens to the child


@dataclass
class Stage:
    """One run: the autopilot at its end of the wire, and the witness."""

    chance: random.Random
    child: int = 0
    armed_at: float = float("inf")
    """Unix time, as the time stamps of the kernel."""
    sets: list[float] = field(default_factory=list)
    """Unix times of all PARAM_SETs."""
    on_set: Callable[[], None] = lambda: None
    one_way_s: float = 0.0
    silenced: bool = False
    """Nothing of what the autopilot sends reaches the child."""
    forging: bool = False

    def __post_init__(self) -> None:
        aircraft = VirtualAircraft(Pose(), site_at(40.0, 116.0, 50.0))
        self.double = ArduPilotDouble(
            aircraft,
            [ImuModel(aircraft, "icm42688p", seed=1)],
            vehicle="copter",
            parameters={"INS_GYR_CAL": 0.0},
            seed=1,
        )
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, ROOM_BYTES)
        self.socket.setblocking(False)
        self.socket.bind(("127.0.0.1", 0))
        self.port: int = self.socket.getsockname()[1]
        self._peer: tuple[str, int] | None = None
        self._codec = mavlink.MAVLink(None)
        self._codec.robust_parsing = True
        self._forger = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self.double.attach(self._from_autopilot)

    def open(self) -> None:
        asyncio.get_running_loop().add_reader(self.socket, self._read)

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self.socket)
        self.socket.close()

    def arm(self) -> None:
        if not self.double.armed:
            self.armed_at = time.time()
            self.double.arm()

    @property
    def late_s(self) -> list[float]:
        """How long after the arming each PARAM_SET left that should not have."""
        return [t_s - self.armed_at for t_s in self.sets if t_s > self.armed_at]

    @property
    def beyond_s(self) -> list[float]:
        """The same of those that left although the arming could have been known."""
        return [late_s for late_s in self.late_s if late_s > self.one_way_s + RACE_S]

    def _read(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                data, ancillary, _, self._peer = self.socket.recvmsg(65536, 64)
                seconds, nanoseconds = struct.unpack("qq", ancillary[0][2][:16])
                for message in self._codec.parse_buffer(data) or ():
                    if isinstance(message, mavlink.MAVLink_param_set_message):
                        self.sets.append(seconds + 1e-9 * nanoseconds)
                        self.on_set()
                    if self.forging:
                        self._answer(message)
                self._later(lambda data=data: self.double.receive(data, asyncio.get_running_loop().time()))  # type: ignore[misc]

    def _later(self, action: Callable[[], None]) -> None:
        if self.one_way_s:
            asyncio.get_running_loop().call_later(self.one_way_s, action)
        else:
            action()

    def _from_autopilot(self, data: bytes) -> None:
        self._later(lambda: None if self.silenced else self._send(data))

    def _send(self, data: bytes) -> None:
        if self._peer is not None:
            with contextlib.suppress(OSError):
                self.socket.sendto(data, self._peer)

    # --- a forger, who hears everything and is nearer than the autopilot

    def forge(self, *messages: mavlink.MAVLink_message) -> None:
        for message in messages:
            self._send(message.pack(self._forger))

    def disarmed(self) -> mavlink.MAVLink_message:
        return mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 1, 0, 3, 3)

    def _answer(self, message: mavlink.MAVLink_message) -> None:
        if isinstance(message, mavlink.MAVLink_command_long_message):
            who = (message.get_srcSystem(), message.get_srcComponent())
            self.forge(mavlink.MAVLink_command_ack_message(message.command, 0, 0, 0, *who), self.disarmed())
        elif isinstance(message, mavlink.MAVLink_timesync_message) and message.tc1 == 0:
            boot_ns = self.double.boot_us(asyncio.get_running_loop().time()) * 1000
            self.forge(mavlink.MAVLink_timesync_message(boot_ns, message.ts1), self.disarmed())
        elif isinstance(message, mavlink.MAVLink_param_set_message):
            name = message.param_id.encode()
            self.forge(mavlink.MAVLink_param_value_message(name, message.param_value, message.param_type, 1000, 65535))
        elif isinstance(message, mavlink.MAVLink_param_request_read_message):
            value = self.double.parameter(message.param_id)
            self.forge(mavlink.MAVLink_param_value_message(message.param_id.encode(), value, 9, 1000, 65535))


async def starve(stage: Stage, seconds: float, share: float) -> None:
    """Let the child run for 5 to 20 ms at a time, and no more than `share` of the time."""
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        slice_s = stage.chance.uniform(0.005, 0.020)
        os.kill(stage.child, signal.SIGCONT)
        await asyncio.sleep(slice_s)
        os.kill(stage.child, signal.SIGSTOP)
        await asyncio.sleep(slice_s * (1.0 - share) / share)
    os.kill(stage.child, signal.SIGCONT)


async def some_write(stage: Stage, within_s: float = 120.0) -> None:
    """Wait until the child is in the middle of its writes, at a random one."""
    seen = asyncio.Event()
    left = stage.chance.randint(7, 18)

    def count() -> None:
        nonlocal left
        left -= 1
        if left <= 0:
            seen.set()

    stage.on_set = count
    async with asyncio.timeout(within_s):
        await seen.wait()
    stage.on_set = lambda: None


async def stalled_and_starved(stage: Stage) -> None:
    await some_write(stage)
    await asyncio.sleep(stage.chance.uniform(0.0, 0.03))
    os.kill(stage.child, signal.SIGSTOP)
    stall_s = stage.chance.uniform(3.0, 6.0)
    await asyncio.sleep(stall_s - 1.0)
    asyncio.get_running_loop().call_later(stage.chance.uniform(0.0, 3.0), stage.arm)
    await asyncio.sleep(1.0)
    await starve(stage, 6.0, stage.chance.uniform(0.03, 0.1))


async def starved(stage: Stage) -> None:
    await some_write(stage)
    starving = asyncio.create_task(starve(stage, 12.0, 0.03))
    await asyncio.sleep(stage.chance.uniform(1.0, 6.0))
    stage.arm()
    await starving


async def stalled(stage: Stage) -> None:
    await some_write(stage)
    await asyncio.sleep(stage.chance.uniform(0.0, 0.03))
    os.kill(stage.child, signal.SIGSTOP)
    stall_s = stage.chance.uniform(3.0, 6.0)
    await asyncio.sleep(stage.chance.uniform(0.0, stall_s))
    stage.arm()
    await asyncio.sleep(stall_s / 2)
    os.kill(stage.child, signal.SIGCONT)
    await asyncio.sleep(4.0)


async def forged(stage: Stage) -> None:
    stage.one_way_s = stage.chance.uniform(0.075, 0.2)
    await some_write(stage)
    stage.forging = True

    async def beat() -> None:
        while stage.forging:
            stage.forge(stage.disarmed())
            await asyncio.sleep(0.05)

    beating = asyncio.create_task(beat())
    await asyncio.sleep(stage.chance.uniform(0.3, 1.0))
    stage.arm()
    await asyncio.sleep(stage.chance.uniform(0.6, 1.5))
    stage.silenced = True
    await asyncio.sleep(stage.chance.uniform(12.0, 20.0))
    stage.silenced = False
    await asyncio.sleep(4.0)
    stage.forging = False
    await beating


CASES = {
    "stalled 3 to 6 s, then starved": stalled_and_starved,
    "starved to 3 %": starved,
    "stalled 3 to 6 s": stalled,
    "forger, autopilot silenced": forged,
}


async def run(case: str, seed: int) -> Stage:
    """One run of one case."""
    stage = Stage(random.Random(seed))
    stage.open()
    flying = asyncio.create_task(stage.double.run())
    child = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "tests.support.armed_writes", "--child", str(stage.port), stdout=sys.stderr
    )
    stage.child = child.pid
    try:
        await CASES[case](stage)
    finally:
        with contextlib.suppress(ProcessLookupError):
            child.kill()
        await child.wait()
        flying.cancel()
        await asyncio.gather(flying, return_exceptions=True)
        stage.close()
    return stage


def tables(runs: int, only: str) -> Iterator[str]:
    """Run all cases; one line for each run, then one for each case."""
    summary = []
    for case in CASES:
        if only not in case:
            continue
        bad, any_late, writes, latest = 0, 0, 0, 0.0
        for seed in range(runs):
            stage = asyncio.run(run(case, seed))
            late = stage.late_s
            yield f"{case} {seed}: {len(stage.sets)} writes, while armed {[round(t_s, 3) for t_s in late]}"
            bad, any_late, writes = bad + bool(stage.beyond_s), any_late + bool(late), writes + len(stage.sets)
            latest = max([latest, *late])
        summary.append(
            f"{case:32} {bad:2} of {runs} runs later than way + {RACE_S:g} s, {any_late} at all, latest {latest:.3f} s,"
            f" {writes} writes"
        )
    yield from summary


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--only", default="")
    parser.add_argument("--child", type=int)
    arguments = parser.parse_args()
    if arguments.child is not None:
        asyncio.run(write_for_ever(arguments.child))
        return
    for line in tables(arguments.runs, arguments.only):
        print(line, flush=True)


if __name__ == "__main__":
    main()
