"""One flight: set up, calibrate, take off, then a fault while it holds its place in the wind."""

from __future__ import annotations

import asyncio
import contextlib
import shutil
import signal
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.companion_process import CompanionProcess
from sim.earth import Array
from sim.flying.ardupilot import FlyingArduPilot
from sim.flying.px4 import FlyingPx4
from sim.flying.vehicle import FlyingAircraft, FlyingVehicle
from sim.flying.verdict import Event, Record
from sim.scenario import demo, site_at
from sim.serve import configuration
from sim.sitl.daemon import READY_WITHIN_S, LossyLink, devices
from sim.sitl.ground import GroundStation
from sim.sitl.residuals import ground_station

SetUp = Literal["script", "command", "today", "px4"]
SET_UPS: dict[SetUp, str] = {
    "script": "all source sets, and the script",
    "command": "all source sets, no script",
    "today": "our heading and no other source set, no script",
    "px4": "of PX4, which sees to another heading by itself",
}
MORE = '\n[push]\nattitude = "yaw"\n[calibration]\nmin_still_s = 10\nmax_s = 15\nat_arm = "off"\n'
CALIBRATED_WITHIN_S = 120.0
PUSHED_WITHIN_S = 60.0
STARTED_S = 2.0
STORED_S = 3.0
"""Time in which PX4 saves written values."""
RESTARTED_S = 6.0
HEIGHT_M = 10.0
PLANE_HEIGHT_M = 60.0
SETTLED_S = 6.0
PLANE_SETTLED_S = 75.0
"""Time that the plane needs for a whole circle."""
WATCHED_S = 35.0
SLOWEST = 0.9
"""Smallest share of real time at which firmware and daemon still see the same world."""
HANGS_S = 0.3
"""A stall of the firmware of this length makes a flight invalid: the daemon cannot tell it from a fault."""
TURNS_AFTER_S, TURN_DEG = 12.0, 120.0
"""Time after the fault, and angle, at which the pilot turns the aircraft."""
DRIFT_DEG_S = 3.0
LIE_DEG = 40.0
STEP_S = 0.05
POWERLESS_S = 20.0
RESTARTED_AFTER_S = 1.0
"""Delay of a service manager before it restarts the daemon."""
OTHER_SETS = ("EK3_SRC2", "EK3_SRC3")
SCRIPT = Path(__file__).parents[2] / "companion" / "lua" / "companion_arming.lua"


@dataclass(frozen=True)
class Plan:
    binary: Path
    fault: str
    set_up: SetUp = "script"
    wind: tuple[float, float] = (5.0, 0.0)
    heading_deg: float = 40.0
    seed: int = 0
    watched_s: float = WATCHED_S
    stored: Path | None = None
    """Folder with the stored parameters of an autopilot that is set up: used if it exists, else filled."""


