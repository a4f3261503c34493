"""The daemon as a process: its subsystems on one event loop, its signals, and the watchdog of its long-lived tasks.

SIGTERM and SIGINT end the daemon with old values restored and exit code 0. SIGHUP is ignored: a daemon started in a
terminal continues when that closes. The service manager's watchdog is fed while all tasks make progress. A task that
hangs is logged with the place where it waits, before the manager ends the process.
"""

from __future__ import annotations

import asyncio
import ctypes
import dataclasses
import faulthandler
import gc
import logging
import signal
import sys
import types
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from companion import config as configuration
from companion import messages, summary
from companion.autopilot.telemetry import imu_stream
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
from companion.errors import CompanionError, ConfigError
from companion.formats import Object, printable
from companion.links.mavlink.link import MavlinkLink
from companion.links.mavlink.transport import run_transport
from companion.links.serial import bytestream
from companion.links.system.process import ServiceManager, set_up_logs
from companion.messages import message
from companion.storage.profiles import saved_profile
from companion.storage.state import only_daemon

if TYPE_CHECKING:
    from companion.daemon.interfaces.child import StartChild

logger = logging.getLogger(__name__)

SETTLED_WITHIN_S: Final = 20.0
"""Longest wait for MQTT: a small board needs seconds to start its process, and a silent broker is given up in 10 s."""
LISTEN_TURN_S: Final = 0.1
SETTLED_AFTER_S: Final = 3.0
"""Time after the start by which all lazily imported modules (recording, the child processes) are loaded."""
PERIOD_S: Final = 1.0
FEEDS_PER_LIMIT: Final = 4.0
"""Minimum number of watchdog feeds within the service manager's time limit: one feed can then be late."""
MARGIN_S: Final = 2.0
COMPONENT_S: Final = 5.0
ESTIMATOR_S: Final = 10.0
AUTOMATIC_S: Final = 180.0
"""Time limit for progress of a task that may read a dozen parameters over a bad radio link, each with all retries."""


class Service:
    """The daemon, made of subsystems; each subsystem uses only those created before it in `__init__`.

    `only_listening`: the reason for refusing every job in check mode. Tests pass `link`, `offload` and `child`.
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
        self._transport: Task = ("mavlink", partial(run_transport, core.link, config.mavlink.url))
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
        """Run until cancelled; call `on_ready` when the control socket answers. Raises CompanionError on failure."""
        for words in (*models.ineffective_settings(self.config), *models.doubtful_settings(self.config)):
            logger.warning("%s", words)
        control = self.config.control
        async with ControlServer(control.path, self.faces.answer, group=control.group_name):
            with only_daemon(self.config.storage.path):
                logger.info("ready: %s", control.path)
                on_ready()
                await self.serve()

    async def serve(self, *, mavlink: bool = True, ports: bool = True) -> None:
        """Run all tasks until cancelled, then finish or roll back a write; tests run without `mavlink` or `ports`."""
        for subsystem in (self.devices, self.offsets, self.calibrating):
            subsystem.load()
        tasks = [
            *self.faces.tasks(),
            *([self._transport] if mavlink else []),
            *self.devices.tasks(ports=ports),
            *self.offsets.tasks(),
            *self.calibrating.tasks(),
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
                    # Do this while the links are up: the heading selects its fallback, and a write finishes.
                    self.heading.close()
                    await self.calibrating.manager.close()
        finally:
            self.core.vehicle.close()

    async def listen(self, goes_on: Callable[[float], bool]) -> Object:
        """Open all connections, listen while `goes_on(seconds)` is true, and return the status; nothing is written.

        Time is counted in passes of the loop, `LISTEN_TURN_S` each, so a slow process listens longer.
        """
        self.devices.load()
        tasks = [self._transport, *self.faces.tasks(), *self.devices.tasks(), *self.arming.tasks()]
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
        return self.faces.all_status()


@dataclasses.dataclass(slots=True)
class WatchedTask:
    """Task that must make progress, shown by its counter `turns`: the event loop runs on even if a task hangs."""

    name: str
    task: str
    within_s: float
    who: Any  # Object with the count `turns`
    seen: int = 0
    age_s: float = 0.0
    """Time since the task's latest progress, summed up by `overdue`; a stop of the whole event loop does not count."""

    def overdue(self, passed_s: float) -> bool:
        before, self.seen = self.seen, self.who.turns
        self.age_s = self.age_s + passed_s if self.seen == before else 0.0
        return self.age_s > self.within_s


def watched_tasks(service: Service) -> list[WatchedTask]:
    link_s = bytestream.BEAT_WITHIN_S + MARGIN_S
    attitude = service.heading.attitude
    return [
        WatchedTask("MAVLink component", "component", COMPONENT_S, service.faces.component),
        WatchedTask("MAVLink connection", "mavlink", link_s, service.core.link),
        WatchedTask("estimator", "readiness", ESTIMATOR_S, service.arming.readiness),
        WatchedTask("automatic calibration", "automatic", AUTOMATIC_S, service.arming.automatic),
        *([] if attitude is None else [WatchedTask("attitude", "attitude", ESTIMATOR_S, attitude)]),
        *(
            WatchedTask(f"imu {name}", f"{name} telemetry", imu_stream.BEAT_WITHIN_S, imu.stream)
            for name, imu in service.devices.imus.items()
        ),
        *(WatchedTask(f"sensor {sensor.name}", sensor.name, link_s, sensor.link) for sensor in service.devices.sensors),
    ]


