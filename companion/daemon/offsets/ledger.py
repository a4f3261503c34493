"""What was changed in the autopilot, in memory and on disk at once.

Open: a write is under way. Orphaned: a write was interrupted (the daemon died, or the old values could not all be
put back), and the recovery has to bring it to an end. Undoable: the last finished write on each vehicle.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator

from companion.autopilot.parameters.change import NothingWrittenError, WriteFailedError
from companion.autopilot.vehicle.vehicle import Firmware
from companion.daemon.core import Offload
from companion.errors import AutopilotError, StorageError
from companion.storage.changes import ChangeLog, ChangeSet


class Ledger:
    """The change files of one storage folder and what they say."""

    def __init__(self, log: ChangeLog, offload: Offload) -> None:
        self._log, self._offload = log, offload
        self.fault: str | None = None
        """Why nothing may be written at all, for people; None while all is well."""
        self._open: ChangeSet | None = None
        self._orphaned = asyncio.Event()
        self.undoable: dict[int, ChangeSet] = {}
        """By vehicle's system id."""
        self.unusable: tuple[str, ...] = ()
        """Files that were there and were set aside, each in a line; none of it was written anywhere."""
        self.lost_write = False
        """One of them was the journal: an interrupted write stays as it is."""

    @property
    def pending(self) -> bool:
        """Whether an interrupted write waits for the recovery."""
        return self._orphaned.is_set()

    def load(self) -> None:
        """Read the files at start, and find out whether they can be written; what cannot be used is set aside."""
        try:
            self._log.check_writable()
        except StorageError as error:
            self.fault = f"{error}; nothing can be kept, so nothing is written; mend it and restart the companion"
        journal, undos = self._log.journal, self._log.undos()
        self._open = journal.take()
        kept = [file.take() for file in undos]
        self.undoable = {each.system_id: each for each in kept if each is not None}
        self.unusable += tuple(file.unusable for file in (journal, *undos) if file.unusable is not None)
        self.lost_write |= journal.unusable is not None
        self._leave_to_recovery()

    async def interrupted(self) -> ChangeSet:
        """Wait until there is an interrupted write; it stays one until `undone`."""
        while self._open is None or not self.pending:
            await self._orphaned.wait()
        return self._open

    @contextlib.asynccontextmanager
    async def transaction(self, changes: ChangeSet, *, stepwise: bool = False) -> AsyncIterator[None]:
        """Around a write: what happens to one that is not finished is decided here and nowhere else.

        The old values are on disk before the block begins. It says itself how it ended, by `done` or `undone`; and a
        writer's error that has left nothing changed says that they are in force. After anything else (a value left
        changed, a cancellation, a fault of the program, no word at all) nobody knows what is, and the recovery looks.

        Args:
            changes: what the block will change, as far as it is known beforehand.
            stepwise: the block writes these values more than once, so that a write which has put back what it found
                has not put back what is kept here.

        Raises:
            AutopilotError: an earlier write is open still; do not write.
            StorageError: they could not be kept, or a name or a value is none that the companion writes; do not write.
        """
        if self._open is not None:
            raise AutopilotError("putting old values back first")
        await self.widen(changes)
        try:
            yield
        except (WriteFailedError, NothingWrittenError) as error:
            if not (error.left_changed or stepwise):
                with contextlib.suppress(StorageError):
                    await self.undone()
            raise
        finally:
            self._leave_to_recovery()

    def _leave_to_recovery(self) -> None:
        if self._open is not None:
            self._orphaned.set()

    async def widen(self, changes: ChangeSet) -> None:
        """In a transaction: keep this in the place of what was kept, before anything of it is overwritten.

        Raises:
            StorageError: as `transaction`; what was kept still is.
        """
        await self._offload(self._log.journal.write, changes)
        self._open = changes

    async def done(self, changes: ChangeSet) -> None:
        """The end of a transaction: the write stays, and from now on it can be undone.

        Raises:
            StorageError: the disk refuses; the write stays open.
        """
        kept = self._log.undo_of(changes.system_id)
        await self._offload(kept.write, changes)
        try:
            await self._close()
        except StorageError:
            # The write will be put back, so there will be nothing to undo.
            self.undoable.pop(changes.system_id, None)
            with contextlib.suppress(StorageError):
                await self._offload(kept.clear)
            raise
        self.undoable[changes.system_id] = changes

    async def undone(self) -> None:
        """The end of a transaction, or of an interrupted one: the old values are in force.

        Raises:
            StorageError: the disk refuses; the write stays open.
        """
        await self._close()

    async def _close(self) -> None:
        await self._offload(self._log.journal.clear)
        self._open = None
        self._orphaned.clear()

    def strange_to(self, firmware: Firmware | None, changes: ChangeSet) -> list[str]:
        """The parameters among them that we never write on this firmware."""
        return self._log.strange_to(firmware, changes)

    async def forget_undo(self, system_id: int) -> None:
        """What could be undone on a vehicle has been.

        Raises:
            StorageError: the disk refuses.
        """
        await self._offload(self._log.undo_of(system_id).clear)
        self.undoable.pop(system_id, None)
