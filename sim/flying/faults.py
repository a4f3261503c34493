"""What happens in the air: one row each."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from sim.devices import SerialDevice
from sim.flying.vehicle import FlyingVehicle
from sim.imu_model import ImuModel
from sim.sitl.ground import GroundStation
from sim.sitl.lossy_link import LossyLink

DRIFT_DEG_S = 3.0
LIE_DEG = 40.0
STEP_S = 0.05
POWERLESS_S = 20.0
RESTARTED_S = 1.0
"""What a service manager waits before it starts it anew."""


class Aloft(Protocol):
    """What a fault can get at."""

    vehicle: FlyingVehicle
    ground: GroundStation
    link: LossyLink

    @property
    def compass(self) -> SerialDevice:
        """The companion's."""

    @property
    def serial_imu(self) -> ImuModel:
        """The companion's."""

    def signal(self, number: signal.Signals) -> None:
        """To the daemon."""

    async def start_daemon(self) -> None:
        """Start it anew."""

    def in_background(self, work: Coroutine[Any, Any, None]) -> None:
        """Goes on until the end of the flight."""


async def _kill(on: Aloft) -> None:
    on.signal(signal.SIGKILL)


async def _stop(on: Aloft) -> None:
    on.signal(signal.SIGSTOP)


async def _cut(on: Aloft) -> None:
    on.link.loss = 1.0


async def _gyro_drifts(on: Aloft) -> None:
    gyro, accel = on.serial_imu.true_bias(on.vehicle.now_s)
    on.serial_imu.turn_on(gyro + np.radians([0.0, 0.0, DRIFT_DEG_S]), accel)


async def _compass_drifts(on: Aloft) -> None:
    async def drift() -> None:
        while True:
            _turn_compass(on, DRIFT_DEG_S * STEP_S)
            await asyncio.sleep(STEP_S)

    on.in_background(drift())


async def _compass_lies(on: Aloft) -> None:
    _turn_compass(on, LIE_DEG)


def _turn_compass(on: Aloft, degrees: float) -> None:
    device: Any = on.compass
    device.heading_error_deg += degrees


def _killed_for(seconds: float) -> Callable[[Aloft], Awaitable[None]]:
    async def strike(on: Aloft) -> None:
        on.signal(signal.SIGKILL)

        async def comes_back() -> None:
            await asyncio.sleep(seconds)
            await on.start_daemon()

        on.in_background(comes_back())

    return strike


async def _own_compass_lies(on: Aloft) -> None:
    await on.vehicle.lie_with_own_compass(on.ground)
    on.signal(signal.SIGKILL)


async def _nothing(on: Aloft) -> None:
    pass


@dataclass(frozen=True)
class Fault:
    """Something that happens in the air."""

    words: str
    strike: Callable[[Aloft], Awaitable[None]]


FAULTS = {
    "none": Fault("nothing happens", _nothing),
    "kill": Fault("kill -9 of the daemon", _kill),
    "stop": Fault("SIGSTOP: the daemon hangs", _stop),
    "cable": Fault("its cable to the autopilot is out", _cut),
    "gyro-drift": Fault(f"its gyro about z begins to read {DRIFT_DEG_S:g} deg/s too much", _gyro_drifts),
    "compass-drift": Fault(f"its compass turns by {DRIFT_DEG_S:g} deg/s", _compass_drifts),
    "compass-lies": Fault(f"its compass lies by {LIE_DEG:g} deg", _compass_lies),
    "own-compass": Fault("the autopilot's own compass is turned by 45 deg, and then kill -9", _own_compass_lies),
    "restart": Fault(f"kill -9 of the daemon, started anew after {RESTARTED_S:g} s", _killed_for(RESTARTED_S)),
    "board": Fault(f"its board has no power, and starts again after {POWERLESS_S:g} s", _killed_for(POWERLESS_S)),
}
