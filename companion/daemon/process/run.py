"""The daemon as a process. SIGTERM and SIGINT end it in order, with old values restored and exit code 0.

SIGHUP is ignored: a companion run by hand goes on when its terminal closes.
"""

from __future__ import annotations

import asyncio
import faulthandler
import logging
import signal
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final

from companion import config
from companion.config.sections import Config
from companion.daemon.process import footprint
from companion.daemon.process.service import Service
from companion.daemon.process.supervisor import Supervisor
from companion.errors import CompanionError, ConfigError
from companion.links.system import logs
from companion.links.system.service_manager import ServiceManager
from companion.printable import printable
from companion.storage.profiles import saved_profile

logger = logging.getLogger(__name__)

SETTLED_AFTER_S: Final = 3.0
"""Time after which lazily imported modules (MQTT, recording, the page) are there."""


def main(path: str, *verbose: str) -> int:
    """Run the daemon with a configuration file until SIGTERM or SIGINT; return the command line's exit code."""
    # The watchdog's SIGABRT may be the only witness of a process that hangs: let it print where.
    faulthandler.enable()
    logs.set_up("debug" if verbose else "info")
    try:
        wanted = config.load(Path(path), partial(saved_profile, forgiving=True))
        if not verbose:
            logging.getLogger().setLevel(wanted.log.level.upper())
        asyncio.run(_run(wanted))
    except ConfigError as error:
        sys.stderr.write(printable(f"{error}") + "\n")
        return 2
    except CompanionError as error:
        sys.stderr.write(printable(f"companion: {error}") + "\n")
        return 1
    return 0


async def _run(wanted: Config) -> None:
    """Raises CompanionError where the daemon cannot start."""
    manager = ServiceManager.from_environment()
    try:
        await _Process(Service(wanted), manager).run()
    except BaseExceptionGroup as group:
        if (known := group.subgroup(CompanionError)) is None:
            raise
        raise CompanionError("; ".join(map(str, _leaves(known)))) from group
    finally:
        manager.close()


class _Process:
    def __init__(self, service: Service, manager: ServiceManager) -> None:
        self._service, self._manager = service, manager
        self._supervisor = Supervisor(service, manager)
        self._work: asyncio.Task[None] | None = None

    async def run(self) -> None:
        """Run until a signal or a fault."""
        loop = asyncio.get_running_loop()
        self._work = loop.create_task(self._service.run(self._manager.ready), name="service")
        watching = loop.create_task(self._supervisor.run(), name="supervisor")
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._stop, signal.Signals(number).name)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        settling = loop.call_later(SETTLED_AFTER_S, footprint.settle)
        try:
            await asyncio.wait([self._work, watching], return_when=asyncio.FIRST_COMPLETED)
        finally:
            settling.cancel()
            if not self._work.done() and not self._supervisor.stopping:
                self._work.cancel()
            await asyncio.wait([self._work])
            watching.cancel()
            await asyncio.wait([watching])
        if not self._work.cancelled():
            self._work.result()
        if not watching.cancelled():
            watching.result()
        logger.info("stopped")

    def _stop(self, why: str) -> None:
        if self._work is None or self._supervisor.stopping:
            # A second one must not cut off what the first one is putting in order.
            logger.warning("%s: stopping already; what was begun is put in order first", why)
            return
        logger.info("%s: stopping", why)
        self._supervisor.stop()
        self._work.cancel()


def _leaves(group: BaseExceptionGroup[Any]) -> Iterator[BaseException]:
    for error in group.exceptions:
        if isinstance(error, BaseExceptionGroup):
            yield from _leaves(error)
        else:
            yield error
