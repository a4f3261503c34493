"""The real daemon on a real firmware: configuration, serial devices, process, and a lossy UDP link."""

from __future__ import annotations

import asyncio
import contextlib
import os
import random
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Self

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.companion_process import CompanionProcess
from sim.hands import AHEAD_S, Hands
from sim.scenario import Scenario
from sim.serve import configuration, serve
from sim.sitl.process import LOOPBACK, free_udp_port
from sim.sitl.vehicle import FirmwareVehicle, SitlVehicle

Message = mavlink.MAVLink_message


class LossyLink:
    """A UDP relay between firmware and companion; an async context manager.

    Args:
        loss: share of lost datagrams in either direction, 0..1; can be changed at any time.
        seed: seed of the losses.
        near_port: port to which the firmware sends; None: any free one.
    """

    def __init__(self, *, loss: float = 0.0, seed: int = 1, near_port: int | None = None) -> None:
        self.loss = loss
        self.near = (LOOPBACK, free_udp_port() if near_port is None else near_port)
        """Address to which the firmware's `udpclient` sends."""
        self.far = (LOOPBACK, free_udp_port())
        """Address at which the companion listens."""
        self.lost = self.passed = 0
        self._random = random.Random(seed)
        self._codec = mavlink.MAVLink(None)
        self._codec.robust_parsing = True
        self._waiting: list[tuple[Callable[[Message], bool], asyncio.Future[Message]]] = []
        self._firmware: tuple[str, int] | None = None
        self._front: asyncio.DatagramTransport
        self._back: asyncio.DatagramTransport

    @property
    def url(self) -> str:
        """URL of this relay for the companion's configuration."""
        return f"udpin:{self.far[0]}:{self.far[1]}"

    def sent(self, condition: Callable[[Message], bool]) -> asyncio.Future[Message]:
        """Return a future for the companion's next message that meets the condition; done when it passes or is lost."""
        future: asyncio.Future[Message] = asyncio.get_running_loop().create_future()
        self._waiting.append((condition, future))
        return future

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        self._back, _ = await loop.create_datagram_endpoint(
            lambda: _Face(self._from_companion), local_addr=(LOOPBACK, 0)
        )
        # Last: the firmware sends already, and what comes is passed on at once.
        self._front, _ = await loop.create_datagram_endpoint(lambda: _Face(self._from_firmware), local_addr=self.near)
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        self._front.close()
        self._back.close()
        for _, future in self._waiting:
            future.cancel()

    def _gets_lost(self) -> bool:
        lost = self._random.random() < self.loss
        self.lost, self.passed = self.lost + lost, self.passed + (not lost)
        return lost

    def _from_firmware(self, data: bytes, peer: tuple[str, int]) -> None:
        self._firmware = peer
        if not self._gets_lost():
            self._back.sendto(data, self.far)

    def _from_companion(self, data: bytes, _: tuple[str, int]) -> None:
        if self._firmware is not None and not self._gets_lost():
            self._front.sendto(data, self._firmware)
        for message in self._codec.parse_buffer(data) or ():
            for condition, future in [*self._waiting]:
                if not future.done() and condition(message):
                    future.set_result(message)
        self._waiting = [entry for entry in self._waiting if not entry[1].done()]


class _Face(asyncio.DatagramProtocol):
    def __init__(self, take: Callable[[bytes, tuple[str, int]], None]) -> None:
        self._take = take

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        self._take(data, addr)

    def error_received(self, exc: Exception) -> None:
        """Ignore the error: nobody listens at present."""


READY_WITHIN_S = 40.0
PORTS_WITHIN_S = 5.0
_IMU = '[[imu]]\nname = "fc{0}"\nsource = "autopilot"\ninstance = {0}\nprofile = "icm42688p"\n\n'


def daemon_configuration(vehicle: FirmwareVehicle, folder: Path, more: str = "", url: str | None = None) -> str:
    """Return a companion.toml for the vehicle's IMUs with the ports in the folder; `more` is appended."""
    host, port = vehicle.url.removeprefix("udpin:").rsplit(":", 1)
    text = configuration(vehicle.scenario, directory=folder, udp=(host, int(port)))
    text = text.replace(vehicle.url, url or vehicle.url)
    # The autopilot's IMUs only: the serial one has nothing to do with the firmware.
    head, _, tail = text.partition("[[imu]]")
    imus = "".join(_IMU.format(instance) for instance in vehicle.instances)
    return head + imus + tail[tail.index("[gradienter]") :] + more


@contextlib.asynccontextmanager
async def devices(scenario: Scenario, folder: Path) -> AsyncIterator[Path]:
    """Serve `imu`, `gradienter` and `compass` of the aircraft as ports in an existing folder."""
    up = asyncio.Event()
    serving = asyncio.create_task(serve(scenario, directory=folder, started=up), name="devices")
    try:
        async with asyncio.timeout(PORTS_WITHIN_S):
            await up.wait()
        yield folder
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


async def obeyed(daemon: CompanionProcess, hands: Hands, vehicle: SitlVehicle, *words: str) -> str:
    """Run a command of the companion to its end, and move the aircraft as it asks; return what it printed.

    Raises:
        RuntimeError: the command failed.
    """
    process = await asyncio.create_subprocess_exec(
        *daemon.command(*words), env=os.environ | {"PYTHONUNBUFFERED": "1"},
        stdin=asyncio.subprocess.DEVNULL, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
    )  # fmt: skip
    assert process.stdout is not None
    done, printed = "", []
    while line := (await process.stdout.readline()).decode():
        printed.append(line)
        if "waiting for it to move" in line and line != done:
            done = line
            hands.follow(line, vehicle.now_s + AHEAD_S)
    if await process.wait() != 0:
        raise RuntimeError(f"companion {' '.join(words)}: {''.join(printed)}")
    return "".join(printed)


@contextlib.asynccontextmanager
async def companion_daemon(
    vehicle: SitlVehicle, folder: Path, *, more: str = "", url: str | None = None
) -> AsyncIterator[CompanionProcess]:
    """Run `companion run` with the aircraft's devices on the vehicle's companion link, until it knows the vehicle.

    Args:
        vehicle: running; nobody else listens on its companion link.
        folder: for the ports, the configuration, the log and the companion's storage.
        more: further lines of the companion's configuration.
        url: URL of the companion's link to the vehicle (None: the vehicle's own URL).
    """
    folder.mkdir(exist_ok=True)  # noqa: ASYNC240 - a local folder
    (folder / "companion.toml").write_text(daemon_configuration(vehicle, folder, more, url), encoding="utf-8")
    async with devices(vehicle.scenario, folder), CompanionProcess(folder) as daemon:
        await daemon.ready(READY_WITHIN_S)
        yield daemon
