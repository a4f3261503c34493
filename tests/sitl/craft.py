"""One face for four autopilots: two doubles on virtual time, two real binaries on the real one."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import os
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import VirtualAircraft
from sim.ardupilot.double import ArduPilotDouble
from sim.earth import STANDARD_GRAVITY_M_S2, Array
from sim.firmware.compass import SimCompass
from sim.imu_model import Bias
from sim.motions import Motion
from sim.scenario import DEMO_POSE, Scenario, demo
from sim.sitl.ardupilot import ArduPilotSitl
from sim.sitl.ground import Firmware, GroundStation
from sim.sitl.process import BinaryError
from sim.sitl.px4 import Px4Sitl
from sim.sitl.residuals import ground_station
from sim.sitl.vehicle import SitlVehicle
from sim.station import End, open_udp
from tests.support.virtual_time import run_virtual
from tests.support.wire import Wire

T = TypeVar("T")

GYRO_DEG_H = (100.0, -60.0, 170.0)
ACCEL_MG = (1.0, -2.0, 3.0)
"""Case A of autopilots 9.3."""
SETTLE_S = 40.0
"""After a start of a binary: position found, first transients of the estimator over."""
SAVED_S = 3.0
"""Time in which PX4 stores written values (autopilots 8)."""
KINDS = ("ardupilot-double", "px4-double", "ardupilot-sitl", "px4-sitl")
BINARIES = {"ardupilot-sitl": "ARDUPILOT_SITL", "px4-sitl": "PX4_SITL"}


def world(motions: Sequence[Motion] = ()) -> Scenario:
    """The aircraft at 5/-3/40 deg with case A and white noise only."""
    return demo(
        pose=DEMO_POSE, part="white_only", gyro_deg_h=GYRO_DEG_H, accel_mg=ACCEL_MG, seed=1, unix_s=time.time(),
        motions=motions,
    )  # fmt: skip


class Craft(ABC):
    """A test's access to an autopilot on the aircraft."""

    firmware: Firmware
    real: bool
    aircraft: VirtualAircraft
    ground: GroundStation
    """On the ground-station link, as a ground station."""

    @property
    def url(self) -> str | None:
        """For a daemon in a process of its own; None where there are no sockets."""
        return None

    @abstractmethod
    def companion(self) -> contextlib.AbstractAsyncContextManager[GroundStation]:
        """A peer on the companion's link that says it is an onboard controller (191); close it to start a daemon."""

    @abstractmethod
    def true_bias(self, instance: int) -> Bias:
        """Bias of IMU `instance` now."""

    @abstractmethod
    async def reboot(self) -> None:
        """Power off and on; returns when it speaks again."""

    @property
    def now_s(self) -> float:
        return self.aircraft.time_at(asyncio.get_running_loop().time())

    def move(self, motion: Motion) -> None:
        """Let something happen that starts at least 0.1 s from now (aircraft time, `now_s`)."""
        self.aircraft.add(motion)

    def truth(self) -> Array:
        """Reading of a perfect IMU now: three rates (rad/s), three specific forces (m/s^2)."""
        return np.concatenate(self.aircraft.truth_at(self.now_s))

    def expected(self, instance: int) -> Array:
        """Truth and bias: what IMU `instance` reads now with no offsets set."""
        return self.truth() + np.concatenate(self.true_bias(instance))

    async def heartbeats(self, number: int = 2) -> None:
        since_s = asyncio.get_running_loop().time()
        await self.ground.wait_for(
            lambda: len(self.ground.vehicle_heartbeats(since_s)) >= number, 10.0 + number, "heartbeats"
        )


