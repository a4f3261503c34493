"""What was changed in the autopilot, in memory and on disk at once.

Open: a write is under way. Orphaned: a write was interrupted (the daemon died, or the old values could not all be
put back) and somebody has to bring it to an end. Undoable: the last finished write on each vehicle.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable
from typing import Any

from companion.autopilot.vehicle import Firmware
from companion.errors import StorageError
from companion.storage.changes import ChangeLog, ChangeSet

Offload = Callable[..., Awaitable[Any]]
"""Runs a blocking call elsewhere: `asyncio.to_thread` in the daemon."""


class Ledger:
    """The change files of one storage folder and what they say."""

    def __init__(self, log: ChangeLog, offload: Offload) -> None:
        self._log, self._offload = log, offload
        self.fault: str | None = None
        """Why nothing may be written at all, for people; None while all is well."""
        self.open: ChangeSet | None = None
        self.undoable: dict[int, ChangeSet] = {}
        """By vehicle's system id."""
        self.unusable: tuple[str, ...] = ()
        """Files that were there and were set aside, each in a line; none of it was written anywhere."""
        self.lost_write = False
        """One of them was the journal: an interrupted write stays as it is."""
        self.orphaned = asyncio.Event()

    def load(self) -> None:
        """Read the files at start, and find out whether they can be written; what cannot be used is set aside."""
        try:
            self._log.check_writable()
        except StorageError as error:
            self.fault = f"{error}; nothing can be kept, so nothing is written; mend it and restart the companion"
        journal, undos = self._log.journal, self._log.undos()
        self.open = journal.take()
        kept = [file.take() for file in undos]
        self.undoable = {each.system_id: each for each in kept if each is not None}
        self.unusable += tuple(file.unusable for file in (journal, *undos) if file.unusable is not None)
        self.lost_write |= journal.unusable is not None
        if self.open is not None:
            self.orphaned.set()

    async def begin(self, changes: ChangeSet) -> None:
        """Keep the old values before the first of them is overwritten.

        Raises:
            StorageError: they could not be kept, or a name or a value is none that the companion writes; do not write.
        """
        await self._offload(self._log.journal.write, changes)
        self.open = changes

    async def commit(self, changes: ChangeSet) -> None:
        """The write is finished and stays: from now on it can be undone.

        Raises:
            StorageError: the disk refuses; the write stays open.
        """
        kept = self._log.undo_of(changes.system_id)
        await self._offload(kept.write, changes)
        try:
            await self.abandon()
        except StorageError:
            # The write will be put back, so there will be nothing to undo.
            self.undoable.pop(changes.system_id, None)
            with contextlib.suppress(StorageError):
                await self._offload(kept.clear)
            raise
        self.undoable[changes.system_id] = changes

    async def abandon(self) -> None:
        """The old values are in force again: nothing is open any more.

        Raises:
            StorageError: the disk refuses; the write stays open.
        """
        await self._offload(self._log.journal.clear)
        self.open = None
        self.orphaned.clear()

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
