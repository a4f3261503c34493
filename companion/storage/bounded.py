"""A short list on disk: the latest entries of one kind, in one file that is there whole or not at all."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Generic, TypeVar

import msgspec

from companion.storage.atomic import write_atomically

logger = logging.getLogger(__name__)

T = TypeVar("T")


class BoundedList(Generic[T]):
    """The latest `keep` entries, oldest first; one that cannot be read begins anew, since nothing hangs on it."""

    def __init__(self, path: Path, kind: type[T], keep: int) -> None:
        self._path, self._kind, self._keep = path, kind, keep

    def read(self) -> list[T]:
        """All entries; an unreadable file is logged and counts as empty."""
        try:
            entries: list[T] = msgspec.json.decode(self._path.read_bytes(), type=list[self._kind])  # type: ignore[name-defined]
        except FileNotFoundError:
            return []
        except (OSError, msgspec.MsgspecError) as error:
            logger.warning("%s: cannot be read, begun anew: %s", self._path, error)
            return []
        return entries[-self._keep :]

    def append(self, entry: T) -> None:
        """Add an entry.

        Raises:
            StorageError: it could not be written.
        """
        entries = [*self.read(), entry][-self._keep :]
        write_atomically(self._path, msgspec.json.encode(entries) + b"\n")
