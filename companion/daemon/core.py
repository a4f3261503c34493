"""What every subsystem of the daemon stands on, and what each is to the service that runs it."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Mapping, Sequence
from typing import Any, Final

import msgspec

from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.component.statustext import Severity, StatusText, Weight
from companion.component.tunes import Tune, Tunes
from companion.config.sections import AtArm, Config
from companion.configured import models
from companion.configured.profiles import Profiles
from companion.estimation.collector.outlook import Settings
from companion.estimation.machine import Machine
from companion.estimation.means.windows import Window
from companion.estimation.solution.site import LocalEarth, local_earth
from companion.formats import Object
from companion.links.mavlink.link import MavlinkLink
from companion.links.system.listeners import Listeners

CATCH_UPS: Final = 3
"""While an estimate is worked out the next one may become due; it must not be left to the event loop."""
TICK_S: Final = 0.2
"""How often the seconds that are over end, also of sources that say nothing."""
Handler = Callable[[Object, str], AsyncIterator[Object]]
"""Answers a request that came by a face (second), with any number of replies."""
Task = tuple[str, Callable[[], Coroutine[Any, Any, None]]]
"""A name, and what runs under it until it is cancelled."""
Offload = Callable[..., Awaitable[Any]]
"""Runs a blocking call elsewhere: `asyncio.to_thread` in the daemon."""


class Wanted:
    """What the configuration says and a ground station may change, until the next start."""

    def __init__(self, config: Config) -> None:
        self.at_arm: AtArm = config.calibration.at_arm
        """What happens at arming."""
        self.push = config.push.parameters
        """Whether results are written to the autopilot."""
        self.tunes = config.component.tunes
        """Whether the autopilot's buzzer is used."""
        self.settings = models.settings(config)
        """How good is good enough."""
        self.on_retarget: Listeners[Settings] = Listeners()
        """Told when something else is good enough."""

    def switch(self, *, at_arm: AtArm | None = None, push: bool | None = None, tunes: bool | None = None) -> None:
        """Change what happens at arming, whether results are written, whether the buzzer is used."""
        self.at_arm = self.at_arm if at_arm is None else at_arm
        self.push = self.push if push is None else push
        self.tunes = self.tunes if tunes is None else tunes

    def retarget(self, **targets: float) -> None:
        """Change how good is good enough: `target_...` as in `Settings`."""
        self.settings = msgspec.structs.replace(self.settings, **targets)
        self.on_retarget.tell(self.settings)


class Core:
    """The configuration, the autopilot's link and the collector, which all subsystems share.

    A test brings a link that is on a wire of its own.
    """

    def __init__(self, config: Config, link: MavlinkLink | None, offload: Offload, only_listening: str | None) -> None:
        self.config, self.offload = config, offload
        self.only_listening = only_listening
        """Why nothing may be started although requests arrive: a check listens and must change nothing."""
        system_id = config.vehicle.system_id
        self.link = link or MavlinkLink(system_id=system_id or 1, component_id=config.mavlink.component_id)
        self.vehicle = Vehicle(self.link, system_id=system_id, is_carried=self._is_carried)
        self.parameters = ParameterClient(self.link, self.vehicle)
        self.profiles, self.collector, self.machine = Profiles(config), models.collector(config), Machine()
        self.on_tick: Listeners[[float]] = Listeners()
        """Notified of the time of every tick, before the collector."""
        self.wanted, self.texts = Wanted(config), StatusText(self.link)
        self.tunes = Tunes(self.link, self.vehicle, lambda: self.wanted.tunes, self.texts.woken)

    def _is_carried(self) -> bool:
        if self.vehicle.arm_state is ArmState.ARMED:
            return True
        return self.collector.glance(asyncio.get_running_loop().time()).moving

    async def local_earth(self) -> LocalEarth:
        """Gravity and the Earth's rate where it stands, as known now."""
        found: LocalEarth = await self.offload(local_earth, models.whereabouts(self.config, self.vehicle))
        return found

    async def keep_ticking(self) -> None:
        """Tell the collector the time until cancelled: the only one in the daemon who does."""
        while True:
            now_s = asyncio.get_running_loop().time()
            self.on_tick.tell(now_s)
            self.collector.tick(now_s)
            await asyncio.sleep(TICK_S)

    async def catch_up(self, *, since_s: float | None = None) -> None:
        """Let the collector know what its window holds by now, if that is not known yet.

        The estimate costs milliseconds on a desktop and tens of them on a small board; an autopilot that asks whether
        it may arm waits with its commander stopped (autopilots 5.2).
        """
        for _ in range(CATCH_UPS):
            work = self.collector.pending(asyncio.get_running_loop().time(), since_s=since_s)
            if work is None:
                return
            self.collector.accept(work, await self.offload(work.run))

    async def window(self, *, since_s: float | None = None) -> Window:
        """`RollingCollector.window` as of now.

        Raises:
            CalibrationRefusedError: as there.
        """
        await self.catch_up(since_s=since_s)
        return self.collector.window(asyncio.get_running_loop().time(), since_s=since_s)

    def say(self, severity: Severity, text: str, weight: Weight = Weight.NEWS) -> bool:
        """As `StatusText.say`: to the people at the ground stations."""
        return self.texts.say(severity, text[:1].upper() + text[1:], weight)

    def prompt(self, tune: Tune, text: str) -> None:
        """Tell whoever is at the aircraft what to do now: by the buzzer, and in words that are spoken."""
        self.tunes.play(tune)
        self.say(Severity.NOTICE, text)


class Subsystem:
    """A part of the daemon as the service sees it; each overrides what it has."""

    def load(self) -> None:
        """Read what was kept before this start, before anything runs; blocking."""

    def status(self) -> Object:
        """Its part of `companion status`, as JSON can hold it."""
        return {}

    def commands(self) -> Mapping[str, Handler]:
        """What it answers, by the name of the command."""
        return {}

    def tasks(self) -> Sequence[Task]:
        """What is to run for as long as the daemon does."""
        return ()


def joined(parts: Sequence[Object]) -> Object:
    """The status of several as one; lists under the same key follow each other."""
    whole: Object = {}
    for part in parts:
        for key, value in part.items():
            whole[key] = whole[key] + value if key in whole else value
    return whole
