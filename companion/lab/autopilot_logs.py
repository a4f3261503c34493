"""Readers of autopilots' logs as rows of numbers: ArduPilot's dataflash (.bin) and PX4's ULog (.ulg).

Dataflash is parsed as AP_Logger/LogStructure.h defines it, with pymavlink's table of format letters; pymavlink's own
reader takes sixteen times as long. A ULog is read by pyulog.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import mmap
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.autopilot.parameters.change import FirmwareName
from companion.errors import StorageError
from companion.lab.inertial import Navigation
from companion.lab.still_log import LAST_S, StillLog, unreadable
from companion.physics.frames import Floats

US: Final = 1e-6
DATAFLASH_MAGIC: Final = b"\xa3\x95\x80"
"""First bytes of a dataflash log: the header of the format message that describes format messages."""
ULOG_MAGIC: Final = b"ULog\x01\x12\x35"
_HEAD: Final = DATAFLASH_MAGIC[:2]
_FMT: Final = np.dtype([("Type", "u1"), ("Length", "u1"), ("Name", "S4"), ("Format", "S16"), ("Columns", "S64")])
_CLOCKS: Final = {"TimeUS": 1e-6, "TimeMS": 1e-3}  # Unit in s; the latter in logs before 2016
_PARAMETER: Final = "PARM"
_MOST_PARAMETERS: Final = 1 << 16
_INSTANCES: Final = 16  # Most instances; a larger number is a damaged byte

Fields = Mapping[str, tuple[str, tuple[str, ...]]]
"""Log messages to read, each with the name of its instance field ("": none) and the names of the fields to read."""
_MOST_TIMES: Final = 4
"""Limit of bytes to read, as a multiple of the file's size: pyulog may jump back endlessly in a damaged file."""
_NEEDS_MORE: Final = (
    "a log of PX4 needs more than is installed: pip install '.[recording]' in the folder of the companion's sources"
)

Topics = Mapping[str, tuple[str, ...]]
"""Fields to read of each ULog topic; elements of arrays are listed one by one: `gyro_rad[0]`."""

_LARGEST: Final = 1e6
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
    """Log messages of one start of the autopilot; `parameters` has rows of time in s, name and value."""

    def __init__(self, fields: Mapping[str, int]) -> None:
        self._fields = fields
        self._chunks: dict[tuple[str, int], list[Floats]] = defaultdict(list)
        self.parameters: list[tuple[float, str, float]] = []
        self.gaps = 0  # Gaps where the autopilot could not write to the log

    def add(self, name: str, instance: int, rows: Floats) -> None:
        """Add rows in the order of the file: time in s on the autopilot's clock, then fields; NaN: no such field."""
        if 0 <= instance < _INSTANCES:
            self._chunks[name, instance].append(rows)

    def add_parameters(self, found: Iterator[tuple[float, str, float]]) -> None:
        self.parameters += itertools.islice(found, _MOST_PARAMETERS - len(self.parameters))

    def unsorted(self, name: str, instance: int = 0) -> Floats:
        """Return the rows of a message in the order of the file, (n, 1 + fields); the first column is time in s."""
        return np.concatenate([np.zeros((0, 1 + self._fields[name])), *self._chunks.get((name, instance), ())])

    def rows(self, name: str, instance: int = 0) -> Floats:
        return ascending(self.unsorted(name, instance))

    def instances(self, name: str) -> list[int]:
        return sorted(instance for each, instance in self._chunks if each == name)


def ascending(rows: Floats) -> Floats:
    """Select rows with ascending time (first column); drop as damaged a single row that is later than the next row."""
    rows = rows[np.isfinite(rows[:, 0])]
    if not len(rows):
        return rows
    times = rows[:, 0]
    ahead = (times[:-1] > times[1:]) & (times[1:] >= np.concatenate([[-np.inf], times[:-2]]))
    rows = rows[~np.append(ahead, [False])]
    return np.asarray(rows[np.concatenate([[True], rows[1:, 0] > np.maximum.accumulate(rows[:, 0])[:-1]])])


