"""The history of calibrations, one file a record."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from pathlib import Path

import msgspec

from companion.estimation.records.record import Record, from_json, to_json
from companion.storage.changes import ChangeSet
from companion.storage.state import (
    UNREADABLE,
    numbers_in,
    read_regular,
    sealed,
    unsealed,
    write_atomically,
)

logger = logging.getLogger(__name__)

# A record is some 6 kB: the whole history stays below 6 MB.
KEEP = 1000

_NAME = re.compile(r"(\d{6,})\.json")


class Entry(msgspec.Struct, frozen=True):
    """One file of the history: its record, or why it cannot be read."""

    number: int
    path: Path
    record: Record | None
    problem: str = ""


class RecordStore:
    """Records in `directory`/records, numbered in the order of their end: the wall clock may be wrong in the field."""

    def __init__(self, directory: Path) -> None:
        self._folder = directory / "records"

    def save(self, record: Record) -> Path:
        """Add a record; returns its file.

        Raises:
            StorageError: the record could not be written; nothing is half written.
        """
        numbers = numbers_in(self._folder, _NAME)
        number = numbers[-1] + 1 if numbers else 1
        path = self._path(number)
        write_atomically(path, sealed(to_json(record)))
        for old in [*numbers, number][:-KEEP]:
            self._remove(self._path(old))
        return path

    def entries(self) -> Iterator[Entry]:
        """All files of the history, newest first, read one by one.

        Raises:
            StorageError: the folder cannot be listed.
        """
        yield from map(self.entry, reversed(numbers_in(self._folder, _NAME)))

    def entry(self, number: int) -> Entry:
        """One of them."""
        path = self._path(number)
        try:
            return Entry(number, path, from_json(unsealed(read_regular(path))))
        except OSError as error:
            return Entry(number, path, None, error.strerror or str(error))
        except UNREADABLE as error:
            return Entry(number, path, None, f"not a readable record: {error}")

    def history(self, limit: int | None = None) -> list[Record]:
        """List the latest records, newest first; an unreadable file is logged and skipped."""
        return list(self.numbered(limit).values())

    def numbered(self, limit: int | None) -> dict[int, Record]:
        """Return the latest records by number, newest first; an unreadable file is logged and skipped."""
        records: dict[int, Record] = {}
        entries = self.entries()
        while (limit is None or len(records) < limit) and (entry := next(entries, None)) is not None:
            if entry.record is not None:
                records[entry.number] = entry.record
            else:
                logger.warning("%s: %s, passed over", entry.path, entry.problem)
        return records

    def mark_undone(self, step: ChangeSet, undone_at: str) -> list[str]:
        """Note in the records of what was written in this step that it was put back; returns when they had begun.

        Raises:
            StorageError: it could not be written.
        """
        found: list[tuple[Path, Record]] = []
        for entry in self.entries():
            record = entry.record
            if record is None or record.undone_at or record.state != "done" or record.system_id != step.system_id:
                continue
            if not (written := record.written):
                continue
            found.append((entry.path, record))
            if record.started_at == step.origin.first:
                break
            if not step.origin.first:
                # Of a version that did not keep whose the step was.
                if any(written.get(each.parameter) == each.after for each in step.changes):
                    break
                return []
        else:
            return []
        for path, record in found:
            write_atomically(path, sealed(to_json(msgspec.structs.replace(record, undone_at=undone_at))))
        return [record.started_at for _, record in found]

    @staticmethod
    def _remove(path: Path) -> None:
        """To make room; that it cannot be is logged: the new record matters more."""
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            logger.warning("%s: cannot be removed: %s", path, error.strerror or error)

    def _path(self, number: int) -> Path:
        return self._folder / f"{number:06d}.json"
