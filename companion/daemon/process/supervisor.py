"""Watches the long-lived tasks and feeds the service manager's watchdog while all go on.

A task that does not is logged with the place where it waits, before the manager ends the process.
"""

from __future__ import annotations

import asyncio
import logging
import types
from collections.abc import Mapping, Sequence
from typing import Any, Final, NamedTuple, Protocol

from companion.autopilot.telemetry import imu_stream
from companion.daemon.process.service import Service
from companion.links.serial import bytestream
from companion.links.system.service_manager import ServiceManager

logger = logging.getLogger(__name__)

PERIOD_S: Final = 1.0
FEEDS_PER_LIMIT: Final = 4.0
"""A manager that gives less time than the usual is fed so often within it: one feed may be late."""
MARGIN_S: Final = 2.0
COMPONENT_S: Final = 5.0
ESTIMATOR_S: Final = 10.0

AUTOMATIC_S: Final = 180.0
"""Deadline of what may have to read a dozen parameters over a bad radio link, each with all its retries."""


class Turning(Protocol):
    """Counts its turns."""

    turns: int


class Watched(NamedTuple):
    """A task that must go on."""

    name: str
    task: str
    within_s: float
    who: Turning


class Beats:
    """Tasks that go on, by their counted turns: a loop that turns proves nothing of a task that waits for ever.

    The age of a turn counts in calls of `update`: while the whole loop stands still nobody ages.
    """

    def __init__(self, watched: Sequence[Watched]) -> None:
        self._watched = watched
        self._last = {each.name: (each.who.turns, 0.0) for each in watched}

    def update(self, since_last_look_s: float) -> dict[str, float]:
        """Let time pass; the tasks that are overdue, and for how many seconds they have not gone on."""
        for each in self._watched:
            turns, (before, age_s) = each.who.turns, self._last[each.name]
            self._last[each.name] = (turns, age_s + since_last_look_s if turns == before else 0.0)
        return {each.name: age_s for each in self._watched if (age_s := self._last[each.name][1]) > each.within_s}


def watched_of(service: Service) -> list[Watched]:
    """The tasks of a service that must go on."""
    component, link, attitude = service.faces.component, service.core.link, service.heading.attitude
    readiness, automatic = service.arming.readiness, service.arming.automatic
    link_s = bytestream.BEAT_WITHIN_S + MARGIN_S
    return [
        Watched("MAVLink component", "component", COMPONENT_S, component),
        Watched("MAVLink connection", "mavlink", link_s, link),
        Watched("estimator", "readiness", ESTIMATOR_S, readiness),
        Watched("automatic calibration", "automatic", AUTOMATIC_S, automatic),
        *([] if attitude is None else [Watched("attitude", "attitude", ESTIMATOR_S, attitude)]),
        *(
            Watched(f"imu {name}", f"{name} telemetry", imu_stream.BEAT_WITHIN_S, imu.stream)
            for name, imu in service.devices.imus.items()
        ),
        *(Watched(f"sensor {sensor.name}", sensor.name, link_s, sensor.link) for sensor in service.devices.sensors),
    ]


class Supervisor:
    """Looks after a service's tasks; `run` it beside `Service.run`."""

    def __init__(self, service: Service, manager: ServiceManager) -> None:
        self._service, self._manager = service, manager
        watched = watched_of(service)
        self.beats = Beats(watched)
        self._tasks = {each.name: each.task for each in watched}
        self.stopping = False
        self._missed: set[str] = set()
        self._status_failed = False

    def stop(self) -> None:
        """The tasks are being ended from now on."""
        self.stopping = True
        self._manager.stopping()

    async def run(self) -> None:
        """Feed the watchdog and keep the status until cancelled."""
        loop = asyncio.get_running_loop()
        limit_s = self._manager.watchdog_s
        period_s = PERIOD_S if limit_s is None else min(PERIOD_S, limit_s / FEEDS_PER_LIMIT)
        before_s = loop.time()
        while True:
            # While the loop stood still nobody could report.
            overdue = self.beats.update(min(loop.time() - before_s, 2.0 * period_s))
            before_s = loop.time()
            if self.stopping:
                overdue = {}
            self._tell(overdue)
            if not overdue:
                self._manager.alive()
            self._manager.status(self._words(overdue))
            await asyncio.sleep(period_s)

    def _tell(self, overdue: dict[str, float]) -> None:
        for name, age_s in overdue.items():
            if name not in self._missed:
                self._missed.add(name)
                fed = "; the watchdog is not fed until it does" if self._manager.watchdog_s is not None else ""
                where = _where(self._tasks[name])
                logger.error("watchdog: %s has not gone on for %.0f s (%s)%s", name, age_s, where, fed)
        for name in self._missed - overdue.keys():
            self._missed.discard(name)
            if not self.stopping:
                logger.warning("watchdog: %s goes on again", name)

    def _words(self, overdue: dict[str, float]) -> str:
        if not self._manager.listens:
            return ""
        notes = ["stopping"] if self.stopping else []
        notes += [f"HUNG: {name}" for name in overdue]
        try:
            return "; ".join([*notes, status_line(self._service.status())])
        except Exception:
            # What merely describes the work must not end it.
            if not self._status_failed:
                logger.exception("the status cannot be worked out")
            self._status_failed = True
            return "; ".join([*notes, "the status cannot be worked out: see the log"])


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


def status_line(status: Mapping[str, Any]) -> str:
    """Return the status in one line for a pilot, most important first."""
    parts = [f"FAULT: {status['fault']}"] if status["fault"] is not None else []
    if status["putting_back"]:
        parts.append("an interrupted write is being put back")
    progress = "" if status["progress"] is None else f" {status['progress']} %"
    parts.append(f"{status['state']}{progress}" + (f", {status['reason']}" if status["reason"] else ""))
    parts.append(str(status["vehicle"]["summary"]))
    parts.append(f"in force: {status['arming']['in_force']}")
    devices = status["devices"]
    good = [device["name"] for device in devices if device["good"]]
    parts += [f"{device['name']}: {device['summary']}" for device in devices if not device["good"]]
    if good:
        parts.append(f"{', '.join(good)} good")
    return "; ".join(parts)