class _Kind:
    def __init__(self, length: int, name: str = "") -> None:
        self.length, self.name = length, name
        self.layout: np.dtype[np.void] | None = None  # None: not to be read
        self.factors: dict[str, float] = {}
        self.data = bytearray()

    def move(self, to: BootMessages, fields: Fields) -> None:
        if self.layout is None or not self.data:
            return
        messages = np.frombuffer(bytes(self.data), self.layout)
        self.data.clear()
        key, wanted = fields[self.name]
        there = messages.dtype.names or ()
        rows = np.full((len(messages), 1 + len(wanted)), np.nan)
        clock = next(name for name in _CLOCKS if name in there)
        rows[:, 0] = messages[clock] * _CLOCKS[clock]
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
    """Read the messages in `fields` and the parameters; yield one start of the autopilot at a time, to save memory."""
    kinds: dict[bytes, _Kind] = {DATAFLASH_MAGIC: _Kind(_FMT.itemsize + 3)}
    fields = {**fields, _PARAMETER: ("Name", ("Value",))}
    widths = {name: len(columns) for name, (_, columns) in fields.items()}
    start = BootMessages(widths)
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            at, end = 0, len(data)
            while 0 <= at <= end - 3:
                kind = kinds.get(data[at : at + 3])
                after = end if kind is None else at + kind.length
                if kind is None or (after != end and data[after : after + 2] != _HEAD):
                    # Damaged: a message must be followed by the head of another one.
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
        raise unreadable(path, error) from None
    for each in kinds.values():
        each.move(start, fields)
    yield start


def _described(data: bytes, fields: Fields) -> tuple[bytes, _Kind | None]:
    """Return header and layout of the messages that a format message describes; None if that message is damaged."""
    from pymavlink.DFReader import FORMAT_TO_STRUCT

    number, length, *said = np.frombuffer(data, _FMT)[0].tolist()
    name, letters, labels = (text.split(b"\0")[0].decode("latin-1") for text in said)
    head = _HEAD + bytes((number,))
    if length <= len(head):
        return head, None
    kind = _Kind(length, name)
    if name not in fields:
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
    key, wanted = fields[name]
    types = {label: layout[label].kind for label in layout.names or ()}
    good = layout.itemsize + len(head) == length and not types.keys().isdisjoint(_CLOCKS)
    good = good and "S" not in {types.get(label) for label in (*_CLOCKS, *wanted)}
    if good and types.get(key, "u") in ("S" if name == _PARAMETER else "iu"):
        kind.layout = layout
    return head, kind


class _Counted(io.BufferedReader):
    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._left = _MOST_TIMES * path.stat().st_size + (1 << 20)

    def read(self, size: int | None = -1, /) -> bytes:
        data = super().read(size)
        self._left -= len(data)
        if self._left < 0:
            raise StorageError("its messages lead back to where they began")
        return data


def ulog(path: Path, topics: Topics) -> BootMessages:
    try:
        from pyulog import ULog
    except ImportError:
        raise StorageError(_NEEDS_MORE) from None
    try:
        # pyulog prints damage to stdout, which may be reserved for JSON.
        with _Counted(path) as file, contextlib.redirect_stdout(None):
            log = ULog(file, [*topics])
    except OSError as error:
        raise unreadable(path, error) from None
    except Exception as error:  # noqa: BLE001 - pyulog may raise anything for a damaged file
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


# --- flights, of either firmware