class Flight:
    """A vehicle, a daemon, and their events; made by `flying`."""

    def __init__(
        self, plan: Plan, vehicle: FlyingVehicle, ground: GroundStation, link: LossyLink, folder: Path
    ) -> None:
        self.plan, self.vehicle, self.ground, self.link, self.folder = plan, vehicle, ground, link, folder
        self.record = Record(plan.fault, plan.set_up, plan.wind)
        self._since_s = 0.0
        self._background: list[asyncio.Task[None]] = []
        self._hung_s = 0.0
        """Longest time without a state from the firmware since the watch began."""
        self._stack = contextlib.AsyncExitStack()
        self.daemon: CompanionProcess

    def signal(self, number: signal.Signals) -> None:
        """Send a signal to the daemon, if it runs."""
        with contextlib.suppress(ProcessLookupError):
            self.daemon.signal(number)

    async def start_daemon(self) -> None:
        """Start the daemon with its stored state."""
        log = self.folder / "daemon.log"
        if log.exists():
            log.rename(self.folder / "daemon-before.log")
        self.daemon = await self._stack.enter_async_context(CompanionProcess(self.folder))

    def in_background(self, work: Coroutine[Any, Any, None]) -> None:
        """Run a task until the end of the flight."""
        self._background.append(asyncio.create_task(work))

    async def close(self) -> None:
        for task in self._background:
            task.cancel()
        await asyncio.gather(*self._background, return_exceptions=True)
        self.signal(signal.SIGCONT)
        await self._stack.aclose()

    async def set_up(self) -> None:
        """Set the parameters of `companion autopilot params` from a ground station, and restart the autopilot.

        Does nothing for an autopilot that has them stored.
        """
        shown, stored = await self.daemon.ask("autopilot", "params"), self.plan.stored
        only_one = self.plan.set_up == "today"
        content = "not applied" if only_one else "applied"
        if stored is None or not stored.exists():
            wanted = {row["parameter"]: row["wanted"] for row in shown["parameters"] if row["wanted"] is not None}
            await self.ground.put_all(
                {n: value for n, value in wanted.items() if not (only_one and n.startswith(OTHER_SETS))}
            )
            if self.plan.set_up == "script":
                await self.ground.put("CMPG_ENABLE", 0.0)  # its other half, the gate, is not what flies here
            await self.vehicle.sleep(STORED_S)
            await self.vehicle.power_off()
            if stored is not None:
                stored.mkdir(parents=True)
                for name in self.vehicle.stored:
                    if (self.vehicle.folder / name).exists():
                        shutil.copy(self.vehicle.folder / name, stored)
            await self.vehicle.power_on()
            self._since_s = asyncio.get_running_loop().time()
            await self.vehicle.sleep(RESTARTED_S)
            shown = await self.daemon.ask("autopilot", "params")
        if shown["state"] != content:
            raise RuntimeError(f"autopilot-setup: {shown}")

    async def calibrate(self) -> None:
        """Calibrate, and wait until the heading is pushed."""
        record = await self.daemon.calibrate(CALIBRATED_WITHIN_S, progress=asyncio.subprocess.DEVNULL)
        if record["state"] != "done":
            raise RuntimeError(f"calibration: {record['reason']}")
        await self.pushed()

    async def pushed(self) -> None:
        """Wait until the heading is pushed, and until the estimator uses it again if it used another source."""
        attitude: dict[str, Any] = {}
        try:
            async with asyncio.timeout(PUSHED_WITHIN_S):
                while not (attitude.get("pushing") and is_ours(self._told())):
                    await asyncio.sleep(0.5)
                    attitude = (await self.daemon.ask("status"))["attitude"]
        except TimeoutError:
            raise TimeoutError(f"no heading is pushed, or it is not in use: {attitude}") from None

    def _told(self) -> list[str]:
        return [each.text for each in self.ground.all(mavlink.MAVLink_statustext_message, since_s=self._since_s)]

    async def fly(self) -> Record:
        """Take off, hold, trigger the fault, and watch; return the record."""
        vehicle, ground, record = self.vehicle, self.ground, self.record
        await vehicle.ask_streams(ground)
        self.in_background(vehicle.steer(ground))
        height_m = PLANE_HEIGHT_M if vehicle.is_plane else HEIGHT_M
        await vehicle.take_off(ground, height_m)
        await vehicle.hold(ground)
        await vehicle.sleep(PLANE_SETTLED_S if vehicle.is_plane else SETTLED_S)
        record.circle = vehicle.circle
        await self.pushed()
        begun_s, record.struck_s = asyncio.get_running_loop().time(), vehicle.truth.own_s
        self.in_background(self._watch())
        await FAULTS[self.plan.fault][1](self)
        await vehicle.sleep(TURNS_AFTER_S)
        await vehicle.turn(ground, TURN_DEG)
        await vehicle.sleep(self.plan.watched_s - TURNS_AFTER_S)
        speed = (vehicle.truth.own_s - record.struck_s) / (asyncio.get_running_loop().time() - begun_s)
        if speed < SLOWEST:
            raise RuntimeError(f"this machine is too slow: the firmware's clock ran at {speed:.2f} of the wall's")
        if self._hung_s > HANGS_S:
            raise RuntimeError(f"this machine is too slow: nothing moved for {self._hung_s:.1f} s")
        self._take_down()
        np.savez(self.folder / "record.npz", truth=record.truth, estimate=record.estimate, place=record.place)
        return record

    async def _watch(self) -> None:
        loop, truth = asyncio.get_running_loop(), self.vehicle.truth
        moved_s, own_s = loop.time(), truth.own_s
        while True:
            await asyncio.sleep(0.02)
            self._hung_s = max(self._hung_s, loop.time() - moved_s)
            if truth.own_s != own_s:
                moved_s, own_s = loop.time(), truth.own_s

    def _take_down(self) -> None:
        """Record what the truth and the ground station report."""
        ground, record = self.ground, self.record
        record.truth = np.array(self.vehicle.truth.recorded)
        attitudes = [
            (t_s, message)
            for t_s, message in ground.timed(mavlink.MAVLink_attitude_message, since_s=self._since_s)
            if message.get_srcComponent() == 1
        ]
        record.estimate = np.array([(m.time_boot_ms * 1e-3, m.yaw, 0.0) for _, m in attitudes])
        places = ground.all(mavlink.MAVLink_local_position_ned_message, since_s=self._since_s)
        record.place = np.array([(m.time_boot_ms * 1e-3, m.x, m.y, m.z) for m in places])
        arrived = np.array([t_s for t_s, _ in attitudes])
        record.events = events_of(ground, self._since_s, lambda t_s: _at(t_s, arrived, record.estimate[:, 0]))
        record.events += self.vehicle.source_changes()
        record.events.sort()


