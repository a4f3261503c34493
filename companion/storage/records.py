"""The history of calibrations, one file a record."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import msgspec

from companion.calibration.record import Record, from_json, to_json
from companion.errors import StorageError
from companion.storage.atomic import write_atomically

logger = logging.getLogger(__name__)

# A record is some 6 kB: the whole history stays below 6 MB.
KEEP = 1000

_NAME = re.compile(r"(\d{6})\.json")


class RecordStore:
    """Records in `directory`/records, numbered in the order of their end: the wall clock may be wrong in the field."""

    def __init__(self, directory: Path) -> None:
        self._folder = directory / "records"

    def save(self, record: Record) -> Path:
        """Add a record; returns its file.

        Raises:
            StorageError: it could not be written; nothing is half written.
        """
        numbers = self._numbers()
        path = self._folder / f"{(numbers[-1] + 1 if numbers else 1):06d}.json"
        write_atomically(path, to_json(record) + b"\n")
        for number in numbers[: max(0, len(numbers) + 1 - KEEP)]:
            (self._folder / f"{number:06d}.json").unlink(missing_ok=True)
        return path

    def history(self, limit: int | None = None) -> list[Record]:
        """The latest records, newest first; a file that cannot be read is logged and passed over."""
        records: list[Record] = []
        for number in reversed(self._numbers()):
            if limit is not None and len(records) >= limit:
                break
            path = self._folder / f"{number:06d}.json"
            try:
                records.append(from_json(path.read_bytes()))
            except (OSError, msgspec.MsgspecError) as error:
                logger.warning("%s: not a readable record, passed over: %s", path, error)
        return records

    def mark_undone(self, system_id: int, undone_at: str) -> None:
        """Note in the latest record that has written to this vehicle that it was put back.

        Raises:
            StorageError: it could not be written.
        """
        for number in reversed(self._numbers()):
            path = self._folder / f"{number:06d}.json"
            try:
                record = from_json(path.read_bytes())
            except (OSError, msgspec.MsgspecError):
                continue
            wrote = record.state == "done" and any(imu.written for imu in record.imus)
            if wrote and record.system_id == system_id:
                write_atomically(path, to_json(msgspec.structs.replace(record, undone_at=undone_at)) + b"\n")
                return

    def _numbers(self) -> list[int]:
        try:
            names = [entry.name for entry in self._folder.iterdir()]
        except FileNotFoundError:
            return []
        except OSError as error:
            raise StorageError(f"{self._folder}: cannot be listed: {error.strerror}") from error
        return sorted(int(match[1]) for match in map(_NAME.fullmatch, names) if match)
