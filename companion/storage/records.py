"""The history of calibrations, one file a record, and beside it what was seen on the way."""

from __future__ import annotations

import logging
import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import msgspec

from companion.errors import StorageError
from companion.estimation.collector import trace as traces
from companion.estimation.collector.trace import Trace
from companion.estimation.records.record import Record, from_json, to_json
from companion.storage.changes import ChangeSet
from companion.storage.state import (
    UNREADABLE,
    numbers_in,
    read_regular,
    remove_durably,
    sealed,
    unsealed,
    write_atomically,
)

logger = logging.getLogger(__name__)

# A record is some 6 kB: the whole history stays below 6 MB.
KEEP = 1000

# A trace is some 10 kB for a minute and two IMUs and never more than some 100 kB: usually 2 MB in all.
KEEP_TRACES = 200

MAX_TRACE_BYTES: Final = 4_000_000
"""The most bytes of a trace, unpacked; a larger one is not ours."""

_NAME = re.compile(r"(\d{6,})\.json")
_TRACE = re.compile(r"(\d{6,})\.trace\.json\.gz")
_GZIP: Final = 16 + zlib.MAX_WBITS


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

    def save(self, record: Record, trace: Trace | None = None) -> Path:
        """Add a record, and what was seen during it; returns its file.

        The trace goes first and carries the record's `started_at`, so that after a power cut a record never stands
        beside a trace of another one. That it cannot be written is logged: the record matters more.

        Raises:
            StorageError: the record could not be written; nothing is half written.
        """
        numbers = numbers_in(self._folder, _NAME)
        number = numbers[-1] + 1 if numbers else 1
        path, trace_path = self._path(number), self._trace_path(number)
        try:
            if trace is not None:
                write_atomically(trace_path, zlib.compress(traces.to_json(trace), wbits=_GZIP))
            elif trace_path.exists():
                # Left by a power cut before its record was written.
                remove_durably(trace_path)
        except StorageError as error:
            logger.warning("%s; the record is kept without it", error)
        write_atomically(path, sealed(to_json(record)))
        kept = [*numbers, number][-KEEP:]
        for old in numbers:
            if old < kept[0]:
                self._remove(self._path(old))
        with_trace = set(kept[-KEEP_TRACES:])
        for old in numbers_in(self._folder, _TRACE):
            if old not in with_trace:
                self._remove(self._trace_path(old))
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

    def trace(self, entry: Entry) -> Trace | None:
        """Read the trace of a calibration; None: nothing was kept.

        Raises:
            StorageError: it is there and cannot be read, or is another record's.
        """
        path = self._trace_path(entry.number)
        try:
            trace = traces.from_json(_unpacked(read_regular(path, MAX_TRACE_BYTES)))
        except FileNotFoundError:
            return None
        except OSError as error:
            raise StorageError(f"{path}: cannot be read: {error.strerror or error}") from error
        except (*UNREADABLE, zlib.error) as error:
            raise StorageError(f"{path}: not a readable trace: {error}") from error
        if entry.record is None or trace.started_at != entry.record.started_at:
            raise StorageError(f"{path}: belongs to the calibration of {trace.started_at}")
        return trace

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

    def _trace_path(self, number: int) -> Path:
        return self._folder / f"{number:06d}.trace.json.gz"


def _unpacked(data: bytes) -> bytes:
    unpacker = zlib.decompressobj(wbits=_GZIP)
    found = unpacker.decompress(data, MAX_TRACE_BYTES)
    if not unpacker.eof:
        raise ValueError("cut off" if not unpacker.unconsumed_tail else "too long")
    return found
