"""IMUs at rest in files of any kind: our own recordings, logs of autopilots (ULog, dataflash), CSV.

The readings in an autopilot's log are those that it flies by, its offsets taken off: biases found in them are what the
offsets leave, in the vehicle's axes.
"""

from __future__ import annotations

import math
from array import array
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from companion.config.sections import Config
from companion.errors import StorageError
from companion.lab.logs import csv_log
from companion.lab.logs.autopilot_logs import DATAFLASH_MAGIC, DROPOUTS, ULOG_MAGIC, Block, dataflash, ulog
from companion.lab.logs.log import LAST_S, NAME, StillLog
from companion.lab.logs.playback import UNUSABLE, Playback, config_of
from companion.lab.logs.recording import Head, Recording, is_text
from companion.physics.frames import Floats
from companion.recording import messages
from companion.samples import ImuSample

CONTINUED_S: Final = 60.0
"""A recording that begins within so much of another's end, on the same clock, goes on with it."""
_LARGEST: Final = 1e6
"""Largest reading, in SI units."""
_CORRECTED: Final = (
    "the autopilot's offsets are taken off in it: what is found is what they leave, in the vehicle's axes"
)
_RAW: Final = "readings without the autopilot's offsets"
_IMUS: Final = 5
"""Most IMUs of a board: a larger number is damage."""

_FIELDS: Final = ("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ", "T")
_TOPICS: Final = {
    "sensor_combined": tuple(f"{name}[{k}]" for name in ("gyro_rad", "accelerometer_m_s2") for k in range(3)),
    "sensor_gyro": ("x", "y", "z", "temperature"),
    "sensor_accel": ("x", "y", "z"),
}


def read_logs(
    paths: Sequence[Path], columns: str | None = None, rate_hz: float | None = None, csv_name: str = NAME
) -> list[StillLog]:
    """All IMUs in all files of any kind, one entry for each IMU and session; the rest as for `csv_log.read`."""
    found: list[StillLog] = []
    for path in paths:
        try:
            text, autopilots = is_text(path), reader_of(path)
        except OSError as error:
            raise StorageError(f"{path}: cannot be read: {error.strerror or error}") from None
        if autopilots is not None:
            logs = autopilots(path)
        elif text:
            logs = [csv_log.read(path, columns, rate_hz, csv_name)]
        else:
            logs = _read_recording(path)
        if not logs:
            raise StorageError(f"{path}: no samples of an IMU in it")
        found += logs
    return _joined(found)


class _Columns:
    """Samples of one IMU while they are read."""

    def __init__(self) -> None:
        self.rows = array("d")
        self.breaks_s: list[float] = []
        self.last_s = -math.inf
        self.truncated = False

    def add(self, sample: ImuSample) -> None:
        """Add a sample, unless its time goes back."""
        if sample.t_s > self.last_s:
            self.last_s = sample.t_s
            degc = math.nan if sample.temperature_degc is None else sample.temperature_degc
            self.rows.extend((sample.t_s, *sample.gyro_rad_s, *sample.accel_m_s2, degc))


def _read_recording(path: Path) -> list[StillLog]:
    found: dict[str, _Columns] = {}
    playback: Playback | None = None
    head: Head | None = None
    config: Config | None = None
    for item in Recording(path).items():
        if isinstance(item, Head):
            head, config = item, config_of(item, path)
            playback = Playback(config)
            found = {imu.name: _Columns() for imu in config.imu}
        elif playback is not None:
            try:
                _add(playback, *item, found)
            except UNUSABLE as error:
                raise StorageError(f"{path}: a message on {item[0]} cannot be used by this version ({error})") from None
    found = {name: each for name, each in found.items() if each.rows or each.truncated}
    if head is None or config is None:
        return []
    profiles = {imu.name: imu.profile for imu in config.imu}
    offset_s = head.offset_ns / 1e9
    logs = []
    for name, columns in found.items():
        table = np.frombuffer(columns.rows, dtype=np.float64).reshape(-1, 8)
        logs.append(
            StillLog(
                imu=name,
                files=(path.name,),
                began_unix_s=float(table[0, 0]) + offset_s if len(table) else None,
                t_s=table[:, 0].copy(),
                readings=table[:, 1:7].copy(),
                temperature_degc=table[:, 7].copy(),
                profile=profiles.get(name),
                truncated=columns.truncated and not len(table),
                clock_offset_s=offset_s,
                breaks_s=tuple(columns.breaks_s),
            )
        )
    return logs


