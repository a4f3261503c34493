"""Reader of IMUs at rest from files of any kind: our own recordings, autopilot logs (ULog, dataflash), CSV.

The readings in an autopilot's log are corrected by its offsets. Biases found in them are residuals after these offsets,
in the vehicle's axes.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final, Literal

import msgspec
import numpy as np

from companion.errors import StorageError
from companion.lab.autopilot_logs import DATAFLASH_MAGIC, ULOG_MAGIC, ascending, read_dataflash, read_ulog
from companion.lab.recording import MAGIC, Playback, Recording, reporting_damage
from companion.lab.still_log import NAME, StillLog, read_csv, unreadable
from companion.recording import messages
from companion.samples import ImuSample

CONTINUED_S: Final = 60.0
"""Longest gap between two recordings on the same clock that form one log, s."""
_ENCRYPTED: Final = b"ULogEnc"

LogFormat = Literal["ulog", "dataflash", "csv", "recording"]


def format_of(path: Path) -> LogFormat:
    """Identify a file's format by its first bytes; a binary file of no known format counts as a recording."""
    try:
        with path.open("rb") as file:
            head = file.read(len(MAGIC))
    except OSError as error:
        raise unreadable(path, error) from None
    if head.startswith(_ENCRYPTED):
        raise StorageError(f"{path}: encrypted by PX4: decrypt it first (Tools/log_encryption of PX4)")
    if head.startswith(ULOG_MAGIC):
        return "ulog"
    if head.startswith(DATAFLASH_MAGIC):
        return "dataflash"
    is_text = bool(head) and not MAGIC.startswith(head) and b"\0" not in head
    return "csv" if is_text else "recording"


def read_logs(
    paths: Sequence[Path], columns: str | None = None, rate_hz: float | None = None, csv_name: str = NAME
) -> list[StillLog]:
    """Read all IMUs in files of any kind, one log per IMU and run; other arguments are those of `read_csv`."""
    found: list[StillLog] = []
    for path in paths:
        match format_of(path):
            case "ulog":
                logs = read_ulog(path)
            case "dataflash":
                logs = read_dataflash(path)
            case "csv":
                logs = [read_csv(path, columns, rate_hz, csv_name)]
            case "recording":
                logs = _read_recording(path)
        if not logs:
            raise StorageError(f"{path}: no samples of an IMU in it")
        found += logs
    return _joined(found)


class _Columns:
    def __init__(self) -> None:
        self.rows = array("d")
        self.breaks_s: list[float] = []
        self.has_integers = False


def _read_recording(path: Path) -> list[StillLog]:
    recording = Recording(path)
    config = recording.config()
    playback = Playback(config)
    found = {imu.name: _Columns() for imu in config.imu}
    for topic, t_s, data in recording.read():
        with reporting_damage(path, topic):
            _add(playback, topic, t_s, data, found)
    logs = []
    for imu in config.imu:
        columns = found[imu.name]
        if not columns.rows and not columns.has_integers:
            continue
        table = ascending(np.frombuffer(columns.rows, dtype=np.float64).reshape(-1, 8))
        logs.append(
            StillLog(
                imu=imu.name,
                files=(path.name,),
                t_s=table[:, 0],
                readings=table[:, 1:7],
                temperature_degc=table[:, 7],
                profile=imu.profile,
                clock_offset_s=recording.offset_ns / 1e9,
                breaks_s=tuple(columns.breaks_s),
            )
        )
    return logs


def _add(playback: Playback, topic: str, t_s: float, data: bytes, found: dict[str, _Columns]) -> None:
    """Add the samples of a message; a change of the IMU's state is a break: readings are not comparable across it."""
    if topic == messages.START:
        playback.begin()
    for role, part in playback.take(topic, data, t_s):
        if isinstance(part, ImuSample):
            state = playback.state(role.name)
            columns = found[role.name]
            if state is not None and state.input.steps is not None:
                columns.has_integers = True
            else:
                degc = math.nan if part.temperature_degc is None else part.temperature_degc
                columns.rows.extend((part.t_s, *part.gyro_rad_s, *part.accel_m_s2, degc))
    if topic.startswith(messages.IMU):
        found[topic.removeprefix(messages.IMU)].breaks_s.append(t_s)


def _joined(logs: Iterable[StillLog]) -> list[StillLog]:
    result: list[StillLog] = []
    for log in sorted(logs, key=lambda each: (each.imu, each.began_unix_s or 0.0)):
        if not result or not _goes_on(result[-1], log):
            result.append(log)
            continue
        before = result[-1]
        result[-1] = msgspec.structs.replace(
            before,
            files=(*before.files, *log.files),
            t_s=np.concatenate([before.t_s, log.t_s]),
            readings=np.concatenate([before.readings, log.readings]),
            temperature_degc=np.concatenate([before.temperature_degc, log.temperature_degc]),
            breaks_s=(*before.breaks_s, *log.breaks_s),
        )
    return result


def _goes_on(before: StillLog, log: StillLog) -> bool:
    if before.imu != log.imu or before.clock_offset_s is None or log.clock_offset_s is None:
        return False
    if not len(before.t_s) or not len(log.t_s) or abs(before.clock_offset_s - log.clock_offset_s) > 1.0:
        return False
    return 0.0 < float(log.t_s[0] - before.t_s[-1]) < CONTINUED_S
