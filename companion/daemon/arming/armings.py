"""What was in force each time the aircraft armed: said at once, and kept."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Iterable
from typing import Final

import msgspec

from companion.autopilot.vehicle.vehicle import VehicleEvent
from companion.component.statustext import Severity, Weight
from companion.daemon.arming.readiness import Readiness
from companion.daemon.core import Core
from companion.errors import StorageError
from companion.estimation.records.record import Arming, Record
from companion.formats import utc_now
from companion.storage.learned import armings_in

logger = logging.getLogger(__name__)

QUEUE: Final = 16


class Armings:
    """Watches for arming; `run` writes what was seen, off the loop."""

    def __init__(self, core: Core, readiness: Readiness) -> None:
        self._readiness, self._say, self._offload = readiness, core.say, core.offload
        self._file = armings_in(core.config.storage.path)
        self._queue: asyncio.Queue[Arming] = asyncio.Queue(QUEUE)
        self.last: Arming | None = None
        self.seen_disarmed = False
        """Else it may have started in flight."""
        core.vehicle.on_event.add(self._on_event)

    async def run(self) -> None:
        """Keep every arming until cancelled; what is still waiting then is written as well."""
        try:
            while True:
                arming = await self._queue.get()
                try:
                    await self._offload(self._file.append, arming)
                except StorageError as error:
                    logger.warning("arming not kept: %s", error)
        finally:
            while not self._queue.empty():
                with contextlib.suppress(StorageError):
                    self._file.append(self._queue.get_nowait())

    def _on_event(self, event: VehicleEvent) -> None:
        self.seen_disarmed |= event == "disarmed"
        if event != "armed" or not self.seen_disarmed:
            return  # a daemon that starts in flight sees no arming
        readiness, in_force = self._readiness, self._readiness.in_force
        now_s = asyncio.get_running_loop().time()
        state, words = readiness.state(now_s)
        calibrated_s, confirmed_s = in_force.calibrated_s, in_force.confirmed_s
        self.last = Arming(
            armed_at=utc_now(),
            state=state,
            reason=words,
            at_arm=readiness.at_arm,
            calibration=in_force.calibration.started_at if in_force.calibration is not None else None,
            calibrated_ago_s=None if calibrated_s is None else round(now_s - calibrated_s, 1),
            confirmed_ago_s=None if confirmed_s is None else round(now_s - confirmed_s, 1),
            gyro_sigma_use_rad_s=in_force.sigma("gyro"),
            accel_sigma_use_m_s2=in_force.sigma("accel"),
        )
        with contextlib.suppress(asyncio.QueueFull):
            self._queue.put_nowait(self.last)
        if readiness.at_arm != "off":
            uncalibrated = state == "uncalibrated"
            severity = Severity.WARNING if uncalibrated else Severity.NOTICE
            self._say(severity, f"Armed{' UNCALIBRATED' if uncalibrated else ''}: {words}", Weight.RESULT)

    def history(self) -> list[Arming]:
        """All kept armings, newest first; reads the disk."""
        return self._file.read()[::-1]


def with_armings(records: Iterable[Record], armings: Iterable[Arming]) -> list[Record]:
    """The records, each with the armings while it was in force, oldest first."""
    by_calibration: dict[str | None, list[Arming]] = {}
    for arming in armings:
        by_calibration.setdefault(arming.calibration, []).insert(0, arming)
    return [
        msgspec.structs.replace(record, armings=tuple(by_calibration.get(record.started_at, ()))) for record in records
    ]
