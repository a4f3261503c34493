"""IMUs at rest in files of any kind: our own recordings, logs of autopilots (ULog, dataflash), CSV.

The readings in an autopilot's log are those that it flies by, its offsets taken off: biases found in them are what the
offsets leave, in the vehicle's axes.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from companion.config.sections import Config
from companion.errors import StorageError
from companion.lab.logs.autopilot_logs import reader_of
from companion.lab.logs.recording import UNUSABLE, Head, Playback, Recording, config_of, is_text
from companion.lab.logs.still_log import NAME, StillLog, read_csv
from companion.recording import messages
from companion.samples import ImuSample

CONTINUED_S: Final = 60.0
"""A recording that begins within so much of another's end, on the same clock, goes on with it."""


def read_logs(
    paths: Sequence[Path], columns: str | None = None, rate_hz: float | None = None, csv_name: str = NAME
) -> list[StillLog]:
    """All IMUs in all files of any kind, one entry for each IMU and session; the rest as for `read_csv`."""
    found: list[StillLog] = []
    for path in paths:
        try:
            text, autopilots = is_text(path), reader_of(path)
        except OSError as error:
            raise StorageError(f"{path}: cannot be read: {error.strerror or error}") from None
        if autopilots is not None:
            logs = autopilots(path)
        elif text:
            logs = [read_csv(path, columns, rate_hz, csv_name)]
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
