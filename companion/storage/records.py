"""Files of results: records of calibrations and flights, and bias histories that later calibrations use.

Numbered files are in the folders `records` and `flights`. Other files hold alignments, armings, biases by IMU, and the
time of the last MAVLink signature.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, Final, Generic, TypeVar

import msgspec

from companion.errors import StorageError
from companion.estimation.records import align_record, flight_record, history, record
from companion.estimation.records.flight_record import KeptFlight
from companion.estimation.records.record import ArmingRecord, Record
from companion.formats import Object
from companion.storage.changes import ChangeSet, interruptions_in
from companion.storage.state import BoundedList, StateFile, numbers_in

logger = logging.getLogger(__name__)

_NAME: Final = re.compile(r"(\d{6,})\.json")
T = TypeVar("T")


class NumberedFiles(Generic[T]):
    """Folder of files `000001.json`, ..., numbered because the wall clock may be wrong in the field.

    Methods raise StorageError; no file is left half written.
    """

    name: ClassVar[str]  # Name of the folder
    kind: ClassVar[Any]
    newest_format: ClassVar[int]
    keep: ClassVar[int]  # most files in the folder; new ones replace the oldest
    mode: ClassVar[int] = 0o600

    def __init__(self, directory: Path) -> None:
        self.folder = directory / self.name

    def numbers(self) -> list[int]:
        """List the numbers of all files, ascending, unreadable ones included; raises StorageError."""
        return numbers_in(self.folder, _NAME)

    def file(self, number: int) -> StateFile[T]:
        return StateFile(self.folder / f"{number:06d}.json", self.kind, newest=self.newest_format, mode=self.mode)

    def save(self, value: T) -> int:
        """Save a value as the next file and return its number; delete the oldest above `keep`. Raises StorageError."""
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
        """Yield number and content of each readable file, the newest first."""
        for number in reversed(self.numbers()):
            try:
                found = self.file(number).read()
            except StorageError as error:
                logger.warning("%s, skipped", error)
            else:
                if found is not None:
                    yield number, found

    def newest(self, limit: int | None = None) -> dict[int, T]:
        return dict(islice(self.latest(), limit))


class RecordStore(NumberedFiles[Record]):
    """Folder of calibration records: some 6 kB each, at most 1000."""

    name, kind, newest_format, keep = "records", Record, record.FORMAT_VERSION, 1000

    def history(self, limit: int | None = None) -> list[Record]:
        return list(self.newest(limit).values())

    def mark_undone(self, step: ChangeSet, undone_at: str) -> list[str]:
        """Mark the records of an undone write as undone, at time `undone_at`; return their `started_at`."""
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
                # An earlier version wrote this step, without its origin.
                if any(written.get(changed.parameter) == changed.after for changed in step.changes):
                    break
                return []
        else:
            return []
        for number, each in found.items():
            self.file(number).write(msgspec.structs.replace(each, undone_at=undone_at))
        return [each.started_at for each in found.values()]


class FlightStore(NumberedFiles[KeptFlight]):
    """Folder of results of flights, read from the autopilot's logs: some 10 kB for each IMU."""

    name, kind, newest_format, keep = "flights", KeptFlight, flight_record.FORMAT_VERSION, 100
    mode = 0o644  # root reads the logs and writes flights; the service, under its own account, reads them

    def save(self, value: KeptFlight) -> int:
        """Save a flight, in place of an earlier result of the same flight if there is one; return the file's number."""
        for number, one in self.latest():
            if one.flight.key == value.flight.key:
                self.file(number).write(value)
                return number
        return super().save(value)


def alignment_in(directory: Path) -> StateFile[align_record.AlignmentRecord]:
    kind, newest = align_record.AlignmentRecord, align_record.FORMAT_VERSION
    return StateFile(directory / "alignment.json", kind, align_record.check, newest)


def faces_in(directory: Path) -> StateFile[align_record.FacesRecord]:
    kind, newest = align_record.FacesRecord, align_record.FORMAT_VERSION
    return StateFile(directory / "faces.json", kind, align_record.check, newest)


class Done(msgspec.Struct, frozen=True, kw_only=True):
    """Outcome of one alignment, during which somebody placed or turned the aircraft."""

    what: str  # "zero", "tilts", "turn", "level", "faces", "compass", or "gyro prediction" of version 0.1
    state: str  # "done", "failed", or "predicted" of version 0.1
    measured_at: str
    reason: str
    system_id: int | None
    written: dict[str, float]  # values in the autopilot, by parameter
    undone_at: str | None = None
    heading_sigma_deg: dict[str, float] = {}  # by compass


