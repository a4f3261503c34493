"""Files of what was learned: alignments, armings, biases of each IMU, the time in our signatures."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

import msgspec

from companion.estimation.records import align_record, history
from companion.estimation.records.record import ArmingRecord
from companion.storage.state import BoundedList, StateFile


def alignment_in(directory: Path) -> StateFile[align_record.AlignmentRecord]:
    """Return the alignment, `alignment.json` in a storage directory."""
    kind, newest = align_record.AlignmentRecord, align_record.FORMAT_VERSION
    return StateFile(directory / "alignment.json", kind, align_record.check, newest)


def faces_in(directory: Path) -> StateFile[align_record.FacesRecord]:
    """Return the measurement of all sides, `faces.json` in a storage directory."""
    kind, newest = align_record.FacesRecord, align_record.FORMAT_VERSION
    return StateFile(directory / "faces.json", kind, align_record.check, newest)


class Done(msgspec.Struct, frozen=True, kw_only=True):
    """Outcome of one alignment."""

    what: str
    """"zero", "tilts", "turn", "level", "faces", or "gyro prediction" of version 0.1."""
    state: str
    """"done", "failed", or "predicted" of version 0.1."""
    measured_at: str
    reason: str
    system_id: int | None
    written: dict[str, float]
    """Values in the autopilot, by parameter."""
    undone_at: str | None = None


KEEP_DONE: Final = 50
KEEP_ARMINGS: Final = 200
"""A season of flying, below 100 kB at some 400 bytes each."""


def alignments_in(directory: Path) -> BoundedList[Done]:
    """Return the list of the latest alignments, `by-hand.json` in a storage directory."""
    return BoundedList(directory / "by-hand.json", Done, KEEP_DONE)


def armings_in(directory: Path) -> BoundedList[ArmingRecord]:
    """Return the list of the latest armings, `armings.json` in a storage directory."""
    return BoundedList(directory / "armings.json", ArmingRecord, KEEP_ARMINGS)


FORMAT_VERSION: Final = 2
KEEP_IMUS: Final = 8


class KnownImu(msgspec.Struct, frozen=True, kw_only=True):
    """Identity and points of one IMU, oldest first."""

    identity: dict[str, str]
    points: tuple[history.Point, ...] = ()


class _File(msgspec.Struct, frozen=True, kw_only=True):
    imus: dict[str, KnownImu]
    format_version: int = FORMAT_VERSION


class BiasStore:
    """`biases.json` in the storage directory."""

    def __init__(self, directory: Path) -> None:
        self._file: StateFile[_File] = StateFile(directory / "biases.json", _File, newest=FORMAT_VERSION)

    def read(self) -> dict[str, KnownImu]:
        """Read the IMUs; a file that cannot be used is set aside, since nothing depends on it."""
        found = self._file.load()
        return {} if found is None else found.imus

    def all(self) -> dict[str, KnownImu]:
        """Read the IMUs without setting aside anything.

        Raises:
            StorageError: it cannot be used.
        """
        found = self._file.read()
        return {} if found is None else found.imus

    def write(self, imus: dict[str, KnownImu]) -> None:
        """Write the latest IMUs.

        Raises:
            StorageError: it could not be written; what was there before still is.
        """
        latest = sorted(imus, key=lambda name: max((point.unix_s for point in imus[name].points), default=0.0))
        self._file.write(_File(imus={name: imus[name] for name in latest[-KEEP_IMUS:]}))


SIGNING_FILE: Final = "mavlink-signing-time.json"
MOST_UPTIME_S: Final = 3.2e9
_BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")


class SigningTime(msgspec.Struct, frozen=True):
    """Latest time in our signatures. Ticks are 10 us since 2015."""

    ticks: int
    reserved: int
    """Largest tick that may have been used before the next write."""
    uptime_s: float
    """Uptime of the board at the write."""
    boot_id: str
    """Boot of the board; empty: unknown."""


def this_boot() -> str:
    """Return the boot id of the running kernel; empty where it is unknown."""
    # The service's unit hides the file, and hands the id over instead.
    handed = os.environ.get("COMPANION_BOOT_ID", "")
    if handed:
        return handed.replace("-", "")
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip().replace("-", "")
    except OSError:
        return ""


def signing_time_in(directory: Path) -> StateFile[SigningTime]:
    """Return the signing time of a storage directory."""
    return StateFile(directory / SIGNING_FILE, SigningTime, _check_time)


def _check_time(found: SigningTime) -> None:
    if not 0 <= found.ticks <= found.reserved < 2**48 or not 0.0 <= found.uptime_s < MOST_UPTIME_S:
        raise msgspec.ValidationError(f"ticks {found.ticks} to {found.reserved} at {found.uptime_s:g} s cannot be")
