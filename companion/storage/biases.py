"""What earlier calibrations found of each IMU: one small file, there whole or not at all."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Final

import msgspec

from companion.calibration.history import Point
from companion.errors import StorageError
from companion.storage.atomic import write_atomically

logger = logging.getLogger(__name__)

FORMAT_VERSION: Final = 1
KEEP_POINTS: Final = 40
"""Of each IMU: some 30 kB."""
KEEP_IMUS: Final = 8


class KnownImu(msgspec.Struct, frozen=True, kw_only=True):
    """One IMU: which sensor that was, and its points, oldest first."""

    identity: dict[str, str]
    points: tuple[Point, ...] = ()


class _File(msgspec.Struct, frozen=True, kw_only=True):
    imus: dict[str, KnownImu]
    format_version: int = FORMAT_VERSION


class BiasStore:
    """`biases.json` in the storage directory."""

    def __init__(self, directory: Path) -> None:
        self._path = directory / "biases.json"

    def read(self) -> dict[str, KnownImu]:
        """By IMU, what is kept; what cannot be read is logged in one line and begun anew, since nothing hangs on it."""
        try:
            found = msgspec.json.decode(self._path.read_bytes(), type=_File)
            if found.format_version != FORMAT_VERSION:
                raise msgspec.ValidationError(f"format {found.format_version}, known is {FORMAT_VERSION}")
        except FileNotFoundError:
            return {}
        except OSError as error:
            logger.warning(
                "%s: cannot be read: %s; goes on without earlier biases", self._path, error.strerror or error
            )
            return {}
        except (ValueError, msgspec.MsgspecError) as error:
            logger.warning("%s: not readable: %s; goes on without earlier biases", self._path, error)
            return {}
        return found.imus

    def write(self, imus: dict[str, KnownImu]) -> None:
        """Keep the latest points of the latest IMUs.

        Raises:
            StorageError: it could not be written; what was there before still is.
        """
        latest = sorted(imus, key=lambda name: max((point.unix_s for point in imus[name].points), default=0.0))
        kept = {
            name: msgspec.structs.replace(imus[name], points=imus[name].points[-KEEP_POINTS:])
            for name in latest[-KEEP_IMUS:]
        }
        try:
            data = msgspec.json.encode(_File(imus=kept))
        except (ValueError, msgspec.MsgspecError) as error:
            raise StorageError(f"{self._path}: cannot be written: {error}") from error
        write_atomically(self._path, data + b"\n")
