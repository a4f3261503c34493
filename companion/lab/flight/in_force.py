"""Whose offsets an aircraft has flown with: the log's parameters against the history of calibrations."""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from companion.autopilot.firmware.firmwares import read_calibration
from companion.autopilot.firmware.imu_calibration import ImuCalibration, output_step
from companion.autopilot.firmware.px4 import SlotMemory
from companion.autopilot.parameters.change import Change
from companion.autopilot.parameters.wire import same_float32
from companion.autopilot.vehicle.vehicle import Firmware
from companion.errors import AutopilotError, StorageError
from companion.estimation.records.record import Record
from companion.lab.flight.log import FlownImu
from companion.physics.frames import Floats
from companion.samples import Triad


class _Logged:
    """The parameters of a log, asked for as those of an autopilot."""

    def __init__(self, firmware: Firmware, values: Mapping[str, float]) -> None:
        self._values = values
        self.vehicle = self
        self.name: Final = "log"
        self.firmware: Final[Firmware] = firmware
        self.boots: Final = 1

    async def hear_boot_time(self) -> bool:
        """A log is of one start."""
        return True

    async def read(self, name: str) -> float:
        if name not in self._values:
            raise AutopilotError(f"the log has no parameter {name}")
        return self._values[name]

    async def read_optional(self, name: str) -> float | None:
        return self._values.get(name)

    async def read_many(self, names: Iterable[str], *, optional: bool = False) -> dict[str, float]:
        return {name: await self.read(name) for name in names if not optional or name in self._values}


async def calibration_in(firmware: Firmware, values: Mapping[str, float], imu: FlownImu) -> ImuCalibration:
    """What the autopilot corrected an IMU with, by the parameters in the log.

    Raises:
        AutopilotError: they do not say.
    """
    memory = SlotMemory()
    ids: dict[Triad, int | None] = {"gyro": imu.gyro_id, "accel": imu.accel_id}
    for sensor, device_id in ids.items():
        if device_id is not None:
            memory.learn(sensor, device_id, imu.number)
    return await read_calibration(_Logged(firmware, values), imu.number, memory)


def written_in(calibration: ImuCalibration, records: Sequence[Record]) -> tuple[Record, dict[str, float]] | None:
    """The latest calibration that wrote the offsets in force, and what was there before it; records newest first.

    By the offsets and not by the time: clocks of a companion and of an autopilot may be years apart.
    """
    in_force = calibration.offsets
    for record in records:
        if record.state != "done" or record.undone_at:
            continue
        written = {name: one for imu in record.imus for name, one in imu.written.items() if name in in_force}
        if written and all(same_float32(one.after, in_force[name]) for name, one in written.items()):
            return record, {name: one.before for name, one in written.items() if one.before is not None}
    return None


def with_others(calibration: ImuCalibration, others: Mapping[str, float], accel: Floats) -> tuple[Floats, Floats]:
    """What the output has more with other offsets, rad/s and m/s^2; `accel` (3,) is the mean output."""
    own = calibration.corrections
    changes = [Change(name, own[name], value) for name, value in others.items() if name in own]
    x, y, z = accel.tolist()
    gyro, force = output_step(calibration, changes, (x, y, z))
    return np.array(gyro), np.array(force)


def parameter_file(path: Path) -> dict[str, float]:
    """Of a ground station: NAME,VALUE or NAME VALUE a line, or QGroundControl's five columns.

    Raises:
        StorageError: it cannot be read, or is none.
    """
    try:
        lines = path.read_text(encoding="utf-8", errors="replace")[: 1 << 22].splitlines()
    except OSError as error:
        raise StorageError(f"{path}: cannot be read: {error.strerror or error}") from None
    found: dict[str, float] = {}
    for line in lines:
        words = line.split("#")[0].replace(",", " ").replace("=", " ").split()
        name, value = words[2:4] if len(words) == 5 else words if len(words) == 2 else ("", "")
        try:
            found[name] = float(value)
        except ValueError:
            continue
    if not found:
        raise StorageError(f"{path}: no parameters in it: a line is NAME,VALUE")
    return found


def moment(unix_s: float | None) -> str | None:
    """UTC, ISO 8601."""
    if unix_s is None or not 0.0 < unix_s < 1e11:
        return None
    return datetime.datetime.fromtimestamp(unix_s, tz=datetime.UTC).isoformat(timespec="seconds")
