"""Logs of autopilots as rows of numbers: ArduPilot's dataflash (.bin) and PX4's ULog (.ulg).

Dataflash: AP_Logger/LogStructure.h; the letters of its formats are pymavlink's, whose own reader takes sixteen times
as long. A ULog is read by pyulog.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import mmap
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from companion.errors import StorageError
from companion.lab.logs.still_log import LAST_S, StillLog
from companion.physics.frames import Floats

US: Final = 1e-6
DATAFLASH_MAGIC: Final = b"\xa3\x95\x80"
"""Beginning of a dataflash log: the head of a format message that describes format messages."""
ULOG_MAGIC: Final = b"ULog\x01\x12\x35"
_HEAD: Final = DATAFLASH_MAGIC[:2]
_FMT: Final = np.dtype([("Type", "u1"), ("Length", "u1"), ("Name", "S4"), ("Format", "S16"), ("Columns", "S64")])
_CLOCK: Final = "TimeUS"
_PARAMETER: Final = "PARM"
_MOST_PARAMETERS: Final = 1 << 16
_INSTANCES: Final = 16
"""Most instances: a larger number is damage."""

Fields = Mapping[str, tuple[str, tuple[str, ...]]]
"""Field with the instance, or nothing, and fields to read, by message."""
_MOST_TIMES: Final = 4
"""Most times that a file is read: damage can lead pyulog back to where it was, again and again."""
_NEEDS_MORE: Final = (
    "a log of PX4 needs more than is installed: pip install '.[recording]' in the folder of the companion's sources"
)

Topics = Mapping[str, tuple[str, ...]]
"""Fields to read by topic; arrays element by element: `gyro_rad[0]`."""

_LARGEST: Final = 1e6
"""Largest reading, in SI units."""
_CORRECTED: Final = (
    "the autopilot's offsets are taken off in it: what is found is what they leave, in the vehicle's axes"
)
_RAW: Final = "readings without the autopilot's offsets"
_FIELDS: Final = ("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ", "T")
_TOPICS: Final = {
    "sensor_combined": tuple(f"{name}[{k}]" for name in ("gyro_rad", "accelerometer_m_s2") for k in range(3)),
    "sensor_gyro": ("x", "y", "z", "temperature"),
    "sensor_accel": ("x", "y", "z"),
}


class BootMessages:
    """Messages of one start of the autopilot."""

    def __init__(self, fields: Mapping[str, int]) -> None:
        self._fields = fields
        self._chunks: dict[tuple[str, int], list[Floats]] = defaultdict(list)
        self.parameters: list[tuple[float, str, float]] = []
        """Time in s, name and value."""
        self.gaps = 0
        """Gaps in which the autopilot could not write."""

    def add(self, name: str, instance: int, rows: Floats) -> None:
        """Add rows of a message in the order of the file: the autopilot's clock in s, and the fields; NaN: no field."""
        if 0 <= instance < _INSTANCES:
            self._chunks[name, instance].append(rows)

    def add_parameters(self, found: Iterator[tuple[float, str, float]]) -> None:
        """Add parameters, up to a bound."""
        self.parameters += itertools.islice(found, _MOST_PARAMETERS - len(self.parameters))

    def unsorted(self, name: str, instance: int = 0) -> Floats:
        """Return the rows of a message in the order of the file, (n, 1 + fields), the time in s first."""
        return np.concatenate([np.zeros((0, 1 + self._fields[name])), *self._chunks.get((name, instance), ())])

    def rows(self, name: str, instance: int = 0) -> Floats:
        """Return the rows of a message in the order of their times."""
        return ascending(self.unsorted(name, instance))

    def instances(self, name: str) -> list[int]:
        """List the instances that have logged a message."""
        return sorted(instance for each, instance in self._chunks if each == name)


def ascending(rows: Floats) -> Floats:
    """Select rows in order of their time, the first column; a single one that is ahead of all others is damage."""
    rows = rows[np.isfinite(rows[:, 0])]
    if not len(rows):
        return rows
    times = rows[:, 0]
    ahead = (times[:-1] > times[1:]) & (times[1:] >= np.concatenate([[-np.inf], times[:-2]]))
    rows = rows[~np.append(ahead, [False])]
    return np.asarray(rows[np.concatenate([[True], rows[1:, 0] > np.maximum.accumulate(rows[:, 0])[:-1]])])


