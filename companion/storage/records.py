"""Numbered files of a storage directory: the calibrations in `records`, and the flights read from logs in `flights`."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, Final, Generic, TypeVar

import msgspec

from companion.errors import StorageError
from companion.estimation.records import flight_record, record
from companion.estimation.records.flight_record import KeptFlight
from companion.estimation.records.record import Record
from companion.storage.changes import ChangeSet
from companion.storage.state import StateFile, numbers_in

logger = logging.getLogger(__name__)

_NAME: Final = re.compile(r"(\d{6,})\.json")
T = TypeVar("T")


class NumberedFiles(Generic[T]):
    """Files `000001.json`, ... in a folder, in the order of their making: the wall clock may be wrong in the field."""

    name: ClassVar[str]
    """Name of the folder."""
    kind: ClassVar[Any]
    newest_format: ClassVar[int]
    keep: ClassVar[int]
    """Most files; the oldest make room."""
    mode: ClassVar[int] = 0o600

    def __init__(self, directory: Path) -> None:
        self.folder = directory / self.name

    def numbers(self) -> list[int]:
        """List all numbers, ascending, of unreadable files too.

        Raises:
            StorageError: the folder cannot be listed.
        """
        return numbers_in(self.folder, _NAME)

    def file(self, number: int) -> StateFile[T]:
        """Return the file of a number."""
        return StateFile(self.folder / f"{number:06d}.json", self.kind, newest=self.newest_format, mode=self.mode)

    def save(self, value: T) -> int:
        """Add a file; return its number.

        Raises:
            StorageError: it could not be written; nothing is half written.
        """
        numbers = self.numbers()
        number = numbers[-1] + 1 if numbers else 1
        self.file(number).write(value)
        for old in [*numbers, number][: -self.keep]:
            try:
                self.file(old).clear()
            except StorageError as error:
                logger.warning("%s", error)  # the new file matters more
        return number

    def latest(self) -> Iterator[tuple[int, T]]:
        """Yield numbers and contents, the newest first; an unreadable file is logged and skipped.

        Raises:
            StorageError: the folder cannot be listed.
        """
        for number in reversed(self.numbers()):
            try:
                found = self.file(number).read()
            except StorageError as error:
                logger.warning("%s, passed over", error)
            else:
                if found is not None:
                    yield number, found

    def newest(self, limit: int | None = None) -> dict[int, T]:
        """Return the latest by number, the newest first."""
        return dict(islice(self.latest(), limit))


class RecordStore(NumberedFiles[Record]):
    """Records of calibrations: some 6 kB each, the whole history below 6 MB."""

    name, kind, newest_format, keep = "records", Record, record.FORMAT_VERSION, 1000

    def history(self, limit: int | None = None) -> list[Record]:
        """List the latest records, newest first."""
        return list(self.newest(limit).values())

    def mark_undone(self, step: ChangeSet, undone_at: str) -> list[str]:
        """Note in the records of what was written in this step that it was put back; returns when they had begun.

        Raises:
            StorageError: it could not be written.
        """
        found: dict[int, Record] = {}
        for number, each in self.latest():
            if each.undone_at or each.state != "done" or each.system_id != step.system_id:
                continue
            if not (written := each.written):
                continue
            found[number] = each
            if each.started_at == step.origin.first:
                break
            if not step.origin.first:
                # Of a version that did not keep whose the step was.
                if any(written.get(changed.parameter) == changed.after for changed in step.changes):
                    break
                return []
        else:
            return []
        for number, each in found.items():
            self.file(number).write(msgspec.structs.replace(each, undone_at=undone_at))
        return [each.started_at for each in found.values()]


class FlightStore(NumberedFiles[KeptFlight]):
    """Flights read from logs: some 10 kB for each IMU."""

    name, kind, newest_format, keep = "flights", KeptFlight, flight_record.FORMAT_VERSION, 100
    mode = 0o644
    """Root reads the logs; the service, with an account of its own, reads the flights."""

    def save(self, value: KeptFlight) -> int:
        """Add a flight, or replace the same flight of an earlier reading; return its number."""
        for number, one in self.latest():
            if one.flight.key == value.flight.key:
                self.file(number).write(value)
                return number
        return super().save(value)