class FlownImu(msgspec.Struct, frozen=True, kw_only=True):
    """Readings of one IMU in one flight log, with temperature, vibration and EKF biases.

    `means`: each reading is a mean since the reading before, not a momentary value. `degc` and `vibration` (m/s^2) have
    rows of time and value. `estimated` has EKF biases, (n, 9): time, gyro x y z (rad/s), accelerometer z (m/s^2), their
    four sigmas; NaN: unknown. Readings at `failed_s` are left out: the autopilot marked the IMU as failed.
    """

    number: int  # Number from 1, as in the configuration
    t_s: Floats
    readings: Floats  # (n, 6) rad/s and m/s^2, corrected by the firmware, vehicle FRD
    means: bool
    gyro_id: int | None = None
    accel_id: int | None = None
    degc: Floats = np.zeros((0, 2))  # Time and temperature
    vibration: Floats = np.zeros((0, 2))
    estimated: Floats | None = None
    failed_s: Floats = np.zeros(0)

    @property
    def rate_hz(self) -> float:
        return (len(self.t_s) - 1) / float(self.t_s[-1] - self.t_s[0]) if len(self.t_s) > 1 else 0.0


class Boot(msgspec.Struct, frozen=True, kw_only=True):
    """Log of one start of the autopilot; times are in s on its clock, and `unix_offset_s` converts them to UTC.

    `earth_turns` is False and `standard_gravity` True in a simulator without the Earth's rate and local gravity.
    """

    firmware: FirmwareName
    imus: tuple[FlownImu, ...]
    solution: Navigation | None
    truth: Navigation | None = None  # True trajectory of a simulator
    armed: tuple[tuple[float, bool], ...] = ()
    motors: tuple[tuple[float, bool], ...] = ()
    airborne: tuple[tuple[float, bool], ...] = ()
    parameters: tuple[tuple[float, str, float], ...] = ()
    unix_offset_s: float | None = None
    place: tuple[float, float] | None = None
    """Latitude in degrees and height in m of the aircraft."""
    earth_turns: bool = True
    standard_gravity: bool = False
    notes: tuple[str, ...] = ()

    def parameters_at(self, t_s: float) -> dict[str, float]:
        """Return the parameter values at a time; a parameter that was first logged later has its first value."""
        found: dict[str, float] = {}
        for told_s, name, value in self.parameters:
            if told_s <= t_s or name not in found:
                found[name] = value
        return found


def changes(t_s: Sequence[float] | Floats, states: Sequence[bool] | NDArray[Any]) -> tuple[tuple[float, bool], ...]:
    found: list[tuple[float, bool]] = []
    for at_s, state in zip(t_s, states, strict=True):
        if not found or found[-1][1] != bool(state):
            found.append((float(at_s), bool(state)))
    return tuple(found)


def in_use(choices: Floats, t_s: Floats) -> Floats:
    """Return the choice in use at each time, from rows (n, 2) of time and choice; the first row also counts before."""
    return np.asarray(choices[np.maximum(np.searchsorted(choices[:, 0], t_s, side="right") - 1, 0), 1])


# --- IMUs at rest


def read_ulog(path: Path) -> list[StillLog]:
    """Read the IMUs of a PX4 log: sensor_combined, which PX4's EKF uses, and pairs of sensor_gyro and sensor_accel."""
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
            # Gyro and accelerometer have separate messages: join the nearest force in time to every rate.
            at = np.searchsorted(0.5 * (beside[1:, 0] + beside[:-1, 0]), rows[:, 0])
            table = np.column_stack([rows[:, :4], beside[at, 1:4], rows[:, 4]])
            logs += _log(path, f"sensor{instance}", table, (_RAW, *notes))
    return logs


def read_dataflash(path: Path) -> list[StillLog]:
    starts = list(dataflash(path, {"IMU": ("I", _FIELDS)}))
    logs: list[StillLog] = []
    for instance in sorted({each for start in starts for each in start.instances("IMU")}):
        table = np.concatenate([start.unsorted("IMU", instance) for start in starts])
        logs += _log(path, f"imu{instance}", table, (_CORRECTED,))
    return logs


def _log(path: Path, imu: str, table: Floats, notes: tuple[str, ...]) -> Iterator[StillLog]:
    """Make one IMU's log from the complete, ascending rows of `table`: time, six readings, temperature."""
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
            t_s=t_s[ahead],
            readings=readings[ahead],
            temperature_degc=table[ahead, 7],
            notes=notes,
            left_out={why: count for why, count in left_out.items() if count},
            clock_from_start=True,
        )
