"""What a real ArduPilot and a real PX4 have in common: back end, process, power switch."""

from __future__ import annotations

import asyncio
import contextlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from sim.imu_model import Bias, ImuModel
from sim.motions import Motion
from sim.scenario import Scenario
from sim.sitl.ground import Firmware
from sim.sitl.process import FirmwareProcess
from sim.sitl.samples import SampleBlocks

BOOT_S = 60.0
"""A binary that does not ask for physics by then never will."""

SLOWEST = 10.0
"""Seconds of the wall for one of the firmware's, at most."""


class FirmwareVehicle(ABC):
    """A firmware binary and a scenario's aircraft, whosever the physics. An async context manager on a real event loop.

    Args:
        scenario: the aircraft and its sensors; its double is not used.
        folder: for the binary's files; made if need be. What is stored there survives `power_cycle`.
    """

    firmware: Firmware
    instances: tuple[int, ...] = (1,)
    """The IMUs to calibrate and look at: those whose telemetry lets one tell a mean to some deg/h."""
    process: FirmwareProcess
    system_id: int

    def __init__(self, scenario: Scenario, folder: Path) -> None:
        self.scenario, self.folder = scenario, folder
        self.aircraft = scenario.aircraft
        self.starts = 0
        self._stack = contextlib.AsyncExitStack()

    @property
    @abstractmethod
    def url(self) -> str:
        """Where the companion listens, in the words of its configuration."""

    @property
    @abstractmethod
    def ground_target(self) -> tuple[str, int]:
        """Where the firmware sends what is for the ground station."""

    @property
    @abstractmethod
    def physics_s(self) -> float:
        """The firmware's simulated time since its boot."""

    @abstractmethod
    def true_bias(self, instance: int, t_s: float) -> Bias:
        """What IMU `instance` (1..) of the firmware reads too much at an aircraft time."""

    @abstractmethod
    async def _open(self, stack: contextlib.AsyncExitStack) -> FirmwareProcess:
        """Open the back end and make the process, not started."""

    async def __aenter__(self) -> Self:
        """Start back end and binary, and wait until its simulated time passes.

        Raises:
            BinaryError: it cannot be run, or died, or does not ask for physics.
            OSError: a port is taken.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            self.process = await self._open(self._stack)
            self._stack.push_async_callback(self.process.stop)
            await self.power_on()
        except BaseException:
            await self._stack.aclose()
            raise
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        await self._stack.aclose()

    async def power_on(self) -> None:
        """Start the binary with what it has stored.

        Raises:
            BinaryError: it cannot be run, or died, or does not ask for physics.
        """
        boots = self.backend_boots
        await self.process.start()
        self.starts += 1
        await self.process.until(
            lambda: self.backend_boots > boots and self.physics_s > 1.0, BOOT_S, "a second of simulated flight"
        )

    async def power_off(self) -> None:
        """Pull its plug."""
        await self.process.stop()

    async def power_cycle(self, off_s: float = 0.5) -> None:
        """Off and on again."""
        await self.power_off()
        await asyncio.sleep(off_s)
        await self.power_on()

    async def factory_reset(self) -> None:
        """Off, all it has stored gone, and on again as at the very first start."""
        await self.power_off()
        for name in self.stored:
            (self.folder / name).unlink(missing_ok=True)
        await self.power_on()

    @property
    @abstractmethod
    def stored(self) -> tuple[str, ...]:
        """Names of the files in which its parameters live."""

    @property
    @abstractmethod
    def backend_boots(self) -> int:
        """Starts the back end has seen, also those the firmware did by itself."""

    async def sleep(self, seconds: float) -> None:
        """Let so much time pass on the firmware's clock, which a busy machine lets run slower than the wall's.

        Raises:
            TimeoutError: it has all but stopped.
        """
        begun_s, starts = self.physics_s, self.backend_boots
        async with asyncio.timeout(SLOWEST * seconds + 1.0):
            while self.backend_boots == starts and self.physics_s - begun_s < seconds:
                await asyncio.sleep(0.05)

    @property
    def now_s(self) -> float:
        """Aircraft time."""
        return self.aircraft.time_at(asyncio.get_running_loop().time())


class SitlVehicle(FirmwareVehicle):
    """A firmware on our physics: it lives on the scenario's aircraft, and its IMUs read what ours read."""

    @property
    @abstractmethod
    def samples(self) -> SampleBlocks:
        """What the back end sends."""

    @property
    @abstractmethod
    def imus(self) -> tuple[ImuModel, ...]:
        """The models behind the back end."""

    def move(self, motions: Sequence[Motion]) -> None:
        """Let something happen to the aircraft; start at least 0.1 s from now (aircraft time, see `now_s`)."""
        for motion in motions:
            self.aircraft.add(motion)
