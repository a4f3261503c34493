"""Logs of IMUs in files of any kind as columns of numbers: our own recordings, and logs of others."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from companion.autopilot.telemetry import imu_messages
from companion.config.sections import Config, Noise
from companion.errors import StorageError
from companion.recording import topics
from companion.recording.walk import Attachment, Message, Metadata, Recording, is_text
from companion.replay import autopilot_logs, csv_log
from companion.replay.log import NAME, StillLog

TRUNCATED: Final = frozenset(
    message.kind.message
    for every in (imu_messages.ARDUPILOT, imu_messages.PX4)
    for messages in every.values()
    for message in messages
    if message.kind.truncates
)
"""Messages of whole mrad/s and mg: their steps hide what a profile is about."""
BREAKING: Final = frozenset({"reset", "imu"})
"""Events of the journal after which readings cannot be compared with those before."""
CONTINUED_S: Final = 60.0
"""A recording that begins within so much of another's end, on the same clock, goes on with it."""


def read_logs(
    paths: Sequence[Path], columns: str | None = None, rate_hz: float | None = None, csv_name: str = NAME
) -> list[StillLog]:
    """All IMUs in all files of any kind, one entry for each IMU and session; the rest as for `csv_log.read`.

    Raises:
        StorageError: a file cannot be read, in one line.
    """
    found: list[StillLog] = []
    for path in paths:
        try:
            text, autopilots = is_text(path), autopilot_logs.reader_of(path)
        except OSError as error:
            raise StorageError(f"{path}: cannot be read: {error.strerror or error}") from None
        if autopilots is not None:
            found += autopilots(path)
        elif text:
            found.append(csv_log.read(path, columns, rate_hz, csv_name))
        else:
            found += _read_recording(path)
    return _joined(found)


def _read_recording(path: Path) -> list[StillLog]:
    imu_entry = msgspec.json.Decoder(topics.ImuEntry)
    journal = msgspec.json.Decoder(topics.JournalEntry)
    breaks: list[float] = []
    entries: dict[str, list[topics.ImuEntry]] = {}
    truncated: set[str] = set()
    profiles: dict[str, str | Noise | None] = {}
    offset_s: float | None = None
    for item in Recording(path).items(lambda topic: topic == topics.JOURNAL or topic.startswith(topics.IMU)):
        if isinstance(item, Message):
            try:
                entry = (journal if item.topic == topics.JOURNAL else imu_entry).decode(item.data)
            except msgspec.MsgspecError as error:
                raise StorageError(
                    f"{path}: a message on {item.topic} cannot be used by this version ({error})"
                ) from None
            if isinstance(entry, topics.JournalEntry):
                if entry.event in BREAKING:
                    breaks.append(entry.t_s)
                continue
            name = item.topic.removeprefix(topics.IMU)
            own = entries.setdefault(name, [])
            if entry.message in TRUNCATED:
                truncated.add(name)
            elif not own or entry.t_s > own[-1].t_s:
                own.append(entry)
        elif isinstance(item, Metadata) and item.name == topics.METADATA:
            offset_s = _offset(item.table)
        elif isinstance(item, Attachment) and item.name == topics.CONFIG:
            profiles = _profiles(item.data)
    if not entries:
        raise StorageError(f"{path}: no samples of an IMU in it")
    logs = []
    for name, own in entries.items():
        t_s = np.array([entry.t_s for entry in own], dtype=np.float64)
        rows = np.array([(*entry.gyro_rad_s, *entry.accel_m_s2) for entry in own], dtype=np.float64).reshape(-1, 6)
        temperatures = [math.nan if entry.temperature_degc is None else entry.temperature_degc for entry in own]
        logs.append(
            StillLog(
                imu=name,
                files=(path.name,),
                began_unix_s=None if offset_s is None or not own else own[0].t_s + offset_s,
                t_s=t_s,
                readings=rows,
                temperature_degc=np.array(temperatures, dtype=np.float64),
                profile=profiles.get(name),
                truncated=name in truncated and not own,
                clock_offset_s=offset_s,
                breaks_s=tuple(breaks),
            )
        )
    return logs


def _offset(table: dict[str, str]) -> float | None:
    try:
        return float(table["unix_s"]) - float(table["t_s"])
    except (KeyError, ValueError):
        return None


def _profiles(data: bytes) -> dict[str, str | Noise | None]:
    """By IMU; a configuration of another version only costs the comparison."""
    try:
        config = msgspec.json.decode(data, type=Config)
    except msgspec.MsgspecError:
        return {}
    return {imu.name: imu.profile for imu in config.imu}


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
