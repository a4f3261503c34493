"""Watches the long-lived tasks and tells the service manager: alive, and what is being done.

The watchdog is fed only while the sensors', the autopilot's and the estimator's tasks all go on. Which one does not is
said in the log, with the place where it waits, before the manager ends the process and starts a fresh one.
"""

from __future__ import annotations

import asyncio
import logging
import types
from collections.abc import Callable
from typing import Final

from companion.autopilot.telemetry import imu_stream
from companion.daemon.process.beats import Beats
from companion.daemon.process.service import Service
from companion.daemon.process.status_line import status_line
from companion.links.serial import bytestream
from companion.links.system.service_manager import ServiceManager

logger = logging.getLogger(__name__)

PERIOD_S: Final = 1.0
FEEDS_PER_LIMIT: Final = 4.0
"""A manager that gives less time than the usual is fed so often within it: one feed may be late."""
MARGIN_S: Final = 2.0
COMPONENT_S: Final = 5.0
"""Its heartbeat is due every second."""
ESTIMATOR_S: Final = 10.0
"""A look is due every quarter of a second; a small board that solves a full window may take two."""

AUTOMATIC_S: Final = 180.0
"""It may have to read a dozen parameters over a bad radio link, each with all its retries."""


class Supervisor:
    """Looks after a service's tasks; `run` it beside `Service.run`."""

    def __init__(self, service: Service, manager: ServiceManager) -> None:
        self._service, self._manager = service, manager
        self.beats = Beats()
        self.note = ""
        """What stands before everything else in the status; empty: nothing."""
        self.stopping = False
        """The tasks are being ended: nobody is missed any more."""
        self._tasks: dict[str, str] = {}
        self._missed: set[str] = set()
        self._status_failed = False
        self._expect_all()

    def _expect_all(self) -> None:
        service, link_s = self._service, bytestream.BEAT_WITHIN_S + MARGIN_S
        service.faces.component.on_beat = self._expect("MAVLink component", "component", COMPONENT_S)
        service.core.link.on_beat = self._expect("MAVLink connection", "mavlink", link_s)
        service.arming.readiness.on_beat = self._expect("estimator", "readiness", ESTIMATOR_S)
        service.arming.automatic.on_beat = self._expect("automatic calibration", "automatic", AUTOMATIC_S)
        if service.heading.attitude is not None:
            service.heading.attitude.on_beat = self._expect("attitude", "attitude", ESTIMATOR_S)
        for imu in service.devices.imus.values():
            imu.stream.on_beat = self._expect(f"imu {imu.name}", f"{imu.name} telemetry", imu_stream.BEAT_WITHIN_S)
        for sensor in service.devices.sensors:
            sensor.link.on_beat = self._expect(f"sensor {sensor.name}", sensor.name, link_s)

    def _expect(self, name: str, task: str, within_s: float) -> Callable[[], None]:
        self._tasks[name] = task
        return self.beats.expect(name, within_s)

    async def run(self) -> None:
        """Feed the watchdog and keep the status until cancelled."""
        loop = asyncio.get_running_loop()
        limit_s = self._manager.watchdog_s
        period_s = PERIOD_S if limit_s is None else min(PERIOD_S, limit_s / FEEDS_PER_LIMIT)
        before_s = loop.time()
        while True:
            # While the loop stood still nobody could report.
            overdue = self.beats.look(min(loop.time() - before_s, 2.0 * period_s))
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
        notes = [self.note] if self.note else []
        if self.stopping:
            notes.append("stopping")
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
    """Where a task waits, for the log."""
    for task in asyncio.all_tasks():
        if task.get_name() == task_name:
            inner = task.get_coro()
            while isinstance(inner, types.CoroutineType) and isinstance(inner.cr_await, types.CoroutineType):
                inner = inner.cr_await
            if isinstance(inner, types.CoroutineType) and inner.cr_frame is not None:
                frame = inner.cr_frame
                return f"waits in {inner.__qualname__}, {frame.f_code.co_filename}:{frame.f_lineno}"
    return "its task has ended"