class DoubleCraft(Craft):
    """A double with wires in memory."""

    real = False

    def __init__(self, firmware: Firmware, scenario: Scenario) -> None:
        self.firmware, self.aircraft = firmware, scenario.aircraft
        self.models = scenario.flight_controller_imus
        self.double: Any
        if firmware == "ardupilot":
            parameters = {"INS_GYR_CAL": 0.0} | _tiny_offsets()
            compasses = [SimCompass() for _ in range(3)]  # as ArduPilot's own simulation has
            self.double = ArduPilotDouble(
                self.aircraft, self.models, parameters=parameters, compasses=compasses, seed=1, up_s=60.0
            )
        else:
            self.double = px4_double()(self.aircraft, self.models, seed=1, up_s=60.0)
        self.ground = GroundStation(firmware)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[DoubleCraft]:
        self.aircraft.begin(asyncio.get_running_loop().time())
        wire = Wire(self.ground, self.double.ground)
        tasks = [asyncio.create_task(self.double.run()), asyncio.create_task(self.ground.run())]
        await self.heartbeats(1)
        try:
            yield self
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            wire.unplug()

    @contextlib.asynccontextmanager
    async def companion(self) -> AsyncIterator[GroundStation]:
        station = _onboard(self.firmware, 1)
        wire = Wire(station, self.double)
        beating = asyncio.create_task(station.run())
        try:
            yield station
        finally:
            beating.cancel()
            await asyncio.gather(beating, return_exceptions=True)
            wire.unplug()

    def true_bias(self, instance: int) -> Bias:
        return self.models[instance - 1].true_bias(self.now_s)

    async def reboot(self) -> None:
        await asyncio.sleep(SAVED_S)
        self.double.reboot()
        await asyncio.sleep(2.0)
        await self.heartbeats(1)


class SitlCraft(Craft):
    """A binary, which lives as long as the test session."""

    real = True

    def __init__(self, vehicle: SitlVehicle, ground: GroundStation) -> None:
        self.vehicle, self.ground = vehicle, ground
        self.firmware, self.aircraft = vehicle.firmware, vehicle.aircraft

    @property
    def url(self) -> str:
        return self.vehicle.url

    @contextlib.asynccontextmanager
    async def companion(self) -> AsyncIterator[GroundStation]:
        station = _onboard(self.firmware, self.vehicle.system_id)
        host, port = self.vehicle.url.removeprefix("udpin:").rsplit(":", 1)
        end = await open_udp(_as_end(station), listen=(host, int(port)))
        beating = asyncio.create_task(station.run())
        try:
            await station.wait_for(lambda: bool(station.heard), 5.0, "a word on the companion's link")
            station.heartbeat(station.kind)
            yield station
        finally:
            beating.cancel()
            await asyncio.gather(beating, return_exceptions=True)
            end.close()

    def true_bias(self, instance: int) -> Bias:
        return self.vehicle.true_bias(instance, self.now_s)

    async def reboot(self) -> None:
        await asyncio.sleep(SAVED_S)
        await self.vehicle.power_cycle()
        await self.heartbeats(2)

    async def restart_clean(self) -> None:
        await self.vehicle.factory_reset()
        await self.heartbeats(2)
        await asyncio.sleep(SETTLE_S)


def _as_end(station: GroundStation) -> End:
    return station


def _onboard(firmware: Firmware, system_id: int) -> GroundStation:
    return GroundStation(
        firmware,
        system_id=system_id,
        component_id=191,
        kind=mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
        vehicle=system_id,
    )


def _tiny_offsets() -> dict[str, float]:
    """Offsets of the binary: calibrated, with negligible biases."""
    return {f"INS_ACC{imu}OFFS_{axis}": 1e-6 * STANDARD_GRAVITY_M_S2 for imu in ("", "2") for axis in "XYZ"}


def px4_double() -> Any:
    """The PX4 double's class.

    Raises:
        ModuleNotFoundError: this copy has none.
    """
    return importlib.import_module("sim.px4.double").PX4Double


