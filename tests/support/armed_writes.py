"""Writes by a companion process that is starved of processor time, judged by the kernel's time stamps on the wire.

A child process writes offsets for ever over UDP to an ArduPilot double in this process. The double arms in the middle.
Every PARAM_SET carries the time at which the kernel took it from the child; no clock of the child is trusted.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
import signal
import socket
import struct
import sys
import time
from collections.abc import Callable
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
class ArmedWriteStage:
    """One run: the autopilot at its end of the wire, and the witness."""

    chance: random.Random
    child: int = 0
    armed_at: float = float("inf")
    """Unix time, as the time stamps of the kernel."""
    sets: list[float] = field(default_factory=list)
    """Unix times of all PARAM_SETs."""
    on_set: Callable[[], None] = lambda: None

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
        self.double.attach(self._send)

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
    def beyond_s(self) -> list[float]:
        """Delay after the arming of each PARAM_SET sent although the arming could have been known."""
        return [t_s - self.armed_at for t_s in self.sets if t_s > self.armed_at + RACE_S]

    def _read(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                data, ancillary, _, self._peer = self.socket.recvmsg(65536, 64)
                seconds, nanoseconds = struct.unpack("qq", ancillary[0][2][:16])
                for message in self._codec.parse_buffer(data) or ():
                    if isinstance(message, mavlink.MAVLink_param_set_message):
                        self.sets.append(seconds + 1e-9 * nanoseconds)
                        self.on_set()
                self.double.receive(data, asyncio.get_running_loop().time())

    def _send(self, data: bytes) -> None:
        if self._peer is not None:
            with contextlib.suppress(OSError):
                self.socket.sendto(data, self._peer)


async def starve(stage: ArmedWriteStage, seconds: float, share: float) -> None:
    """Let the child run for 5 to 20 ms at a time, and no more than `share` of the time."""
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        slice_s = stage.chance.uniform(0.005, 0.020)
        os.kill(stage.child, signal.SIGCONT)
        await asyncio.sleep(slice_s)
        os.kill(stage.child, signal.SIGSTOP)
        await asyncio.sleep(slice_s * (1.0 - share) / share)
    os.kill(stage.child, signal.SIGCONT)


async def some_write(stage: ArmedWriteStage, within_s: float = 120.0) -> None:
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


async def starved(stage: ArmedWriteStage) -> None:
    """Arm while the child has 3 % of the processor."""
    await some_write(stage)
    starving = asyncio.create_task(starve(stage, 12.0, 0.03))
    await asyncio.sleep(stage.chance.uniform(1.0, 6.0))
    stage.arm()
    await starving


async def run(seed: int) -> ArmedWriteStage:
    """Starve a writing child to 3 % of the processor, and arm in the middle."""
    stage = ArmedWriteStage(random.Random(seed))
    stage.open()
    flying = asyncio.create_task(stage.double.run())
    child = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "tests.support.armed_writes", str(stage.port), stdout=sys.stderr
    )
    stage.child = child.pid
    try:
        await starved(stage)
    finally:
        with contextlib.suppress(ProcessLookupError):
            child.kill()
        await child.wait()
        flying.cancel()
        await asyncio.gather(flying, return_exceptions=True)
        stage.close()
    return stage


if __name__ == "__main__":
    asyncio.run(write_for_ever(int(sys.argv[1])))