async def _kill(on: Flight) -> None:
    on.signal(signal.SIGKILL)


async def _stop(on: Flight) -> None:
    on.signal(signal.SIGSTOP)


async def _cut(on: Flight) -> None:
    on.link.loss = 1.0


async def _gyro_drifts(on: Flight) -> None:
    imu = on.vehicle.scenario.serial_imu
    gyro, accel = imu.true_bias(on.vehicle.now_s)
    imu.turn_on(gyro + np.radians([0.0, 0.0, DRIFT_DEG_S]), accel)


async def _compass_drifts(on: Flight) -> None:
    async def drift() -> None:
        while True:
            _turn_compass(on, DRIFT_DEG_S * STEP_S)
            await asyncio.sleep(STEP_S)

    on.in_background(drift())


async def _compass_lies(on: Flight) -> None:
    _turn_compass(on, LIE_DEG)


def _turn_compass(on: Flight, degrees: float) -> None:
    device: Any = on.vehicle.scenario.compass
    device.heading_error_deg += degrees


def _killed_for(seconds: float) -> Strike:
    async def strike(on: Flight) -> None:
        on.signal(signal.SIGKILL)

        async def comes_back() -> None:
            await asyncio.sleep(seconds)
            await on.start_daemon()

        on.in_background(comes_back())

    return strike


async def _own_compass_lies(on: Flight) -> None:
    await on.vehicle.lie_with_own_compass(on.ground)
    on.signal(signal.SIGKILL)


async def _nothing(on: Flight) -> None:
    pass


Strike = Callable[[Flight], Awaitable[None]]
FAULTS: dict[str, tuple[str, Strike]] = {
    "none": ("nothing happens", _nothing),
    "kill": ("kill -9 of the daemon", _kill),
    "stop": ("SIGSTOP: the daemon hangs", _stop),
    "cable": ("its cable to the autopilot is out", _cut),
    "gyro-drift": (f"its gyro about z begins to read {DRIFT_DEG_S:g} deg/s too much", _gyro_drifts),
    "compass-drift": (f"its compass turns by {DRIFT_DEG_S:g} deg/s", _compass_drifts),
    "compass-lies": (f"its compass lies by {LIE_DEG:g} deg", _compass_lies),
    "own-compass": ("the autopilot's own compass is turned by 45 deg, and then kill -9", _own_compass_lies),
    "restart": (f"kill -9 of the daemon, started anew after {RESTARTED_AFTER_S:g} s", _killed_for(RESTARTED_AFTER_S)),
    "board": (f"its board has no power, and starts again after {POWERLESS_S:g} s", _killed_for(POWERLESS_S)),
}
"""Description and action of each fault."""


