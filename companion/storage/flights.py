"""The flights that were read from logs: `flights/000001.json` in the storage directory, numbered as they were read."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Final

from companion.errors import StorageError
from companion.estimation.records.flight_record import FORMAT_VERSION, KeptFlight
from companion.storage.state import StateFile, numbers_in, remove_durably

logger = logging.getLogger(__name__)

KEEP: Final = 100
"""Flights kept, some 10 kB for each IMU."""
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
        self._file(number).write(kept)
        for old in [each for each in numbers if each != number][: 1 - KEEP]:
            remove_durably(self._file(old).path)
        return number

    def numbers(self) -> list[int]:
        """List all numbers, ascending, of unreadable files too.

        Raises:
            StorageError: the folder cannot be listed.
        """
        return numbers_in(self.folder, _NAME)

    def newest(self, limit: int | None = None) -> dict[int, KeptFlight]:
        """Return the latest by number, the newest first; an unreadable one is logged and skipped.

        Raises:
            StorageError: the folder cannot be listed.
        """
        found: dict[int, KeptFlight] = {}
        for number in reversed(self.numbers()):
            if len(found) == limit:
                break
            try:
                kept = self.read(number)
            except StorageError as error:
                logger.warning("%s, passed over", error)
            else:
                found |= {} if kept is None else {number: kept}
        return found

    def read(self, number: int) -> KeptFlight | None:
        """One of them, if there is one of that number.

        Raises:
            StorageError: it cannot be used.
        """
        return self._file(number).read()

    def _file(self, number: int) -> StateFile[KeptFlight]:
        # Who reads a log is root, and who tells of it the service, which has an account of its own.
        return StateFile(self.folder / f"{number:06d}.json", KeptFlight, newest=FORMAT_VERSION, mode=0o644)
