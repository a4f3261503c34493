"""Logs that autopilots write themselves: ULog of PX4 by pyulog, dataflash of ArduPilot (.bin) by pymavlink.

Units are those of the formats. The readings are those that the autopilot goes by, its offsets taken off: what is found
in them is what is left, in the vehicle's axes.
"""

from __future__ import annotations

import contextlib
import os
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO, Final

import msgspec
import numpy as np

from companion.errors import StorageError
from companion.physics.frames import Floats
from companion.replay.log import LAST_S, StillLog

_ULOG: Final = b"ULog\x01\x12\x35"
_DATAFLASH: Final = b"\xa3\x95\x80"
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

    topics = ["sensor_combined", "sensor_gyro", "sensor_accel"]
    with _quietly(path), path.open("rb") as file:
        found = Bounded(_Finite(file), topics)
        data = {(each.name, int(each.multi_id)): each.data for each in found.data_list}
        dropouts = len(found.dropouts)
        logs = [log for log in _ulog_imus(path, data) if log is not None]
    if not logs:
        raise StorageError(f"{path}: no samples of an IMU in it")
    notes = (f"{dropouts} gaps in it, in which PX4 could not write",) if dropouts else ()
    return [msgspec.structs.replace(log, notes=(*log.notes, *notes)) for log in logs]


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
_HEAD: Final = 3
_FIELDS: Final = ("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ")


def read_dataflash(path: Path) -> list[StillLog]:
    """The IMUs of an ArduPilot log, from its IMU messages.

    Raises:
        StorageError: one line: it cannot be read.
    """
    from pymavlink.DFReader import DFReader_binary

    tables: dict[int, array[float]] = {}
    with _quietly(path):
        log: Any = DFReader_binary.__new__(DFReader_binary)

        def index(progress_callback: Any = None) -> None:
            # The fast one, in C, says what it skips on the terminal, which nobody can catch; it is some 3 s of a
            # gigabyte.
            log.formats = _Formats(log.formats)
            log.init_arrays(progress_callback)

        log.init_arrays_fast = index
        try:
            log.__init__(str(path))  # where this fails it leaves the file open
            while (message := log.recv_match(type=list(_KINDS))) is not None:
                fields = message.to_dict()
                instance = int(fields.get("I", _KINDS[fields["mavpackettype"]]))
                row = (fields["TimeUS"] * _US, *(fields[name] for name in _FIELDS), fields.get("T", float("nan")))
                tables.setdefault(instance, array("d")).extend(row)
        finally:
            for opened in ("data_map", "filehandle"):
                if hasattr(log, opened):
                    getattr(log, opened).close()
    found = []
    for instance in sorted(tables):
        table = np.frombuffer(tables[instance]).reshape(-1, 8)
        one = _log(path, f"imu{instance}", table[:, 0], table[:, 1:7], table[:, 7], _CORRECTED)
        found += [] if one is None else [one]
    if not found:
        raise StorageError(f"{path}: no samples of an IMU in it")
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

    def __init__(self, file: BinaryIO) -> None:
        self._left = _READ_TIMES * os.fstat(file.fileno()).st_size + _READ_LEAST
        self._file = file
        self.seek, self.tell, self.close = file.seek, file.tell, file.close

    def read(self, size: int) -> bytes:
        """As any file; an empty read counts, too."""
        data = self._file.read(size)
        self._left -= max(len(data), 1)
        if self._left < 0:
            raise _EndlessError
        return data


class _Formats(dict[int, Any]):
    """Formats by number; a message of no length would be read at the same place for ever."""

    def __setitem__(self, number: int, found: Any) -> None:
        if found.len < _HEAD:
            raise _EndlessError
        super().__setitem__(number, found)


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
