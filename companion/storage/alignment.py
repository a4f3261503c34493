"""The alignment in force: one file, whole or not there."""

from __future__ import annotations

from pathlib import Path

import msgspec

from companion.calibration.align_record import AlignmentRecord, from_json, to_json
from companion.errors import StorageError
from companion.storage.atomic import remove_durably, write_atomically


class AlignmentStore:
    """`alignment.json` in the storage directory."""

    def __init__(self, directory: Path) -> None:
        self._path = directory / "alignment.json"

    def read(self) -> AlignmentRecord | None:
        """What is kept, if anything.

        Raises:
            StorageError: the file is there and cannot be understood.
        """
        try:
            return from_json(self._path.read_bytes())
        except FileNotFoundError:
            return None
        except OSError as error:
            raise StorageError(f"{self._path}: cannot be read: {error.strerror or error}") from error
        except (ValueError, msgspec.MsgspecError) as error:
            raise StorageError(f"{self._path}: not a readable alignment: {error}") from error

    def write(self, record: AlignmentRecord) -> None:
        """Keep an alignment in the place of the one before.

        Raises:
            StorageError: it could not be written; the one before is still there.
        """
        write_atomically(self._path, to_json(record) + b"\n")

    def clear(self) -> None:
        """Keep none any more.

        Raises:
            StorageError: the file could not be removed.
        """
        remove_durably(self._path)