def main(path: str, *verbose: str) -> int:
    # At the watchdog's SIGABRT, print the place where the process hangs: there may be no other trace of it.
    faulthandler.enable()
    set_up_logs("debug" if verbose else "info")
    try:
        wanted = configuration.load(Path(path), partial(saved_profile, forgiving=True))
        if not verbose:
            logging.getLogger().setLevel(wanted.log.level.upper())
        messages.catalogue()  # load it now: later the file may be replaced by an update of the package
        asyncio.run(run(wanted))
    except ConfigError as error:
        sys.stderr.write(printable(f"{error}") + "\n")
        return 2
    except CompanionError as error:
        sys.stderr.write(printable(f"companion: {error}") + "\n")
        return 1
    return 0


async def run(wanted: Config) -> None:
    """Run the daemon until SIGTERM or SIGINT; raise CompanionError if it cannot start."""
    manager = ServiceManager.from_environment()
    try:
        await Supervisor(Service(wanted), manager).run()
    except BaseExceptionGroup as group:
        if (known := group.subgroup(CompanionError)) is None:
            raise
        raise CompanionError("; ".join(map(str, _leaves(known)))) from group
    finally:
        manager.close()


def _leaves(group: BaseExceptionGroup[Any]) -> Iterator[BaseException]:
    for error in group.exceptions:
        if isinstance(error, BaseExceptionGroup):
            yield from _leaves(error)
        else:
            yield error


class Supervisor:
    """Runs a service until a signal or a fault, and feeds the service manager's watchdog."""

    def __init__(self, service: Service, manager: ServiceManager) -> None:
        self._service, self._manager = service, manager
        self.watched = watched_tasks(service)
        self._work: asyncio.Task[None] | None = None
        self._stopping = False
        self._missed: set[str] = set()
        self._status_failed = False

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        self._work = work = loop.create_task(self._service.run(lambda: self._manager.notify("READY=1")), name="service")
        watching = loop.create_task(self._watch(), name="supervisor")
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._stop, signal.Signals(number).name)
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        settling = loop.call_later(SETTLED_AFTER_S, settle)
        try:
            await asyncio.wait([work, watching], return_when=asyncio.FIRST_COMPLETED)
        finally:
            settling.cancel()
            if not work.done() and not self._stopping:
                work.cancel()
            await asyncio.wait([work])
            watching.cancel()
            await asyncio.wait([watching])
        for task in (work, watching):
            if not task.cancelled():
                task.result()
        logger.info("stopped")

    def _stop(self, why: str) -> None:
        if self._work is None or self._stopping:
            # A second signal must not interrupt the orderly stop that the first one began.
            logger.warning("%s: %s", why, message("stops_already"))
            return
        logger.info("%s: stopping", why)
        self._stopping = True
        self._manager.notify("STOPPING=1")
        self._work.cancel()

    async def _watch(self) -> None:
        loop = asyncio.get_running_loop()
        limit_s = self._manager.watchdog_s
        period_s = PERIOD_S if limit_s is None else min(PERIOD_S, limit_s / FEEDS_PER_LIMIT)
        before_s = loop.time()
        while True:
            # Time for which the whole loop was stopped does not count against a task.
            passed_s = min(loop.time() - before_s, 2.0 * period_s)
            before_s = loop.time()
            overdue = [each for each in self.watched if each.overdue(passed_s) and not self._stopping]
            self._report(overdue)
            if not overdue:
                self._manager.notify("WATCHDOG=1")
            self._manager.status(self._words(overdue))
            await asyncio.sleep(period_s)

    def _report(self, overdue: Sequence[WatchedTask]) -> None:
        fed = "; if this lasts, systemd restarts the companion" if self._manager.watchdog_s is not None else ""
        for each in overdue:
            if each.name not in self._missed:
                where, age = _where(each.task), f"{each.age_s:.0f}"
                logger.error("watchdog: %s%s", message("task_hangs", task=each.name, seconds=age, where=where), fed)
        missed = {each.name for each in overdue}
        for name in () if self._stopping else self._missed - missed:
            logger.warning("watchdog: %s runs again", name)
        self._missed = missed

    def _words(self, overdue: Sequence[WatchedTask]) -> str:
        if not self._manager.listens:
            return ""
        notes = ["stopping"] if self._stopping else []
        notes += [f"HUNG: {each.name}" for each in overdue]
        try:
            status = self._service.status()
            rows = [row for row in summary.rows(status) if row[1] != "autopilot"]
            parts = [summary.headline(status), str(status["vehicle"]["summary"])]
            parts += [f"{name}: {words}" for verdict, name, words, _ in rows if verdict == "wrong"]
            if good := [name for verdict, name, _, _ in rows if verdict == "ok"]:
                parts.append(f"{', '.join(good)} good")
            return "; ".join([*notes, *parts])
        except Exception:
            # A fault in the status text must not end the daemon.
            if not self._status_failed:
                logger.exception("the status cannot be worked out")
            self._status_failed = True
            return "; ".join([*notes, message("daemon_internal_error")])


def _where(task_name: str) -> str:
    for task in asyncio.all_tasks():
        if task.get_name() == task_name:
            inner = task.get_coro()
            while isinstance(inner, types.CoroutineType) and isinstance(inner.cr_await, types.CoroutineType):
                inner = inner.cr_await
            if isinstance(inner, types.CoroutineType) and inner.cr_frame is not None:
                frame = inner.cr_frame
                return f"waits in {inner.__qualname__}, {frame.f_code.co_filename}:{frame.f_lineno}"
    return "its task has ended"


def settle() -> None:
    """Exclude all present objects from later garbage collections; call it once everything is imported."""
    gc.collect()
    gc.freeze()
    gc.enable()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
