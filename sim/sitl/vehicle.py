"""The base of real ArduPilot and PX4 vehicles: back end, process, power switch."""

from __future__ import annotations

import asyncio
import contextlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol, Self

from sim.imu_model import Bias, ImuModel
from sim.motions import Motion
from sim.scenario import Scenario
from sim.sitl.ground import Firmware
from sim.sitl.process import FirmwareProcess
from sim.sitl.samples import SampleBlocks

BOOT_S = 60.0
"""Time limit of the boot: a binary that has not asked for physics by then never will."""

SLOWEST = 10.0
"""Largest ratio of wall time to the firmware's simulated time."""


class Backend(Protocol):
    """Gives a firmware its physics, or follows the firmware's physics."""

    boots: int
    """Number of starts of the firmware, including its own restarts."""


class FirmwareVehicle(ABC):
    """A firmware binary and a scenario's aircraft. An async context manager on a real event loop.

    Args:
        scenario: the aircraft and its sensors; the scenario's autopilot double is not used.
        folder: folder for the binary's files, made if missing. Stored files survive `power_cycle`.
    """

    firmware: Firmware
    instances: tuple[int, ...] = (1,)
    """IMUs to calibrate and observe: those whose telemetry resolves a mean to a few deg/h."""
    process: FirmwareProcess
    backend: Backend
    system_id: int
    url: str
    """URL at which the companion listens, for its configuration."""
    ground_target: tuple[str, int]
    """Address to which the firmware sends for the ground station."""
    stored: tuple[str, ...]
    """Names of the files with the firmware's parameters."""

    def __init__(self, scenario: Scenario, folder: Path) -> None:
        self.scenario, self.folder = scenario, folder
        self.aircraft = scenario.aircraft
        self._stack = contextlib.AsyncExitStack()

    @property
    @abstractmethod
    def physics_s(self) -> float:
        """The firmware's simulated time since its boot."""

    @abstractmethod
    def true_bias(self, instance: int, t_s: float) -> Bias:
        """Return the true bias of IMU `instance` (1..) of the firmware at an aircraft time."""

    @abstractmethod
    async def _open(self, stack: contextlib.AsyncExitStack) -> FirmwareProcess:
        """Open the back end and make the process, not started."""

    async def __aenter__(self) -> Self:
        """Start back end and binary, and wait until the firmware's simulated time advances."""
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            self.process = await self._open(self._stack)
            self._stack.push_async_callback(self.process.stop)
            await self.power_on()
        except BaseException:
            await self._stack.aclose()
            raise
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        await self._stack.aclose()

    async def power_on(self) -> None:
        """Start the binary with its stored state."""
        boots = self.backend.boots
        await self.process.start()
        await self.process.until(
            lambda: self.backend.boots > boots and self.physics_s > 1.0, BOOT_S, "a second of simulated flight"
        )

    async def power_off(self) -> None:
        await self.process.stop()

    async def power_cycle(self, off_s: float = 0.5) -> None:
        await self.power_off()
        await asyncio.sleep(off_s)
        await self.power_on()

    async def factory_reset(self) -> None:
        """Cut the power, delete the stored state, and start the firmware again."""
        await self.power_off()
        for name in self.stored:
            (self.folder / name).unlink(missing_ok=True)
        await self.power_on()

    async def sleep(self, seconds: float) -> None:
        """Wait for a time on the firmware's clock, which a busy machine slows down."""
        begun_s, starts = self.physics_s, self.backend.boots
        async with asyncio.timeout(SLOWEST * seconds + 1.0):
            while self.backend.boots == starts and self.physics_s - begun_s < seconds:
                await asyncio.sleep(0.05)

    @property
    def now_s(self) -> float:
        return self.aircraft.time_at(asyncio.get_running_loop().time())


class SitlVehicle(FirmwareVehicle):
    """A firmware on our physics: it lives on the scenario's aircraft, and its IMUs read what ours read."""

    samples: SampleBlocks
    """Samples that the back end sends."""
    imus: tuple[ImuModel, ...]
    """Models behind the back end."""

    def move(self, motions: Sequence[Motion]) -> None:
        """Add motions to the aircraft; they start at least 0.1 s from now (aircraft time, see `now_s`)."""
        for motion in motions:
            self.aircraft.add(motion)