class _Kind:
    """Layout of one kind of dataflash message, and the messages of it since the start."""

    def __init__(self, length: int, name: str = "", layout: np.dtype[np.void] | None = None) -> None:
        self.length = length
        """Length with the head."""
        self.name = name
        self.layout = layout
        """None: not to be read."""
        self.factors: dict[str, float] = {}
        self.data = bytearray()

    def move(self, to: BootMessages, fields: Fields) -> None:
        """Move the messages to those of a start."""
        if self.layout is None or not self.data:
            return
        messages = np.frombuffer(bytes(self.data), self.layout)
        self.data.clear()
        key, wanted = fields.get(self.name, ("Name", ("Value",)))
        there = messages.dtype.names or ()
        rows = np.full((len(messages), 1 + len(wanted)), np.nan)
        rows[:, 0] = messages[_CLOCK] * US
        with np.errstate(invalid="ignore"):  # damaged
            for k, name in enumerate(wanted, 1):
                if name in there:
                    rows[:, k] = messages[name] * self.factors.get(name, 1.0)
        if self.name == _PARAMETER:
            names = (text.decode("latin-1") for text in messages["Name"].tolist())
            to.add_parameters(zip(rows[:, 0].tolist(), names, rows[:, 1].tolist(), strict=True))
        elif key not in there:
            to.add(self.name, 0, rows)
        else:
            for instance in np.unique(messages[key]).tolist():
                to.add(self.name, int(instance), rows[messages[key] == instance])


def dataflash(path: Path, fields: Fields) -> Iterator[BootMessages]:
    """Give these messages and the parameters of each start in a file, one after another: memory is that of one."""
    kinds: dict[bytes, _Kind] = {DATAFLASH_MAGIC: _Kind(_FMT.itemsize + 3)}
    widths = {name: len(columns) for name, (_, columns) in fields.items()}
    start = BootMessages(widths)
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            at, end = 0, len(data)
            while 0 <= at <= end - 3:
                kind = kinds.get(data[at : at + 3])
                after = end if kind is None else at + kind.length
                if kind is None or (after != end and data[after : after + 2] != _HEAD):
                    # Damage: bytes that no other message follows are no message.
                    at = data.find(_HEAD, at + 1)
                    continue
                if kind.layout is not None:
                    kind.data += data[at + 3 : after]
                elif data[at + 2] == DATAFLASH_MAGIC[2]:
                    head, described = _described(data[at + 3 : after], fields)
                    if head in kinds:
                        for each in kinds.values():
                            each.move(start, fields)
                    if head == DATAFLASH_MAGIC and at:  # the log of another start
                        yield start
                        start = BootMessages(widths)
                    elif described is not None:
                        kinds[head] = described
                at = after
    except OSError as error:
        raise StorageError(f"{path}: cannot be read: {error.strerror or error}") from None
    for each in kinds.values():
        each.move(start, fields)
    yield start


def _described(data: bytes, fields: Fields) -> tuple[bytes, _Kind | None]:
    """Give the head and the kind of the messages that a format message describes; None: it cannot be one."""
    from pymavlink.DFReader import FORMAT_TO_STRUCT

    number, length, *said = np.frombuffer(data, _FMT)[0].tolist()
    name, letters, labels = (text.split(b"\0")[0].decode("latin-1") for text in said)
    head = _HEAD + bytes((number,))
    if length <= len(head):
        return head, None
    kind = _Kind(length, name)
    if name not in fields and name != _PARAMETER:
        return head, kind
    parts = []
    for letter, label in zip(letters, labels.split(","), strict=False):
        code, factor, _ = FORMAT_TO_STRUCT.get(letter, ("", None, None))
        parts.append((label, f"S{code[:-1]}" if code.endswith("s") else f"<{code}"))
        kind.factors[label] = 1.0 if factor is None else factor
    try:
        layout = np.dtype(parts)
    except (TypeError, ValueError):
        return head, kind
    key, wanted = fields.get(name, ("Name", ("Value",)))
    types = {label: layout[label].kind for label in layout.names or ()}
    good = layout.itemsize + len(head) == length and _CLOCK in types
    good = good and "S" not in {types.get(label) for label in (_CLOCK, *wanted)}
    if good and types.get(key, "u") in ("S" if name == _PARAMETER else "iu"):
        kind.layout = layout
    return head, kind


