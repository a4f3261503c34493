"""The whole daemon, all faces on, on a virtual aircraft; it can be killed at any instant and started again.

On top of `Rig`: devices behind `tcp://`, so that plugs can be pulled; a control socket; a disk and a wall clock that
can go wrong. Everything in one event loop on virtual time.
"""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import logging
import os
import random
import re
import shutil
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from companion.config import parse
from companion.daemon.interfaces.control import ControlServer
from companion.daemon.process.service import Service
from companion.estimation.machine import Event, State
from companion.links.mavlink.link import MavlinkLink
from sim.devices import Frame, SerialDevice, VectorNavBinary
from tests.campaign import loopback
from tests.campaign.clock import WallClock
from tests.campaign.disk import Disk
from tests.campaign.loop import OWNER, tasks_of
from tests.campaign.rough_wire import RoughWire
from tests.support.children import Idle
from tests.support.rig import Rig

IMU_RATE_HZ = 10.0
DEVICE_RATE_HZ = 5.0


class Variant(NamedTuple):
    """A kind of autopilot; they take turns by seed."""

    name: str
    options: dict[str, Any]


VARIANTS = (
    Variant("ArduPilot 4.8", {"version": "4.8"}),
    Variant(
        "PX4",
        {
            "firmware": "px4",
            "part": "bmi088",
            # Its own calibrations overwrite offsets that seem off, such as those of a write that was cut off: rightly,
            # but then nobody could tell whose value is whose.
            "parameters": {"IMU_GYRO_CAL_EN": 0.0, "SENS_IMU_AUTOCAL": 0.0},
        },
    ),
    Variant("ArduPilot 4.6", {"version": "4.6"}),
)


class Plug:
    """A device's end of a `tcp://` port: in, or out."""

    def __init__(self) -> None:
        self.port = loopback.new_port()
        self._server: asyncio.Server | None = None
        self._writers: list[asyncio.StreamWriter] = []
        self.heard = 0

    async def put_in(self) -> None:
        if self._server is None:
            self._server = await asyncio.start_server(self._accept, sock=loopback.listen(self.port))

    async def pull_out(self) -> None:
        if self._server is not None:
            self._server.close()
            self._server = None
        for writer in self._writers:
            writer.transport.abort()
        self._writers.clear()
        await asyncio.sleep(0)

    def say(self, data: bytes) -> None:
        self._writers = [writer for writer in self._writers if not writer.is_closing()]
        for writer in self._writers:
            if writer.transport.get_write_buffer_size() < 200_000:
                writer.write(data)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._writers.append(writer)
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(4096):
                self.heard += len(data)
        writer.close()


class Census(NamedTuple):
    """Counts that must not grow."""

    tasks: int
    handlers: int
    descriptors: int


class _Said(logging.Handler):
    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())
        del self.lines[:-2000]


