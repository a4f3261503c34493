"""The records of calibrations, the latest at hand, each kept with the readings that it was made of."""

from __future__ import annotations

import logging

import msgspec

from companion.component.statustext import Severity
from companion.daemon.biases.memory import BiasMemory
from companion.daemon.core import Core
from companion.errors import StorageError
from companion.estimation.records.record import Record
from companion.formats import utc_now
from companion.storage.changes import ChangeSet
from companion.storage.records import RecordStore

logger = logging.getLogger(__name__)


class Results:
    """Keeps records, each with the readings that it was made of."""

    def __init__(self, core: Core, store: RecordStore, memory: BiasMemory) -> None:
        self._store, self._memory = store, memory
        self._collector, self._say, self._offload = core.collector, core.say, core.offload
        self.last: Record | None = None
        """What the latest calibration has found, or has been found before this start."""

    @property
    def good(self) -> Record | None:
        """The latest one, be it of before this start, if it was good and has not been undone."""
        return self.last if self.last is not None and self.last.state == "done" and not self.last.undone_at else None

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

    async def undone(self, step: ChangeSet) -> bool:
        """Note that what was written in this step is in force no more; whether it was of calibrations."""
        now = utc_now()
        try:
            marked: list[str] = await self._offload(self._store.mark_undone, step, now)
        except StorageError as error:
            logger.error("the history does not show the undo: %s", error)  # noqa: TRY400 - one line
            marked = [step.origin.at] if step.origin.at else []
        if self.last is not None and self.last.started_at in marked:
            self.last = msgspec.structs.replace(self.last, undone_at=now)
        await self._memory.forget(marked)
        return bool(marked or step.origin.what)