def _add(playback: Playback, topic: str, t_s: float, data: bytes, found: dict[str, _Columns]) -> None:
    """Take the samples of a message; readings behind another state cannot be compared with those before."""
    if topic == messages.START:
        playback.begin()
    if not playback.wants(topic):
        return
    for role, part in playback.take(topic, data, t_s):
        if isinstance(part, ImuSample):
            state = playback.state(role.name)
            columns = found[role.name]
            if state is not None and state.input.steps is not None:
                columns.truncated = True
            else:
                columns.add(part)
    if topic.startswith(messages.IMU):
        found[topic.removeprefix(messages.IMU)].breaks_s.append(t_s)


def _joined(logs: Iterable[StillLog]) -> list[StillLog]:
    """Recordings of one run of the daemon, cut into files, as one session."""
    result: list[StillLog] = []
    for log in sorted(logs, key=lambda each: (each.imu, each.began_unix_s or 0.0)):
        before = result[-1] if result else None
        if before is not None and _goes_on(before, log):
            result[-1] = msgspec.structs.replace(
                before,
                files=(*before.files, *log.files),
                t_s=np.concatenate([before.t_s, log.t_s]),
                readings=np.concatenate([before.readings, log.readings]),
                temperature_degc=np.concatenate([before.temperature_degc, log.temperature_degc]),
                breaks_s=(*before.breaks_s, *log.breaks_s),
            )
        else:
            result.append(log)
    return result


def _goes_on(before: StillLog, log: StillLog) -> bool:
    if before.imu != log.imu or before.clock_offset_s is None or log.clock_offset_s is None:
        return False
    if not len(before.t_s) or not len(log.t_s) or abs(before.clock_offset_s - log.clock_offset_s) > 1.0:
        return False
    return 0.0 < float(log.t_s[0] - before.t_s[-1]) < CONTINUED_S


# --- logs of autopilots


def reader_of(path: Path) -> Callable[[Path], list[StillLog]] | None:
    """Return the reader of an autopilot's log; None: the file is none."""
    with path.open("rb") as file:
        head = file.read(len(ULOG_MAGIC))
    if head.startswith(ULOG_MAGIC):
        return read_ulog
    return read_dataflash if head.startswith(DATAFLASH_MAGIC) else None


def read_ulog(path: Path) -> list[StillLog]:
    """Read the IMUs of a PX4 log: sensor_combined, which PX4 flies by, and pairs of sensor_gyro and sensor_accel."""
    data = _joined_blocks(ulog(path, _TOPICS))
    dropouts = len(data.get((DROPOUTS, 0), ()))
    notes = (f"gaps in it, in which PX4 could not write: {dropouts}",) if dropouts else ()
    logs: list[StillLog] = []
    for (topic, instance), rows in sorted(data.items()):
        times = rows[:, 0]
        if topic == "sensor_combined":
            logs += _log(path, topic, times, rows[:, 1:7], np.full(len(times), np.nan), (_CORRECTED, *notes))
        elif topic == "sensor_gyro" and (topic_of_force := ("sensor_accel", instance)) in data:
            # Each has messages of its own: join the force that is nearest in time to every rate.
            beside = data[topic_of_force]
            at = np.searchsorted(0.5 * (beside[1:, 0] + beside[:-1, 0]), times)
            readings = np.hstack([rows[:, 1:4], beside[at, 1:4]])
            logs += _log(path, f"sensor{instance}", times, readings, rows[:, 4], (_RAW, *notes))
    return logs


def read_dataflash(path: Path) -> list[StillLog]:
    """Read the IMUs of an ArduPilot log, from its IMU messages."""
    data = _joined_blocks(dataflash(path, {"IMU": ("I", _FIELDS)}))
    logs: list[StillLog] = []
    for (_, instance), rows in sorted((key, rows) for key, rows in data.items() if key[0] == "IMU"):
        logs += _log(path, f"imu{instance}", rows[:, 0], rows[:, 1:7], rows[:, 7], (_CORRECTED,))
    return logs


def _joined_blocks(blocks: Iterable[Block | None]) -> dict[tuple[str, int], Floats]:
    found: dict[tuple[str, int], list[Floats]] = defaultdict(list)
    for block in blocks:
        if block is not None and block.instance < _IMUS:
            found[block.name, block.instance].append(block.rows)
    return {key: np.concatenate(rows) for key, rows in found.items()}


def _log(
    path: Path, imu: str, t_s: Floats, readings: Floats, degc: Floats, notes: tuple[str, ...]
) -> Iterator[StillLog]:
    """Make the log of an IMU from the samples that are whole and in order of time, if there are any."""
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
            temperature_degc=degc[ahead],
            notes=notes,
            left_out={why: count for why, count in left_out.items() if count},
            clock_from_start=True,
        )