class Stage(Rig):
    """One aircraft with a daemon that may die; `async with stage.running_all()`."""

    def __init__(self, root: Path, variant: Variant, *, seed: int, at_arm: str = "off", recordings_mb: int = 0) -> None:
        self.root = root
        self.store = root / "store1"
        self.plugs = {name: Plug() for name in ("gradienter", "compass", "own")}
        more = f'[control]\nsocket = "{root}/c1"\n'
        super().__init__(
            self.store,
            seed=seed,
            own_imu=True,
            min_still_s=2.0,
            max_s=8.0,
            imu_rate_hz=IMU_RATE_HZ,
            device_rate_hz=DEVICE_RATE_HZ,
            feed_s=0.25,
            at_arm=at_arm,
            recordings_mb=recordings_mb,
            more=more,
            **variant.options,
        )
        self.variant = variant
        self.text = re.sub(r"/nowhere/(\w+)", self._port_of, self.text)
        self.config = parse(self.text, "campaign.toml")
        self.devices["own"] = VectorNavBinary(self.own_model, rate_hz=IMU_RATE_HZ)
        self.chance = random.Random(seed)
        self.wire: RoughWire = RoughWire(self.link, self.autopilot, seed=seed)
        self.disk = Disk(root, self.chance)
        self.wall = WallClock()
        self.mangle: dict[str, Callable[[list[Frame]], bytes]] = {}
        """Functions that change the frames of a device under way, by device."""
        self.slow_disk_s = 0.0
        self.offload = self._elsewhere
        self.incarnation = 0
        self.alive = False
        self.on_start: Callable[[], None] = lambda: None
        """Called for every daemon before it runs."""
        self.entered: dict[State, asyncio.Event] = {state: asyncio.Event() for state in State}
        """Set when the calibration enters a state."""
        self.said = _Said()
        self._work: asyncio.Task[None] | None = None
        self._copies = 1

    def _port_of(self, match: re.Match[str]) -> str:
        name = {"imu": "own"}.get(match[1], match[1])
        return f"tcp://127.0.0.1:{self.plugs[name].port}"

    async def _elsewhere(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Run a function as in a thread: not at once."""
        await asyncio.sleep(self.chance.uniform(0.0002, 0.002) + self.slow_disk_s * self.chance.random())
        return function(*arguments)

    @contextlib.asynccontextmanager
    async def running_all(self) -> AsyncIterator[Stage]:
        """Everything on; at the end the daemon is stopped in order."""
        root_logger = logging.getLogger("companion")
        root_logger.addHandler(self.said)
        propagate, root_logger.propagate = root_logger.propagate, False
        with self.disk.mounted(), self.wall.worn():
            for plug in self.plugs.values():
                await plug.put_in()
            around = [
                asyncio.create_task(coroutine)
                for coroutine in (self.autopilot.run(), self._feed(), self._ground_heartbeat())
            ]
            try:
                self.start()
                await asyncio.sleep(0.01)
                yield self
            finally:
                await self.stop()
                for task in around:
                    task.cancel()
                await asyncio.gather(*around, return_exceptions=True)
                self.wire.unplug()
                self.radio.unplug()
                for plug in self.plugs.values():
                    await plug.pull_out()
                await asyncio.sleep(0.1)
                root_logger.removeHandler(self.said)
                root_logger.propagate = propagate

    # --- the daemon's life

    def start(self) -> None:
        self.incarnation += 1
        if self.incarnation > 1:
            self.text = re.sub(r'directory = ".*"', f'directory = "{self.store}"', self.text)
            self.text = re.sub(r'socket = ".*"', f'socket = "{self.root}/c{self.incarnation}"', self.text)
            self.config = parse(self.text, "campaign.toml")
            self.link = MavlinkLink()
            rough, self.wire = self.wire, RoughWire(self.link, self.autopilot, seed=self.incarnation)
            self.wire.__dict__.update(
                {name: getattr(rough, name) for name in ("loss", "duplicate", "cut", "reorder", "tear", "flip")}
                | {"late_s": rough.late_s, "change": rough.change, "seen": rough.seen}
            )
        context = contextvars.copy_context()
        context.run(OWNER.set, self.owner)
        self.wire.context = context.copy()
        self._work = context.run(asyncio.create_task, self._live(), name="daemon")
        self.alive = True

    @property
    def owner(self) -> str:
        return f"daemon {self.incarnation}"

    async def _live(self) -> None:
        self.service = Service(self.config, link=self.link, offload=self.offload, imu_rate_hz=IMU_RATE_HZ, child=Idle)
        machine = self.service.calibrating.manager._machine
        on = machine.on

        def watched(event: Event) -> State:
            state = on(event)
            self.entered[state].set()
            self.entered[state] = asyncio.Event()
            return state

        machine.on = watched  # type: ignore[method-assign]
        self.on_start()
        control = self.config.control
        async with ControlServer(control.path, self.service.faces.answer):
            await self.service.serve(mavlink=False)

    async def stop(self) -> None:
        if self._work is not None:
            self._work.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._work
        self.alive = False

    async def kill(self) -> None:
        """Kill as kill -9 and a power cut do: nothing more reaches the wire or the disk."""
        self.die()
        await self.bury()

    def die(self) -> None:
        """The instant itself: what is on the disk now is what the next daemon finds."""
        if not self.alive:
            return
        self.alive = False
        self.wire.unplug()
        self._copies += 1
        old, self.store = self.store, self.root / f"store{self._copies}"
        self.disk.snapshot(old, self.store)

    async def bury(self) -> None:
        """Get rid of what is left of a dead daemon."""
        for _ in range(200):
            left = tasks_of(self.owner)
            if not left:
                break
            for task in left:
                task.cancel()
            await asyncio.sleep(0.002)
        assert not tasks_of(self.owner), "a dead daemon's tasks do not end"
        shutil.rmtree(self.root / f"store{self._copies - 1}", ignore_errors=True)

    async def daemon_failed(self) -> BaseException | None:
        """Exception that has ended the daemon, if any."""
        if self._work is not None and self._work.done() and self.alive:
            return self._work.exception() or RuntimeError("the daemon has ended by itself")
        return None

    # --- looking at it

    def census(self) -> Census:
        handlers = sum(len(each) for each in self.link._handlers.values()) + len(self.service.core.vehicle.on_event)
        return Census(len(tasks_of(self.owner)), handlers, len(os.listdir("/proc/self/fd")))

    def words(self) -> Iterator[str]:
        """Yield every text that it shows at this moment."""
        status = self.service.status()
        yield from _strings(status)

    # --- around it

    async def _feed(self) -> None:
        for device in self.devices.values():
            device.power_on(self.aircraft.time_at(self.now_s))
        while True:
            await asyncio.sleep(self.feed_s)
            t_s = self.aircraft.time_at(self.now_s)
            for name, device in self.devices.items():
                frames = device.frames_until(t_s)
                mangle = self.mangle.get(name)
                data = b"".join(frame.data for frame in frames) if mangle is None else mangle(frames)
                if data and name not in self.unplugged:
                    self.plugs[name].say(data)

    async def ready(self) -> Stage:
        """Wait until the daemon knows the autopilot, its offsets, and hears its own devices."""

        def is_ready() -> bool:
            if not hasattr(self, "service"):
                return False
            imu = self.service.devices.imus["fc"]
            heard = all(sensor.link.bytes_received for sensor in self.service.devices.sensors)
            return imu.calibration is not None and imu.stream.samples > 0 and heard

        deadline_s = self.now_s + 30.0
        while not is_ready():
            assert self.now_s < deadline_s, f"not ready within 30 s: {list(self.words())}"
            await asyncio.sleep(0.05)
        return self

    def device(self, name: str) -> SerialDevice:
        return self.devices[name]


def _strings(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for each in value.values():
            yield from _strings(each)
    elif isinstance(value, list | tuple):
        for each in value:
            yield from _strings(each)
