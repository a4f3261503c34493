"""The daemon: all subsystems on one event loop, running until a signal."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from companion.config.sections import Config
from companion.configured import models
from companion.daemon.arming.subsystem import Arming
from companion.daemon.calibrating.subsystem import Calibrating
from companion.daemon.core import Core, Offload, Task
from companion.daemon.devices.subsystem import Devices
from companion.daemon.heading.subsystem import Heading
from companion.daemon.interfaces.control import ControlServer
from companion.daemon.interfaces.subsystem import Interfaces
from companion.daemon.offsets.subsystem import Offsets
from companion.daemon.recorder import Recorder
from companion.formats import Object
from companion.links.mavlink.link import MavlinkLink
from companion.links.mavlink.transport import run_transport
from companion.storage.state import only_daemon

if TYPE_CHECKING:
    from companion.daemon.interfaces.child import StartChild

logger = logging.getLogger(__name__)

SETTLED_WITHIN_S: Final = 20.0
"""A small board takes seconds to start the MQTT process, and a silent broker 10 s to be given up."""
LISTEN_TURN_S: Final = 0.1


class Service:
    """The daemon, subsystem by subsystem; each knows only those above it here.

    `only_listening`: reason to start and change nothing; `link`, `offload` and `child` are for tests.
    """

    def __init__(
        self,
        config: Config,
        *,
        link: MavlinkLink | None = None,
        offload: Offload = asyncio.to_thread,
        imu_rate_hz: float | None = None,
        only_listening: str | None = None,
        child: StartChild | None = None,
    ) -> None:
        self.config = config
        self.core = core = Core(config, link, offload, only_listening)
        self.devices = Devices(core, imu_rate_hz)
        self.offsets = Offsets(core, self.devices)
        self.calibrating = Calibrating(core, self.devices, self.offsets)
        self.arming = Arming(core, self.devices, self.offsets, self.calibrating)
        self.heading = Heading(core, self.devices, self.calibrating, self.arming)
        self.recorder = Recorder(core, self.devices, self.calibrating)
        self.faces = Interfaces(
            core, self.devices, self.offsets, self.calibrating, self.arming, self.heading, self.recorder, child
        )

    async def run(self, on_ready: Callable[[], object] = lambda: None) -> None:
        """Run until cancelled; `on_ready`: the control socket answers. Raise CompanionError where it cannot start."""
        for words in (*models.cannot_work(self.config), *models.doubtful(self.config)):
            logger.warning("%s", words)
        control = self.config.control
        async with ControlServer(control.path, self.faces.answer, group=control.group_name):
            with only_daemon(self.config.storage.path):
                logger.info("ready: %s", control.path)
                on_ready()
                await self.serve()

    async def serve(self, *, mavlink: bool = True, ports: bool = True) -> None:
        """Work until cancelled, then leave the autopilot in order; without `mavlink` or `ports` a test feeds bytes."""
        for subsystem in (self.devices, self.offsets, self.calibrating):
            subsystem.load()
        transport: list[Task] = [("mavlink", self._connect)] if mavlink else []
        tasks = [
            *self.faces.tasks(),
            *transport,
            *self.devices.tasks(ports=ports),
            *self.offsets.tasks(),
            *self.arming.tasks(),
            *self.heading.tasks(),
            *self.recorder.tasks(),
        ]
        try:
            async with asyncio.TaskGroup() as group:
                try:
                    for name, run in tasks:
                        group.create_task(run(), name=name)
                    await asyncio.get_running_loop().create_future()
                finally:
                    # While the links are up: the heading needs its fallback, a write under way its end.
                    self.heading.close()
                    await self.calibrating.manager.close()
        finally:
            self.core.vehicle.close()

    async def _connect(self) -> None:
        await run_transport(self.core.link, self.config.mavlink.url)

    async def listen(self, goes_on: Callable[[float], bool]) -> Object:
        """Open everything, listen while `goes_on` (seconds), and return the status; writes nothing.

        Seconds are turns of the event loop: a slow process listens longer.
        """
        self.devices.load()
        tasks = [("mavlink", self._connect), *self.faces.tasks(), *self.devices.tasks(), *self.arming.tasks()]
        running = [asyncio.get_running_loop().create_task(run(), name=name) for name, run in tasks]
        try:
            turns = 0
            while goes_on(turns * LISTEN_TURN_S):
                await asyncio.sleep(LISTEN_TURN_S)
                turns += 1
            await self.faces.settled(SETTLED_WITHIN_S)
            return self.status()
        finally:
            for task in running:
                task.cancel()
            await asyncio.gather(*running, return_exceptions=True)
            self.core.vehicle.close()

    def status(self) -> Object:
        """Return the daemon's status for JSON."""
        return self.faces.all_status()