async def hush(craft: Craft) -> None:
    """PX4's own background calibration would undo what a test writes; it goes away with a boot only."""
    if craft.firmware == "px4" and await craft.ground.get("IMU_GYRO_CAL_EN") == 1:
        await craft.ground.put("IMU_GYRO_CAL_EN", 0)
        await craft.ground.put("SENS_IMU_AUTOCAL", 0)
        await craft.reboot()


class Autopilot(ABC):
    """The fixture: gives a `Craft` to a coroutine and runs it to its end."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.firmware: Firmware = "px4" if kind.startswith("px4") else "ardupilot"
        self.real = kind.endswith("sitl")

    @abstractmethod
    def run(self, main: Callable[[Craft], Coroutine[Any, Any, T]], timeout_s: float = 120.0) -> T:
        """Run a test's body; `timeout_s` is real time."""


class DoubleAutopilot(Autopilot):
    """A new double for every run, on virtual time."""

    def run(self, main: Callable[[Craft], Coroutine[Any, Any, T]], timeout_s: float = 120.0) -> T:
        async def on_wires() -> T:
            async with DoubleCraft(self.firmware, world()).running() as craft:
                return await main(craft)

        return run_virtual(on_wires())


class SitlAutopilot(Autopilot):
    """One binary for all runs. It lives on an event loop in a thread, so that its physics goes on between tests."""

    def __init__(self, kind: str, folder: Path) -> None:
        super().__init__(kind)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name=kind, daemon=True)
        self._thread.start()
        self._stack = contextlib.AsyncExitStack()
        self._dirty = False
        try:
            self._craft = self._wait(self._start(folder), 120.0)
        except BaseException:
            self._end_loop()
            raise

    def run(self, main: Callable[[Craft], Coroutine[Any, Any, T]], timeout_s: float = 120.0) -> T:
        if self._dirty:
            self._wait(self._craft.restart_clean(), 180.0)
            self._dirty = False
        self._dirty = True
        result = self._wait(main(self._craft), timeout_s)
        self._dirty = False
        return result

    def close(self) -> None:
        try:
            self._wait(self._stack.aclose(), 20.0)
        finally:
            self._end_loop()

    async def _start(self, folder: Path) -> SitlCraft:
        vehicle = binary_vehicle(self.kind, folder)
        await self._stack.enter_async_context(vehicle)
        ground = await self._stack.enter_async_context(ground_station(vehicle))
        craft = SitlCraft(vehicle, ground)
        await craft.heartbeats(2)
        await asyncio.sleep(SETTLE_S)
        return craft

    def _wait(self, work: Coroutine[Any, Any, T] | Awaitable[T], timeout_s: float) -> T:
        async def bounded() -> T:
            async with asyncio.timeout(timeout_s):
                return await work

        return asyncio.run_coroutine_threadsafe(bounded(), self._loop).result(timeout_s + 30.0)

    def _end_loop(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(10.0)
        self._loop.close()


def binary_vehicle(kind: str, folder: Path, motions: Sequence[Motion] = (), **options: Any) -> SitlVehicle:
    """The binary that the environment names, on the world of these tests, not started.

    Raises:
        BinaryError: it is missing.
    """
    binary = Path(os.environ[BINARIES[kind]])
    if kind.startswith("px4"):
        etc = os.environ.get("PX4_SITL_ETC")
        return Px4Sitl(binary, world(motions), folder, etc=Path(etc) if etc else None, **options)
    return ArduPilotSitl(binary, world(motions), folder, **options)


def missing(kind: str) -> str | None:
    """Why there is no such autopilot here; None if there is."""
    if kind in BINARIES:
        path = os.environ.get(BINARIES[kind])
        return None if path else f"{BINARIES[kind]} is not set; it names the firmware's binary"
    if kind == "px4-double":
        try:
            px4_double()
        except ModuleNotFoundError as error:
            return f"no PX4 double in this copy ({error.name})"
    return None


__all__ = ["ACCEL_MG", "GYRO_DEG_H", "KINDS", "Autopilot", "BinaryError", "Craft"]
