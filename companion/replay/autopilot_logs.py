"""Logs that autopilots write themselves: ULog of PX4 by pyulog, dataflash of ArduPilot (.bin) by pymavlink.

Units are those of the formats. The readings are those that the autopilot goes by, its offsets taken off: what is found
in them is what is left, in the vehicle's axes.
"""

from __future__ import annotations

import contextlib
import io
import mmap
import os
import struct
from array import array
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, BinaryIO, Final

import msgspec
import numpy as np

from companion.errors import StorageError
from companion.physics.frames import Floats
from companion.replay.log import LAST_S, StillLog

_ULOG: Final = b"ULog\x01\x12\x35"
_DATAFLASH: Final = b"\xa3\x95\x80"
_FMT_COLUMNS: Final = "Type,Length,Name,Format,Columns"
_TELL_BYTES: Final = 1 << 24
_US: Final = 1e-6
_LARGEST: Final = 1e6
"""What is larger is no reading, in SI units."""
_READ_TIMES: Final = 16
"""A log is read through once or twice; where it is damaged, its readers look for what is whole again and again."""
_READ_LEAST: Final = 1 << 24
_MOST_FIELDS: Final = 10_000
"""Of a message: the largest of PX4 have some hundreds."""
_CORRECTED: Final = (
    "the autopilot's offsets are taken off in it: what is found is what they leave, in the vehicle's axes"
)
_RAW: Final = "readings without the autopilot's offsets"

Progress = Callable[[float], None]
"""Told how much of a file has been read, from 0 to 1."""


def _nobody(_share: float) -> None:
    """Nobody wants to know."""