class _Counted(io.BufferedReader):
    """A file of which only so much can be read."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._left = _MOST_TIMES * path.stat().st_size + (1 << 20)

    def read(self, size: int | None = -1, /) -> bytes:
        """Read so many bytes."""
        data = super().read(size)
        self._left -= len(data)
        if self._left < 0:
            raise StorageError("its messages lead back to where they began")
        return data


def ulog(path: Path, topics: Topics) -> BootMessages:
    """Read these topics, the parameters and the dropouts."""
    try:
        from pyulog import ULog
    except ImportError:
        raise StorageError(_NEEDS_MORE) from None
    try:
        # It prints what is damaged to stdout, where an answer may stand.
        with _Counted(path) as file, contextlib.redirect_stdout(None):
            log = ULog(file, [*topics])
    except OSError as error:
        raise StorageError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception as error:  # noqa: BLE001 - pyulog raises anything of a damaged file
        raise StorageError(f"{path}: not a readable log of PX4: {' '.join(str(error).split())[:200]}") from None
    start = BootMessages({name: len(fields) for name, fields in topics.items()})
    told = [(log.start_timestamp, name, value) for name, value in log.initial_parameters.items()]
    values = ((t_us * US, name, value) for t_us, name, value in (*told, *log.changed_parameters))
    start.add_parameters(each for each in values if isinstance(each[2], int | float))
    start.gaps = len(log.dropouts)
    for each in log.data_list:
        times_s = each.data.get("timestamp", np.zeros(0)) * US
        columns = [each.data.get(name, np.full(len(times_s), np.nan)) for name in topics[each.name]]
        if len(times_s):
            start.add(each.name, each.multi_id, np.column_stack([times_s, *columns]).astype(np.float64))
    return start


# --- IMUs at rest


def reader_of(path: Path) -> Callable[[Path], list[StillLog]] | None:
    """Return the reader of an autopilot's log; None: the file is none."""
    with path.open("rb") as file:
        head = file.read(len(ULOG_MAGIC))
    if head.startswith(ULOG_MAGIC):
        return read_ulog
    return read_dataflash if head.startswith(DATAFLASH_MAGIC) else None


def read_ulog(path: Path) -> list[StillLog]:
    """Read the IMUs of a PX4 log: sensor_combined, which PX4 flies by, and pairs of sensor_gyro and sensor_accel."""
    start = ulog(path, _TOPICS)
    notes = (f"gaps in it, in which PX4 could not write: {start.gaps}",) if start.gaps else ()
    logs: list[StillLog] = []
    for instance in start.instances("sensor_combined"):
        rows = start.unsorted("sensor_combined", instance)
        table = np.column_stack([rows, np.full(len(rows), np.nan)])
        logs += _log(path, "sensor_combined", table, (_CORRECTED, *notes))
    for instance in start.instances("sensor_gyro"):
        rows, beside = (start.unsorted(topic, instance) for topic in ("sensor_gyro", "sensor_accel"))
        if len(beside):
            # Each has messages of its own: join the force that is nearest in time to every rate.
            at = np.searchsorted(0.5 * (beside[1:, 0] + beside[:-1, 0]), rows[:, 0])
            table = np.column_stack([rows[:, :4], beside[at, 1:4], rows[:, 4]])
            logs += _log(path, f"sensor{instance}", table, (_RAW, *notes))
    return logs


def read_dataflash(path: Path) -> list[StillLog]:
    """Read the IMUs of an ArduPilot log, from its IMU messages."""
    starts = list(dataflash(path, {"IMU": ("I", _FIELDS)}))
    logs: list[StillLog] = []
    for instance in sorted({each for start in starts for each in start.instances("IMU")}):
        table = np.concatenate([start.unsorted("IMU", instance) for start in starts])
        logs += _log(path, f"imu{instance}", table, (_CORRECTED,))
    return logs


def _log(path: Path, imu: str, table: Floats, notes: tuple[str, ...]) -> Iterator[StillLog]:
    """Make the log of an IMU from the samples that are whole and in order of time, if there are any.

    The table has a column of times, six of readings and one of temperatures.
    """
    t_s, readings = table[:, 0], table[:, 1:7]
    whole = (np.abs(t_s) < LAST_S) & (np.abs(readings) < _LARGEST).all(axis=1)
    ahead = whole.copy()
    newest = np.maximum.accumulate(np.where(whole, t_s, -np.inf)) if len(t_s) else t_s
    ahead[1:] &= t_s[1:] > newest[:-1]
    left_out = {"without a number": int((~whole).sum()), "late or repeated": int((whole & ~ahead).sum())}
    if ahead.any():
        yield StillLog(
            imu=imu,
            files=(path.name,),
            began_unix_s=None,
            t_s=t_s[ahead],
            readings=readings[ahead],
            temperature_degc=table[ahead, 7],
            notes=notes,
            left_out={why: count for why, count in left_out.items() if count},
            clock_from_start=True,
        )
