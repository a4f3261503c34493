"""The flights that were read from logs: `flights/000001.json` in the storage directory, numbered as they were read."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Final

import msgspec

from companion import formats
from companion.calibration.records.flight_record import FORMAT_VERSION, KeptFlight
from companion.errors import StorageError
from companion.storage.state import (
    MOST_BYTES,
    UNREADABLE,
    numbers_in,
    read_regular,
    remove_durably,
    sealed,
    unsealed,
    write_atomically,
)

logger = logging.getLogger(__name__)

KEEP: Final = 100
"""Of some 10 kB for each IMU."""
_NAME: Final = re.compile(r"(\d{6,})\.json")


class FlightStore:
    """The folder `flights` of a storage directory."""

    def __init__(self, directory: Path) -> None:
        self.folder = directory / "flights"

    def save(self, kept: KeptFlight) -> int:
        """Keep a flight, in the place of the same one read before; returns its number.

        Raises:
            StorageError: it could not be written; nothing is half written.
        """
        numbers = self.numbers()
        earlier = (number for number, one in self.newest().items() if one.flight.key == kept.flight.key)
        number = next(earlier, numbers[-1] + 1 if numbers else 1)
        try:
            data = sealed(msgspec.json.encode(kept))
            _from_json(data)
        except UNREADABLE as error:
            raise StorageError(f"{self._path(number)}: not written: {error}") from error
        # Who reads a log is root, and who tells of it the service, which has an account of its own.
        write_atomically(self._path(number), data, mode=0o644)
        for old in [each for each in numbers if each != number][: 1 - KEEP]:
            remove_durably(self._path(old))
        return number

    def newest(self, limit: int | None = None) -> dict[int, KeptFlight]:
        """The latest by their numbers, the newest first; one that cannot be read is logged and passed over.

        Raises:
            StorageError: the folder cannot be listed.
        """
        found: dict[int, KeptFlight] = {}
        for number in reversed(self.numbers()):
            if len(found) == limit:
                break
            try:
                found[number] = self.read(number)
            except StorageError as error:
                logger.warning("%s, passed over", error)
        return found

    def numbers(self) -> list[int]:
        """All that are there, ascending, whether they can be read or not.

        Raises:
            StorageError: the folder cannot be listed.
        """
        return numbers_in(self.folder, _NAME)

    def read(self, number: int) -> KeptFlight:
        """One of them.

        Raises:
            StorageError: there is none of that number, or it cannot be read.
        """
        path = self._path(number)
        try:
            return _from_json(read_regular(path))
        except OSError as error:
            raise StorageError(f"{path}: cannot be read: {error.strerror or error}") from error
        except UNREADABLE as error:
            raise StorageError(f"{path}: not a readable flight: {error}") from error

    def _path(self, number: int) -> Path:
        return self.folder / f"{number:06d}.json"


def _from_json(data: bytes) -> KeptFlight:
    if len(data) > MOST_BYTES:
        raise msgspec.ValidationError(f"more than {MOST_BYTES} bytes")
    found: KeptFlight = formats.decode(unsealed(data), KeptFlight, FORMAT_VERSION)
    return found