def is_ours(texts: Sequence[str]) -> bool:
    """Return False if the latest text about the heading's source names a source other than ours."""
    told = [text for text in texts if text.startswith("Heading: ")]
    return not told or told[-1].startswith("Heading: companion")


def _at(t_s: float, arrived: Array, own: Array) -> float:
    return float(np.interp(t_s, arrived, own))


def events_of(ground: GroundStation, since_s: float, own: Callable[[float], float]) -> list[Event]:
    """Return the changes of mode, arming and source set, and the texts; `own` converts loop times to event times."""
    found, mode, armed = list[Event](), None, None
    for t_s, message in ground.heard:
        if t_s < since_s:
            continue
        if isinstance(message, mavlink.MAVLink_heartbeat_message) and message.get_srcComponent() == 1:
            now = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            if armed and not now:
                found.append(Event(own(t_s), "disarmed", ""))
            if mode is not None and message.custom_mode != mode:
                found.append(Event(own(t_s), "mode", str(message.custom_mode)))
            mode, armed = message.custom_mode, now
        elif isinstance(message, mavlink.MAVLink_statustext_message):
            found.append(Event(own(t_s), "text", message.text))
            if message.text.startswith("Heading: compass"):
                found.append(Event(own(t_s), "set", "2"))
            elif message.text.startswith("Heading: gyros"):
                found.append(Event(own(t_s), "set", "3"))
            elif message.text.startswith("Heading: companion"):
                found.append(Event(own(t_s), "set", "1"))
    return found


@contextlib.asynccontextmanager
async def flying(plan: Plan, folder: Path, unix_s: float) -> AsyncIterator[Flight]:
    """Run firmware, devices and daemon on the ground, without any set-up."""
    site = site_at(40.0, 116.0, 50.0, unix_s)
    aircraft = FlyingAircraft(site, heading_deg=plan.heading_deg, unix_s=unix_s)
    scenario = demo(seed=plan.seed, unix_s=unix_s, aircraft=aircraft)
    here = folder / "daemon"
    here.mkdir(parents=True)
    firmware, near_port, more = folder / "firmware", None, MORE
    px4 = None
    if plan.stored is not None and plan.stored.exists():
        shutil.copytree(plan.stored, firmware)
    if plan.set_up == "px4":
        px4 = FlyingPx4(plan.binary, scenario, firmware, wind=plan.wind, seed=plan.seed)
        near_port, more = px4.companion_port, MORE.replace("[push]", "[push]\nparameters = false")
    async with LossyLink(near_port=near_port) as link:
        vehicle: FlyingVehicle = px4 or FlyingArduPilot(
            plan.binary, scenario, firmware, companion=link.near, wind=plan.wind
        )
        if plan.set_up == "script":
            scripts = firmware / "scripts"
            scripts.mkdir(parents=True)
            (scripts / SCRIPT.name).write_bytes(SCRIPT.read_bytes())
        host, port = link.url.removeprefix("udpin:").rsplit(":", 1)
        text = configuration(scenario, directory=here, udp=(host, int(port)))
        (here / "companion.toml").write_text(text + more, encoding="utf-8")
        async with vehicle, ground_station(vehicle) as ground, devices(scenario, here):
            await ground.wait_for(lambda: bool(ground.vehicle_heartbeats()), 60.0, "a heartbeat")
            flight = Flight(plan, vehicle, ground, link, here)
            try:
                await flight.start_daemon()
                await vehicle.sleep(STARTED_S)
                await flight.daemon.ready(READY_WITHIN_S)
                yield flight
            finally:
                await flight.close()
