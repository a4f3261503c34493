"""A short list on disk: the latest entries of one kind, in one file that is there whole or not at all."""

from __future__ import annotations

from pathlib import Path
from typing import Generic, TypeVar

import msgspec

from companion.storage.state import StateFile

T = TypeVar("T")


class _Entries(msgspec.Struct, Generic[T], frozen=True):
    entries: list[T]


class BoundedList(Generic[T]):
    """The latest `keep` entries, oldest first; one that cannot be used is set aside, since nothing hangs on it."""

    def __init__(self, path: Path, kind: type[T], keep: int) -> None:
        # Before there were checksums, the list was all there was.
        self._file: StateFile[_Entries[T] | list[T]] = StateFile(path, _Entries[kind] | list[kind])  # type: ignore[valid-type]
        self._keep = keep

    def read(self) -> list[T]:
        """The latest entries, for the daemon; a file that cannot be used counts as empty."""
        return _listed(self._file.take())[-self._keep :]

    def all(self) -> list[T]:
        """All entries, for whoever changes nothing.

        Raises:
            StorageError: the file cannot be used.
        """
        return _listed(self._file.read())

    def append(self, entry: T) -> None:
        """Add an entry.

        Raises:
            StorageError: it could not be written.
        """
        entries = [*self.read(), entry][-self._keep :]
        self._file.write(_Entries(entries))


def _listed(found: _Entries[T] | list[T] | None) -> list[T]:
    return found.entries if isinstance(found, _Entries) else found or []
