"""Parts shared by all subsystems of the daemon, and the base class of a subsystem."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Mapping, Sequence
from typing import Any, Final

import msgspec

from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle, VehicleEvent
from companion.component.statustext import Severity, StatusText, Tune, Tunes, Weight
from companion.config.sections import AtArm, Config
from companion.configured import models
from companion.configured.models import Profiles
from companion.errors import AutopilotError
from companion.estimation.collector.intake import Settings
from companion.estimation.machine import Machine
from companion.estimation.means.windows import Window
from companion.estimation.solution.site import LocalEarth, local_earth
from companion.formats import Object
from companion.links.mavlink.link import MavlinkLink
from companion.links.system.events import Listeners

logger = logging.getLogger(__name__)

CATCH_UPS: Final = 3
"""Maximum number of evaluations of the measuring window in a row: while one runs, the next may become due."""
TICK_S: Final = 0.2
REREAD_EVERY_S: Final = 0.5
"""Minimum time between two reads of the autopilot: any station can announce a change and so cause a read."""
Handler = Callable[[Any, str], AsyncIterator[Object]]
"""Handler of a command: it gets the parsed `Command` and the name of the requesting interface, and yields replies."""
Task = tuple[str, Callable[[], Coroutine[Any, Any, None]]]
"""Name of a long-lived task, and the function that creates its coroutine, which runs until cancelled."""
Offload = Callable[..., Awaitable[Any]]
"""Function that runs a blocking call outside the event loop: `asyncio.to_thread` in the daemon."""


class RuntimeSettings:
    """Settings that a ground station can change at run time; they reset at restart."""

    def __init__(self, config: Config, retargeted: Callable[[Settings], object]) -> None:
        self.at_arm: AtArm = config.calibration.at_arm
        self.push, self.tunes = config.push.parameters, config.component.tunes
        self.settings = models.settings(config)
        self._retargeted = retargeted

    def switch(self, *, at_arm: AtArm | None = None, push: bool | None = None, tunes: bool | None = None) -> None:
        self.at_arm = self.at_arm if at_arm is None else at_arm
        self.push = self.push if push is None else push
        self.tunes = self.tunes if tunes is None else tunes

    def retarget(self, **targets: float) -> None:
        self.settings = msgspec.structs.replace(self.settings, **targets)
        self._retargeted(self.settings)


class RepeatedRead:
    """Calls a function at each autopilot start and each call of `again`; repeats it after an AutopilotError."""

    def __init__(self, vehicle: Vehicle, read: Callable[[], Awaitable[None]], retry_s: float) -> None:
        self._vehicle, self._read, self._retry_s = vehicle, read, retry_s
        self._due = asyncio.Event()
        self._due.set()
        self._pause_s = 0.0
        vehicle.on_event.add(self._on_event)

    def again(self, pause_s: float = 0.0) -> None:
        """Request another read because something has changed; after that read, wait `pause_s` before the next one."""
        self._pause_s = max(self._pause_s, pause_s)
        self._due.set()

    async def run(self) -> None:
        while True:
            await self._due.wait()
            await self._vehicle.found.wait()
            self._due.clear()
            try:
                await self._read()
            except AutopilotError as error:
                logger.debug("reading the autopilot again: %s", error)
                self._due.set()
                await asyncio.sleep(self._retry_s)
            else:
                pause_s, self._pause_s = self._pause_s, 0.0
                await asyncio.sleep(pause_s)

    def _on_event(self, event: VehicleEvent) -> None:
        if event in ("found", "rebooted"):
            self._due.set()


class Core:
    """Parts shared by all subsystems: configuration, autopilot link, sample collector and others; tests pass `link`."""

    def __init__(self, config: Config, link: MavlinkLink | None, offload: Offload, only_listening: str | None) -> None:
        self.config, self.offload = config, offload
        self.only_listening = only_listening
        """Reason for refusing every job in check mode, in which nothing may change; None in normal operation."""
        system_id = config.vehicle.system_id
        self.link = link or MavlinkLink(system_id=system_id or 1, component_id=config.mavlink.component_id)
        self.vehicle = Vehicle(self.link, system_id=system_id, is_carried=self._is_carried)
        self.parameters = ParameterClient(self.link, self.vehicle)
        self.profiles, self.collector, self.machine = Profiles(config), models.collector(config), Machine()
        self.on_tick: Listeners[[float]] = Listeners()  # Notified of every tick with its time, before the collector
        self.wanted, self.texts = RuntimeSettings(config, self._retarget), StatusText(self.link)
        self.tunes = Tunes(self.link, self.vehicle, lambda: self.wanted.tunes, self.texts.woken)

    def _is_carried(self) -> bool:
        if self.vehicle.arm_state is ArmState.ARMED:
            return True
        return self.collector.glance(asyncio.get_running_loop().time()).moving

    def _retarget(self, settings: Settings) -> None:
        if not self.machine.state.busy:  # the targets of a running calibration stay unchanged
            self.collector.retarget(settings)

    async def local_earth(self) -> LocalEarth:
        found: LocalEarth = await self.offload(local_earth, models.whereabouts(self.config, self.vehicle))
        return found

    async def keep_ticking(self) -> None:
        while True:
            now_s = asyncio.get_running_loop().time()
            self.on_tick.tell(now_s)
            self.collector.tick(now_s)
            await asyncio.sleep(TICK_S)

    async def catch_up(self, *, since_s: float | None = None) -> None:
        """Evaluate the measuring window if due; in a thread, as arming requests must not wait (autopilots.md, 5.2)."""
        for _ in range(CATCH_UPS):
            work = self.collector.pending(asyncio.get_running_loop().time(), since_s=since_s)
            if work is None:
                return
            self.collector.accept(work, await self.offload(work.run))

    async def window(self, *, since_s: float | None = None) -> Window:
        await self.catch_up(since_s=since_s)
        return self.collector.window(asyncio.get_running_loop().time(), since_s=since_s)

    def say(self, severity: Severity, text: str, weight: Weight = Weight.NEWS) -> bool:
        return self.texts.say(severity, text[:1].upper() + text[1:], weight)

    def prompt(self, tune: Tune, text: str) -> None:
        self.tunes.play(tune)
        self.say(Severity.NOTICE, text)


class Subsystem:
    """Base class of the daemon's parts, each with its stored data, status, commands and tasks."""

    def load(self) -> None:
        """Load stored data from disk before any task runs; blocking."""

    def status(self) -> Object:
        return {}

    def commands(self) -> Mapping[str, Handler]:
        return {}

    def tasks(self) -> Sequence[Task]:
        return ()


def joined(parts: Sequence[Object]) -> Object:
    whole: Object = {}
    for part in parts:
        for key, value in part.items():
            whole[key] = whole[key] + value if key in whole else value
    return whole
