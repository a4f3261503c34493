"""What we changed in an autopilot: kept before the first write, so that it can be put back after any interruption.

`journal.json` exists only while a write is under way (found at start, it means that the daemon died in the middle);
`undo-N.json` holds the values before the last finished write on the vehicle with system id N.
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from companion.errors import StorageError
from companion.storage.atomic import remove_durably, write_atomically


class Changed(msgspec.Struct, frozen=True):
    """One parameter: the value before, the one we set, and the one that is set on the way between them, if any."""

    parameter: str
    before: float
    after: float | None
    """None: not known in advance, and whatever is found is of our doing (the firmware's own gyro calibration that we
    have started)."""
    via: float | None = None
    also: tuple[float, ...] = ()
    """Other values that may stand there by our doing, while several are set one after the other."""


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
    """The change files of one storage folder."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._probe = directory / "probe"
        self.journal = ChangeFile(directory / "journal.json")

    def undo_of(self, system_id: int) -> ChangeFile:
        """The values from before the last finished write on one vehicle."""
        return ChangeFile(self._directory / f"undo-{system_id}.json")

    def undos(self) -> dict[int, ChangeSet]:
        """By system id, what can be undone.

        Raises:
            StorageError: a file is there and cannot be understood.
        """
        found: dict[int, ChangeSet] = {}
        for path in sorted(self._directory.glob("undo-*.json")):
            kept = ChangeFile(path).read()
            if kept is not None:
                found[kept.system_id] = kept
        return found

    def check_writable(self) -> None:
        """Find out now, not at the first write, whether anything can be kept here.

        Raises:
            StorageError: it cannot.
        """
        write_atomically(self._probe, b"")
        remove_durably(self._probe)
