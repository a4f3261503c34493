"""What we changed in an autopilot: kept before the first write, so that it can be put back after any interruption.

Two files a folder: `journal.json` exists only while a write is under way (found at start, it means that the daemon
died in the middle), `undo.json` holds the values before the last finished write.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from companion.errors import StorageError
from companion.storage.atomic import remove_durably, write_atomically


class Changed(msgspec.Struct, frozen=True):
    """One parameter: the value before, and the one we set."""

    parameter: str
    before: float
    after: float


class ChangeSet(msgspec.Struct, frozen=True):
    """The changes of one calibration on one vehicle."""

    system_id: int
    changes: tuple[Changed, ...]


class ChangeFile:
    """One change set on disk, or none."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self) -> ChangeSet | None:
        """What is kept, if anything.

        Raises:
            StorageError: the file is there and cannot be understood.
        """
        try:
            return msgspec.json.decode(self._path.read_bytes(), type=ChangeSet)
        except FileNotFoundError:
            return None
        except (OSError, msgspec.MsgspecError) as error:
            raise StorageError(f"{self._path}: cannot be read: {error}") from error

    def write(self, changes: ChangeSet) -> None:
        """Keep a change set.

        Raises:
            StorageError: it could not be written.
        """
        write_atomically(self._path, msgspec.json.encode(changes) + b"\n")

    def clear(self) -> None:
        """Keep nothing any more.

        Raises:
            StorageError: the file could not be removed.
        """
        remove_durably(self._path)


class ChangeLog:
    """The two change files of one storage folder."""

    def __init__(self, directory: Path) -> None:
        self._probe = directory / "probe"
        self.journal = ChangeFile(directory / "journal.json")
        self.undo = ChangeFile(directory / "undo.json")

    def check_writable(self) -> None:
        """Find out now, not at the first write, whether anything can be kept here.

        Raises:
            StorageError: it cannot.
        """
        write_atomically(self._probe, b"")
        remove_durably(self._probe)