def reader_of(path: Path) -> Callable[[Path], list[StillLog]] | None:
    """What reads a file, if it is a log of an autopilot.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        head = file.read(len(_ULOG))
    if head.startswith(_ULOG):
        return read_ulog
    return read_dataflash if head.startswith(_DATAFLASH) else None


def read_ulog(path: Path) -> list[StillLog]:
    """The IMUs of a PX4 log: sensor_combined as PX4 flies by it, and each pair of sensor_gyro and sensor_accel.

    Raises:
        StorageError: one line: it cannot be read, or pyulog is not there.
    """
    with ulog(path, ["sensor_combined", "sensor_gyro", "sensor_accel"]) as found:
        data = {(each.name, int(each.multi_id)): each.data for each in found.data_list}
        dropouts = len(found.dropouts)
        logs = [log for log in _ulog_imus(path, data) if log is not None]
    if not logs:
        raise StorageError(f"{path}: no samples of an IMU in it")
    notes = (f"{dropouts} gaps in it, in which PX4 could not write",) if dropouts else ()
    return [msgspec.structs.replace(log, notes=(*log.notes, *notes)) for log in logs]


@contextlib.contextmanager
def ulog(path: Path, topics: list[str], progress: Progress = _nobody) -> Iterator[Any]:
    """A ULog with these topics read, as pyulog has it; what is wrong inside is one line, too.

    Raises:
        StorageError: one line: it cannot be read, or pyulog is not there.
    """
    try:
        from pyulog import ULog
    except ImportError:
        raise StorageError(f"{path}: it needs more than is installed: pip install 'companion[logs]'") from None

    class Bounded(ULog):  # type: ignore[misc]
        """Formats of formats of formats are no end of fields."""

        class _MessageAddLogged(ULog._MessageAddLogged):  # type: ignore[misc]  # noqa: SLF001
            fields = 0

            def _parse_nested_type(self, prefix_str: str, type_name: str, message_formats: dict[str, Any]) -> None:
                self.fields += sum(max(size, 1) for _, size, _ in message_formats[type_name].fields) + 1
                if self.fields > _MOST_FIELDS:
                    raise _EndlessError
                super()._parse_nested_type(prefix_str, type_name, message_formats)

    with _quietly(path), path.open("rb") as file:
        yield Bounded(_Finite(file, progress), topics)


def _ulog_imus(path: Path, data: dict[tuple[str, int], dict[str, Any]]) -> Iterator[StillLog | None]:
    for (topic, instance), fields in data.items():
        times = np.asarray(fields["timestamp"], dtype=np.float64) * _US
        if topic == "sensor_combined":
            names = [f"{name}[{axis}]" for name in ("gyro_rad", "accelerometer_m_s2") for axis in range(3)]
            readings = np.column_stack([np.asarray(fields[name], dtype=np.float64) for name in names])
            yield _log(path, topic, times, readings, np.full(len(times), np.nan), _CORRECTED)
        elif topic == "sensor_gyro" and (accel := data.get(("sensor_accel", instance))):
            # Each in its own messages: to every rate the force that is nearest in time.
            beside = np.asarray(accel["timestamp"], dtype=np.float64) * _US
            if not len(beside):
                continue
            at = np.searchsorted(0.5 * (beside[1:] + beside[:-1]), times)
            rows = [np.asarray(fields[axis], dtype=np.float64) for axis in "xyz"]
            rows += [np.asarray(accel[axis], dtype=np.float64)[at] for axis in "xyz"]
            degc = np.asarray(fields.get("temperature", np.full(len(times), np.nan)), dtype=np.float64)
            yield _log(path, f"sensor{instance}", times, np.column_stack(rows), degc, _RAW)


_KINDS: Final = {"IMU": 0, "IMU2": 1, "IMU3": 2}
"""Messages and their instances; newer firmware has one kind, with the instance in it."""
_IMUS: Final = 5
"""More no board has: another number is damage."""
_HEAD: Final = 3
_FIELDS: Final = ("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ")


def read_dataflash(path: Path) -> list[StillLog]:
    """The IMUs of an ArduPilot log, from its IMU messages.

    Raises:
        StorageError: one line: it cannot be read.
    """
    tables: dict[int, array[float]] = {}
    with _quietly(path):
        for kind, fields in dataflash(path, _KINDS):
            instance = int(fields.get("I", _KINDS[kind]))
            row = (fields["TimeUS"] * _US, *(fields[name] for name in _FIELDS), fields.get("T", float("nan")))
            if instance < _IMUS:
                tables.setdefault(instance, array("d")).extend(row)
    found = []
    for instance in sorted(tables):
        table = np.frombuffer(tables[instance]).reshape(-1, 8)
        one = _log(path, f"imu{instance}", table[:, 0], table[:, 1:7], table[:, 7], _CORRECTED)
        found += [] if one is None else [one]
    if not found:
        raise StorageError(f"{path}: no samples of an IMU in it")
    return found


def dataflash(path: Path, kinds: Collection[str], progress: Progress = _nobody) -> Iterator[tuple[str, dict[str, Any]]]:
    """The messages of these kinds in an ArduPilot log, one by one, so that memory does not grow with it.

    The formats are pymavlink's; its index of a whole log would be larger than the log of a board may be.

    Raises:
        StorageError: one line: it cannot be read.
    """
    formats: dict[int, _Layout] = {}
    _learn(formats, {"Type": _DATAFLASH[2], "Name": "FMT", "Length": 89, "Format": "BBnNZ", "Columns": _FMT_COLUMNS})
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            at, told, size = 0, 0, len(data)
            while (at := _next(data, at, formats)) >= 0:
                layout = formats[data[at + 2]]
                if at - told > _TELL_BYTES:
                    told = at
                    progress(at / size)
                    data.madvise(mmap.MADV_DONTNEED, 0, at - at % mmap.PAGESIZE)
                if layout.name == "FMT":
                    _learn(formats, layout.read(data, at))
                elif layout.name in kinds:
                    yield layout.name, layout.read(data, at)
                at += layout.length
    except (OSError, ValueError) as error:
        raise StorageError(f"{path}: cannot be read: {error}") from None


def _next(data: mmap.mmap, at: int, formats: dict[int, _Layout]) -> int:
    """Where the next whole message begins; -1: none does."""
    while True:
        layout = formats.get(data[at + 2]) if data[at : at + 2] == _DATAFLASH[:2] and at + 2 < len(data) else None
        if layout is not None and at + layout.length <= len(data):
            return at
        at = data.find(_DATAFLASH[:2], at + 1)
        if at < 0:
            return -1


def _learn(formats: dict[int, _Layout], fields: dict[str, Any]) -> None:
    """One more kind of message, if that is what they say."""
    from pymavlink.DFReader import DFFormat

    try:
        with contextlib.redirect_stdout(io.StringIO()):
            kind = DFFormat(*(fields[key] for key in ("Type", "Name", "Length", "Format", "Columns")))  # type: ignore[no-untyped-call]
    except Exception:  # noqa: BLE001  - whatever it makes of a damaged one
        return
    found = _Layout(kind)
    if found.holds:
        formats[fields["Type"]] = found


class _Layout:
    """How the messages of one kind lie."""

    def __init__(self, kind: Any) -> None:
        self.name, self.length = str(kind.name), int(kind.len)
        layout = struct.Struct(kind.msg_struct)
        self.holds = layout.size + _HEAD == self.length
        self._unpack = layout.unpack_from
        self._fields = list(zip(kind.columns, kind.msg_mults, strict=False))

    def read(self, data: mmap.mmap, at: int) -> dict[str, Any]:
        """By field, in its unit."""
        found: dict[str, Any] = {}
        for (name, factor), value in zip(self._fields, self._unpack(data, at + _HEAD), strict=False):
            if isinstance(value, bytes):
                found[name] = value.split(b"\0", 1)[0].decode("utf-8", "replace")
            else:
                found[name] = value if factor is None else value * factor
        return found


def _log(path: Path, imu: str, t_s: Floats, readings: Floats, degc: Floats, note: str) -> StillLog | None:
    """Of what is whole, in order of time; None where nothing is."""
    whole = (np.abs(t_s) < LAST_S) & (np.abs(readings) < _LARGEST).all(axis=1)
    ahead = whole.copy()
    newest = np.maximum.accumulate(np.where(whole, t_s, -np.inf)) if len(t_s) else t_s
    ahead[1:] &= t_s[1:] > newest[:-1]
    left_out = {"without a number": int((~whole).sum()), "late or repeated": int((whole & ~ahead).sum())}
    if not ahead.any():
        return None
    return StillLog(
        imu=imu,
        files=(path.name,),
        began_unix_s=None,
        t_s=t_s[ahead],
        readings=readings[ahead],
        temperature_degc=degc[ahead],
        notes=(note,),
        left_out={why: count for why, count in left_out.items() if count},
        clock_from_start=True,
    )


class _EndlessError(Exception):
    """Reading it would take no end of time or memory."""

    def __init__(self) -> None:
        super().__init__("reading it comes to no end")


class _Finite:
    """A file that can be read some times over, but not for ever: at the end of a damaged one pyulog goes back."""

    def __init__(self, file: BinaryIO, progress: Progress) -> None:
        self._size = os.fstat(file.fileno()).st_size
        self._left = _READ_TIMES * self._size + _READ_LEAST
        self._file, self._progress, self._told = file, progress, 0
        self.seek, self.tell, self.close = file.seek, file.tell, file.close

    def read(self, size: int) -> bytes:
        """As any file; an empty read counts, too."""
        data = self._file.read(size)
        self._left -= max(len(data), 1)
        if abs((at := self._file.tell()) - self._told) > _TELL_BYTES:
            self._told = at
            self._progress(min(at / self._size, 1.0))
        if self._left < 0:
            raise _EndlessError
        return data


@contextlib.contextmanager
def _quietly(path: Path) -> Iterator[None]:
    """What a library prints is nobody's business here, and what it stumbles over is one line."""
    try:
        # They may say a line about every byte.
        with open(os.devnull, "w") as nobody, contextlib.redirect_stdout(nobody), contextlib.redirect_stderr(nobody):
            yield
    except StorageError:
        raise
    except OSError as error:
        raise StorageError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception as error:  # noqa: BLE001  - whatever they make of a damaged file
        said = str(error).splitlines()
        raise StorageError(
            f"{path}: damaged, or not of its kind: {said[0] if said else type(error).__name__}"
        ) from None
