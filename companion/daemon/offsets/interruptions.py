"""Writes that were interrupted, and what became of their old values: for `companion history`."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Final

import msgspec

from companion.daemon.core import Offload, utc_now
from companion.errors import StorageError
from companion.formats import Object
from companion.storage.changes import ChangeSet
from companion.storage.state import BoundedList

logger = logging.getLogger(__name__)

KEEP: Final = 50
"""Interruptions kept: years of them."""
PENDING: Final = "old values not restored yet: disarm and keep the link up"


class Interruption(msgspec.Struct, frozen=True, kw_only=True):
    """One interrupted write."""

    what: str
    """Kind of write, as `Origin.what`."""
    began_at: str
    """Begin of the calibration or alignment that wrote, UTC, ISO 8601; empty: not kept."""
    ended_at: str | None
    """End of the restore, UTC, ISO 8601; None: pending."""
    system_id: int
    parameters: tuple[str, ...]
    reason: str
    """Result of the restore, for people."""


class Interruptions:
    """List of interruptions on disk, with the pending one in front."""

    def __init__(self, directory: Path, offload: Offload) -> None:
        self._file, self._offload = BoundedList(directory / "interrupted.json", Interruption, KEEP), offload

    async def keep(self, step: ChangeSet, reason: str) -> None:
        """Add an interruption that is over."""
        try:
            await self._offload(self._file.append, _interruption(step, reason, utc_now()))
        except StorageError as error:
            logger.error("the history does not show it: %s", error)  # noqa: TRY400 - one line

    def history(self, pending: ChangeSet | None) -> list[Object]:
        """All interruptions, the latest first; blocking. `pending`: the write whose restore is to come."""
        now = [] if pending is None else [_interruption(pending, PENDING, None)]
        return [msgspec.to_builtins(each) for each in (*now, *reversed(self._file.read()))]


def _interruption(step: ChangeSet, reason: str, ended_at: str | None) -> Interruption:
    origin = step.origin
    return Interruption(
        what=origin.what,
        began_at=origin.at,
        ended_at=ended_at,
        system_id=step.system_id,
        parameters=tuple(step.names),
        reason=reason,
    )
