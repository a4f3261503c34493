"""A device on a pty that says what a test wants it to say, and one sensor of the daemon that listens to it."""

from __future__ import annotations

import asyncio
import contextlib
import os
import tty
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from companion.configured.models import Role, SerialDevice
from companion.daemon.devices.sensor_watch import SensorWatch
from companion.daemon.devices.sensors import SerialSensor
from companion.estimation.collector.rolling import RollingCollector
from companion.protocols.registry import PROTOCOLS
from companion.samples import Sample
from sim.devices import nmea
from sim.pty_device import Setting, heard, reader_setting
from tests.support.still_aircraft import HEADING, TILT, imu, settings

RECOVERY_S = 3.0
"""Time limit for new data after the cause has ended."""


def tilt_frame(number: int) -> bytes:
    """An X/Y gradienter whose last digit moves."""
    return f"X=+00.{430 + number % 7:03d}\r\nY=-00.{84 + number % 5:03d}\r\n".encode()


def compass_frame(number: int) -> bytes:
    return f"12{number % 3}.4, 18.{number % 10}, -0.5\r\n".encode()


def imu_frame(number: int, *, rate: str | None = None) -> bytes:
    """An `$IMU` line; at 50 Hz by its own clock."""
    t_us = round(number / 50.0 * 1e6) % 2**32
    x = f"{1e-4 * (number % 13):.6f}" if rate is None else rate
    return nmea(f"IMU,{number % 65536},{t_us},{x},0.0,0.0,0.01,0.02,-9.8,25.0")


class Chatter:
    """Says one frame after the other on a pty; what it says, and how its line is set, may change at any time."""

    def __init__(
        self, path: Path, frame: Callable[[int], bytes], *, rate_hz: float = 10.0, line: Setting | None = None
    ) -> None:
        self.path, self.frame, self.rate_hz, self.line = path, frame, rate_hz, line
        self.muted = False
        self.master = -1
        self._task: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        self.plug(self.path)
        self._task = asyncio.create_task(self._talk())
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        assert self._task is not None
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        self.unplug()

    def plug(self, path: Path) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self.master, False)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.symlink_to(os.ttyname(slave))
        os.close(slave)
        self.path = path

    def unplug(self) -> None:
        if self.master >= 0:
            self.path.unlink(missing_ok=True)
            os.close(self.master)
            self.master = -1

    def say(self, data: bytes) -> None:
        if self.master < 0:
            return
        if self.line is not None:
            data = heard(data, self.line, reader_setting(self.master))
        with contextlib.suppress(OSError):
            os.write(self.master, data)

    async def _talk(self) -> None:
        number = 0
        while True:
            if not self.muted:
                self.say(self.frame(number))
            number += 1
            await asyncio.sleep(1.0 / self.rate_hz)


class Listening:
    """One sensor of the daemon, watched over, and what it has said and given so far."""

    def __init__(
        self,
        kind: Literal["imu", "gradienter", "compass"],
        protocol: str,
        url: str,
        *,
        baud: int | None = None,
        parity: Literal["none", "even", "odd"] | None = None,
    ) -> None:
        self.samples: list[Sample] = []
        self.collector = still_collector()
        info = PROTOCOLS[kind][protocol]
        role = Role({"imu": "own"}.get(kind, kind), kind)
        device = SerialDevice(url, info, baud or info.baud, parity or info.parity, read_only=False, roles=(role,))
        self.sensor = SerialSensor(device, lambda role, part: self.samples.append(part))
        self.watch = SensorWatch([self.sensor], self.collector)

    @property
    def words(self) -> str:
        trouble = self.sensor.health.trouble(asyncio.get_running_loop().time())
        return "" if trouble is None else trouble.words

    @property
    def counts(self) -> dict[str, int]:
        return dict(self.sensor.health.counts)

    async def until(self, condition: Callable[[], Any], within_s: float = 60.0) -> float:
        """Wait for something to become true; how long it took. Fails when it does not."""
        loop = asyncio.get_running_loop()
        since_s = loop.time()
        while not condition():
            assert loop.time() - since_s < within_s, f"not within {within_s} s: {self.words!r} {self.counts}"
            await asyncio.sleep(0.01)
        return loop.time() - since_s

    async def data(self, within_s: float = RECOVERY_S) -> float:
        """Wait until samples come, and nothing is wrong any more."""
        before = len(self.samples)
        took_s = await self.until(lambda: len(self.samples) >= before + 2, within_s)
        return took_s + await self.until(lambda: not self.words, within_s - took_s)


@contextlib.asynccontextmanager
async def listening(kind: Any, protocol: str, url: str | Path, **line: Any) -> AsyncIterator[Listening]:
    one = Listening(kind, protocol, str(url), **line)
    tasks = [asyncio.create_task(one.sensor.run()), asyncio.create_task(one.watch.run())]
    try:
        yield one
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def still_collector() -> RollingCollector:
    return RollingCollector(settings(), [imu("fc")], TILT, HEADING)