KEEP_DONE: Final = 50
KEEP_ARMINGS: Final = 200  # Most armings stored: a season of flying, 80 kB at some 400 bytes each


def alignments_in(directory: Path) -> BoundedList[Done]:
    return BoundedList(directory / "by-hand.json", Done, KEEP_DONE)


def armings_in(directory: Path) -> BoundedList[ArmingRecord]:
    return BoundedList(directory / "armings.json", ArmingRecord, KEEP_ARMINGS)


def stored_history(directory: Path, limit: int | None) -> Object:
    """Read what `companion history` shows, the newest first, without files and folders that cannot be read.

    `in_force` of alignments is unknown without the autopilot.
    """
    armings = _readable(armings_in(directory).all)[::-1]
    by_calibration: dict[str | None, list[ArmingRecord]] = {}
    for arming in reversed(armings):
        by_calibration.setdefault(arming.calibration, []).append(arming)
    records = dict(_readable(lambda: list(RecordStore(directory).newest(limit).items())))
    shown = [
        msgspec.structs.replace(record, armings=tuple(by_calibration.get(record.started_at, ())))
        for record in records.values()
    ]
    flights = _readable(lambda: list(FlightStore(directory).newest(limit).items()))
    by_hand = _readable(alignments_in(directory).all)[::-1][:limit]
    return {
        "numbers": list(records),
        "records": msgspec.to_builtins(shown),
        "armings": msgspec.to_builtins(armings[:limit]),
        "by_hand": [{**msgspec.to_builtins(done), "in_force": None} for done in by_hand],
        "interrupted": msgspec.to_builtins(_readable(interruptions_in(directory).all)[::-1][:limit]),
        "flights": [msgspec.to_builtins(kept) | {"number": number} for number, kept in flights],
    }


def _readable(read: Callable[[], list[T]]) -> list[T]:
    try:
        return read()
    except StorageError as error:
        logger.warning("%s", error)
        return []


BIASES_VERSION: Final = 2
KEEP_IMUS: Final = 8


class KnownImu(msgspec.Struct, frozen=True, kw_only=True):
    identity: dict[str, str]
    points: tuple[history.Point, ...] = ()  # oldest first


class _File(msgspec.Struct, frozen=True, kw_only=True):
    imus: dict[str, KnownImu]
    format_version: int = BIASES_VERSION


class BiasStore:
    """Bias histories of all IMUs: `biases.json` in the storage directory."""

    def __init__(self, directory: Path) -> None:
        self._file: StateFile[_File] = StateFile(directory / "biases.json", _File, newest=BIASES_VERSION)

    def read(self) -> dict[str, KnownImu]:
        """Read the bias histories of all IMUs; an unusable file is set aside and counts as empty."""
        found = self._file.load()
        return {} if found is None else found.imus

    def all(self) -> dict[str, KnownImu]:
        """Read the bias histories of all IMUs; raises StorageError for an unusable file."""
        found = self._file.read()
        return {} if found is None else found.imus

    def write(self, imus: dict[str, KnownImu]) -> None:
        latest = sorted(imus, key=lambda name: max((point.unix_s for point in imus[name].points), default=0.0))
        self._file.write(_File(imus={name: imus[name] for name in latest[-KEEP_IMUS:]}))


SIGNING_FILE: Final = "mavlink-signing-time.json"
MOST_UPTIME_S: Final = 3.2e9
_BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")


class SigningTime(msgspec.Struct, frozen=True):
    """Latest time used in our MAVLink signatures, in ticks of 10 us since 1 January 2015."""

    ticks: int
    reserved: int  # largest tick that may have been used before the next write
    uptime_s: float  # Uptime of the board when this file was written
    boot_id: str  # id of the board's boot; empty: unknown


def this_boot() -> str:
    # The service's unit hides the file and passes the id in the environment instead.
    handed = os.environ.get("COMPANION_BOOT_ID", "")
    if handed:
        return handed.replace("-", "")
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip().replace("-", "")
    except OSError:
        return ""


def signing_time_in(directory: Path) -> StateFile[SigningTime]:
    return StateFile(directory / SIGNING_FILE, SigningTime, _check_time)


def _check_time(found: SigningTime) -> None:
    if not 0 <= found.ticks <= found.reserved < 2**48 or not 0.0 <= found.uptime_s < MOST_UPTIME_S:
        raise msgspec.ValidationError(f"ticks {found.ticks} to {found.reserved} at {found.uptime_s:g} s is impossible")
