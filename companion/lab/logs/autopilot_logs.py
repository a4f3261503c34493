"""Logs that autopilots write themselves: ULog of PX4, dataflash of ArduPilot (.bin).

Units are those of the formats. The readings are those that the autopilot goes by, its offsets taken off: what is found
in them is what is left, in the vehicle's axes.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from companion.errors import StorageError
from companion.lab.logs import dataflash, ulog
from companion.lab.logs.blocks import DROPOUTS, Block
from companion.lab.logs.log import LAST_S, StillLog
from companion.physics.frames import Floats

_LARGEST: Final = 1e6
"""What is larger is no reading, in SI units."""
_CORRECTED: Final = (
    "the autopilot's offsets are taken off in it: what is found is what they leave, in the vehicle's axes"
)
_RAW: Final = "readings without the autopilot's offsets"
_IMUS: Final = 5
"""More no board has: another number is damage."""

_FIELDS: Final = ("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ", "T")
_KINDS: Final = {"IMU": ("I", _FIELDS), "IMU2": ("", _FIELDS), "IMU3": ("", _FIELDS)}
_INSTANCES: Final = {"IMU2": 1, "IMU3": 2}
"""Messages and their instances; newer firmware has one kind, with the instance in it."""
_TOPICS: Final = {
    "sensor_combined": tuple(f"{name}[{k}]" for name in ("gyro_rad", "accelerometer_m_s2") for k in range(3)),
    "sensor_gyro": ("x", "y", "z", "temperature"),
    "sensor_accel": ("x", "y", "z"),
}


def reader_of(path: Path) -> Callable[[Path], list[StillLog]] | None:
    """What reads a file, if it is a log of an autopilot.

    Raises:
        OSError: it cannot be read.
    """
    with path.open("rb") as file:
        head = file.read(len(ulog.MAGIC))
    if head.startswith(ulog.MAGIC):
        return read_ulog
    return read_dataflash if head.startswith(dataflash.MAGIC) else None


def _whole(blocks: Iterable[Block | None]) -> dict[tuple[str, int], Floats]:
    """By message and instance."""
    found: dict[tuple[str, int], list[Floats]] = defaultdict(list)
    for block in blocks:
        if block is not None and block.instance < _IMUS:
            found[block.name, block.instance].append(block.rows)
    return {key: np.concatenate(rows) for key, rows in found.items()}


def read_ulog(path: Path) -> list[StillLog]:
    """The IMUs of a PX4 log: sensor_combined as PX4 flies by it, and each pair of sensor_gyro and sensor_accel.

    Raises:
        StorageError: one line: it cannot be read.
    """
    data = _whole(ulog.ulog(path, _TOPICS))
    dropouts = len(data.get((DROPOUTS, 0), ()))
    logs = [log for log in _ulog_imus(path, data) if log is not None]
    if not logs:
        raise StorageError(f"{path}: no samples of an IMU in it")
    notes = (f"gaps in it, in which PX4 could not write: {dropouts}",) if dropouts else ()
    return [msgspec.structs.replace(log, notes=(*log.notes, *notes)) for log in logs]


def _ulog_imus(path: Path, data: dict[tuple[str, int], Floats]) -> Iterator[StillLog | None]:
    for (topic, instance), rows in sorted(data.items()):
        times = rows[:, 0]
        if topic == "sensor_combined":
            yield _log(path, topic, times, rows[:, 1:7], np.full(len(times), np.nan), _CORRECTED)
        elif topic == "sensor_gyro" and (topic_of_force := ("sensor_accel", instance)) in data:
            # Each in its own messages: to every rate the force that is nearest in time.
            beside = data[topic_of_force]
            at = np.searchsorted(0.5 * (beside[1:, 0] + beside[:-1, 0]), times)
            readings = np.hstack([rows[:, 1:4], beside[at, 1:4]])
            yield _log(path, f"sensor{instance}", times, readings, rows[:, 4], _RAW)


def read_dataflash(path: Path) -> list[StillLog]:
    """The IMUs of an ArduPilot log, from its IMU messages.

    Raises:
        StorageError: one line: it cannot be read.
    """
    found = []
    data = {
        (_INSTANCES.get(name, k), name): rows for (name, k), rows in _whole(dataflash.dataflash(path, _KINDS)).items()
    }
    for (instance, name), rows in sorted(data.items()):
        if name not in _KINDS:
            continue
        one = _log(path, f"imu{instance}", rows[:, 0], rows[:, 1:7], rows[:, 7], _CORRECTED)
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
