"""The daemon as a process: signals, and whoever started it.

SIGTERM and SIGINT end it in order: what runs is cancelled at its next safe point, old values are put back, and the
exit code is 0. SIGHUP reads the configuration file again.
"""

from __future__ import annotations

import asyncio
import logging
import signal
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import msgspec

from companion.component.own_parameters import AT_ARM
from companion.config import load
from companion.config.sections import Config, Senders
from companion.config.words import shown
from companion.daemon.core import Offload
from companion.daemon.process import footprint
from companion.daemon.process.service import Service
from companion.daemon.process.supervisor import Supervisor
from companion.errors import CompanionError, ConfigError
from companion.links.system.service_manager import ServiceManager
from companion.storage.profiles import saved_profile

logger = logging.getLogger(__name__)

SETTLED_AFTER_S: Final = 3.0
"""By then what is imported only where it is used has been: MQTT, recording, the page."""
Apply = Callable[[Service, Any], None]


def _parameter(name: str, number: Callable[[Any], float] = float) -> Apply:
    """Of what a ground station can set as well: as if it had."""

    def apply(service: Service, value: Any) -> None:
        try:
            service.faces.component.parameters.change(name, number(value))
        except ValueError as error:
            logger.warning("%s; ground stations see the old value", error)

    return apply


RELOADABLE: Final[Mapping[str, Apply]] = {
    "calibration.target_gyro_sigma_deg_h": _parameter("CMP_GYR_TGT"),
    "calibration.target_accel_sigma_mg": _parameter("CMP_ACC_TGT"),
    "calibration.at_arm": _parameter("CMP_AT_ARM", AT_ARM.index),
    "push.parameters": _parameter("CMP_PUSH"),
    "component.tunes": _parameter("CMP_TUNES"),
    "push.stop_rivals": lambda service, value: service.offsets.rivalry.switch(stop_rivals=value),
    "mavlink.allow": lambda service, value: setattr(service.faces.component.permission, "senders", Senders(value)),
    "log.level": lambda _, value: logging.getLogger().setLevel(value.upper()),
}
"""What can change without a restart, and how."""


class Reloader:
    """Reads the file again and applies it."""

    def __init__(self, service: Service, path: Path, offload: Offload) -> None:
        self._service, self._path, self._offload = service, path, offload
        self._in_force = flat(service.config)

    async def reload(self) -> str:
        """Apply what the file says now; what came of it in one line, empty when all of it is in force."""
        try:
            new = flat(await self._offload(load, self._path, saved_profile))
        except ConfigError as error:
            logger.error("reload refused, the old configuration stays in force: %s", error)  # noqa: TRY400 - one line
            return f"reload refused: {error}"
        missing = object()
        old = self._in_force
        changed = [key for key in {**old, **new} if old.get(key, missing) != new.get(key, missing)]
        applied = [key for key in changed if key in RELOADABLE]
        for key in applied:
            RELOADABLE[key](self._service, new[key])
            logger.info("reloaded %s: %s = %s (was %s)", self._path, key, shown(new[key]), shown(old[key]))
            old[key] = new[key]
        rest = [key for key in changed if key not in RELOADABLE]
        if rest:
            words = f"restart to change {', '.join(rest)}"
            logger.warning("reloaded %s: %s (systemctl restart companion)", self._path, words)
            return words
        if not applied:
            logger.info("reloaded %s: nothing has changed", self._path)
        return ""


def flat(config: Config) -> dict[str, Any]:
    """Every setting by its key: `section.key`; a list of tables, or a section that is absent, is one setting."""
    found: dict[str, Any] = {}
    for section in config.__struct_fields__:
        value = getattr(config, section)
        if isinstance(value, msgspec.Struct):
            found.update({f"{section}.{key}": getattr(value, key) for key in value.__struct_fields__})
        elif value is not None:
            found[section] = value
    return found


async def run(config: Config, path: Path) -> None:
    """Run the daemon until SIGTERM or SIGINT; on SIGHUP the file is read again.

    Raises:
        CompanionError: it cannot start.
    """
    manager = ServiceManager.from_environment()
    try:
        await _Process(Service(config), path, manager).run()
    except BaseExceptionGroup as group:
        if (known := group.subgroup(CompanionError)) is None:
            raise
        raise CompanionError("; ".join(map(str, _leaves(known)))) from group
    finally:
        manager.close()


class _Process:
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
                self._supervisor.note = await self._reloader.reload()
            finally:
                self._manager.ready()


def _leaves(group: BaseExceptionGroup[Any]) -> Iterator[BaseException]:
    for error in group.exceptions:
        if isinstance(error, BaseExceptionGroup):
            yield from _leaves(error)
        else:
            yield error
