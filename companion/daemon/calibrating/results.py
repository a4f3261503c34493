"""What calibrations have found: the latest record, in memory and on disk, and what an undo makes of it."""

from __future__ import annotations

import datetime
import logging

import msgspec

from companion.calibration.solution.record import Record
from companion.component.statustext import Severity
from companion.daemon.calibrating.bias_memory import BiasMemory
from companion.daemon.core import Core
from companion.errors import StorageError
from companion.storage.records import RecordStore

logger = logging.getLogger(__name__)


class Results:
    """Keeps records, each with the readings that it was made of."""

    def __init__(self, core: Core, store: RecordStore, memory: BiasMemory) -> None:
        self._store, self._memory = store, memory
        self._collector, self._say, self._offload = core.collector, core.say, core.offload
        self.last: Record | None = None

    def load(self) -> None:
        """Find the latest one of those on disk; blocking."""
        try:
            self.last = next(iter(self._store.history(limit=1)), None)
        except StorageError as error:
            logger.warning("%s; the daemon goes on without earlier records", error)

    async def keep(self, record: Record, started_s: float, measured_s: tuple[float, float] | None) -> None:
        """Keep a record that is worth it; what cannot be kept is said."""
        self.last = record
        seen = self._collector.snapshot(started_s, measured_s)

        def save() -> None:
            try:
                trace = seen.trace(record.started_at)
            except Exception:
                # What is nice to look at later must not cost the record.
                logger.exception("the readings of this calibration cannot be kept")
                trace = None
            self._store.save(record, trace)

        try:
            if record.is_worth_keeping:
                await self._offload(save)
        except StorageError as error:
            logger.error("%s", error)  # noqa: TRY400 - the traceback tells nothing more
            self._say(Severity.WARNING, f"Record not kept: {error}")

    async def undone(self, system_id: int) -> None:
        """What the last calibration of this vehicle has written is in force no more."""
        now = datetime.datetime.now(tz=datetime.UTC).isoformat(timespec="milliseconds")
        last = self.last
        if last is not None and last.state == "done" and last.system_id == system_id:
            self.last = msgspec.structs.replace(last, undone_at=now) if has_written(last) else last
            await self._memory.forget(last.started_at)
        try:
            await self._offload(self._store.mark_undone, system_id, now)
        except StorageError as error:
            logger.error("the history does not show the undo: %s", error)  # noqa: TRY400 - one line


def has_written(record: Record) -> bool:
    """Whether anything of it has come into the autopilot."""
    return any(imu.written for imu in record.imus)
