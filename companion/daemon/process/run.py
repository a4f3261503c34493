"""The daemon as a process: signals, and whoever started it.

SIGTERM and SIGINT end it in order: what runs is cancelled at its next safe point, old values are put back, and the
exit code is 0. SIGHUP reads the configuration file again.
"""

from __future__ import annotations

import asyncio
import logging
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from companion.config.sections import Config
from companion.daemon.process import footprint
from companion.daemon.process.reload import Reloader
from companion.daemon.process.service import Service
from companion.daemon.process.supervisor import Supervisor
from companion.errors import CompanionError
from companion.links.system.service_manager import ServiceManager

logger = logging.getLogger(__name__)

SETTLED_AFTER_S: Final = 3.0
"""By then what is imported only where it is used has been: MQTT, recording, the page."""


async def run(config: Config, path: Path) -> None:
    """Run the daemon until SIGTERM or SIGINT; on SIGHUP the file is read again.

    Raises:
        CompanionError: it cannot start.
    """
    manager = ServiceManager.from_environment()
    try:
        await _Process(Service(config), path, manager).run()
    except BaseExceptionGroup as group:
        known = group.subgroup(CompanionError)
        if known is None:
            raise
        raise CompanionError("; ".join(str(error) for error in _leaves(known))) from group
    finally:
        manager.close()


class _Process:
    """One run of the service."""

    def __init__(self, service: Service, path: Path, manager: ServiceManager) -> None:
        self._service, self._manager = service, manager
        self._supervisor = Supervisor(service, manager)
        self._reloader = Reloader(service, path, asyncio.to_thread)
        self._reload_wanted = asyncio.Event()
        self._work: asyncio.Task[None] | None = None

    async def run(self) -> None:
        """Run until a signal or a fault."""
        loop = asyncio.get_running_loop()
        self._work = loop.create_task(self._service.run(self._manager.ready), name="service")
        beside = [
            loop.create_task(self._supervisor.run(), name="supervisor"),
            loop.create_task(self._reload(), name="reload"),
        ]
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._stop, signal.Signals(number).name)
        loop.add_signal_handler(signal.SIGHUP, self._reload_wanted.set)
        settling = loop.call_later(SETTLED_AFTER_S, footprint.settle)
        try:
            await asyncio.wait([self._work, *beside], return_when=asyncio.FIRST_COMPLETED)
        finally:
            settling.cancel()
            if not self._work.done() and not self._supervisor.stopping:
                self._work.cancel()
            await asyncio.wait([self._work])
            for task in beside:
                task.cancel()
            ended = await asyncio.gather(*beside, return_exceptions=True)
        if not self._work.cancelled():
            self._work.result()
        for error in ended:
            if isinstance(error, Exception):
                raise error
        logger.info("stopped")

    def _stop(self, why: str) -> None:
        if self._work is None or self._supervisor.stopping:
            # A second one must not cut off what the first one is putting in order.
            logger.warning("%s: stopping already; what was begun is put in order first", why)
            return
        logger.info("%s: stopping", why)
        self._supervisor.stop()
        self._work.cancel()

    async def _reload(self) -> None:
        while True:
            await self._reload_wanted.wait()
            self._reload_wanted.clear()
            self._manager.reloading()
            try:
                self._supervisor.note(await self._reloader.reload())
            finally:
                self._manager.ready()


def _leaves(group: BaseExceptionGroup[Any]) -> Iterator[BaseException]:
    for error in group.exceptions:
        if isinstance(error, BaseExceptionGroup):
            yield from _leaves(error)
        else:
            yield error
