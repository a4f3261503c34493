"""Offsets that an aircraft has flown with, and their calibration: the log's parameters against the history."""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from companion.autopilot.firmware.firmwares import read_calibration
from companion.autopilot.firmware.imu_calibration import ImuCalibration, output_step
from companion.autopilot.firmware.px4_slots import SlotMemory
from companion.autopilot.parameters.change import Change
from companion.autopilot.parameters.reading import FirmwareName
from companion.autopilot.parameters.wire import same_float32
from companion.errors import AutopilotError, StorageError
from companion.estimation.records.record import Record
from companion.lab.flight.log import FlownImu
from companion.physics.frames import Floats
from companion.samples import Triad


class _Logged:
    """Parameters of a log behind the interface of an autopilot's parameters."""

    def __init__(self, firmware: FirmwareName, values: Mapping[str, float]) -> None:
        self._values = values
        self.vehicle = self
        self.name: Final = "log"
        self.firmware: Final[FirmwareName] = firmware
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


async def calibration_in(firmware: FirmwareName, values: Mapping[str, float], imu: FlownImu) -> ImuCalibration:
    """Read what the autopilot corrected an IMU with from the parameters in the log.

    Raises:
        AutopilotError: a parameter is missing.
    """
    memory = SlotMemory()
    ids: dict[Triad, int | None] = {"gyro": imu.gyro_id, "accel": imu.accel_id}
    for sensor, device_id in ids.items():
        if device_id is not None:
            memory.learn(sensor, device_id, imu.number)
    return await read_calibration(_Logged(firmware, values), imu.number, memory)


def written_in(calibration: ImuCalibration, records: Sequence[Record]) -> tuple[Record, dict[str, float]] | None:
    """Find the latest calibration that wrote the offsets in force, and the values before; records newest first.

    The offsets decide and not the time: clocks of a companion and of an autopilot may be years apart.
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
    """Return the change of the output by other offsets, rad/s and m/s^2; `accel` (3,) is the mean output."""
    own = calibration.corrections
    changes = [Change(name, own[name], value) for name, value in others.items() if name in own]
    x, y, z = accel.tolist()
    gyro, force = output_step(calibration, changes, (x, y, z))
    return np.array(gyro), np.array(force)


def parameter_file(path: Path) -> dict[str, float]:
    """Read a ground station's parameter file: NAME,VALUE or NAME VALUE a line, or QGroundControl's five columns.

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
    """Format a time in UTC, ISO 8601; None: it is not believable."""
    if unix_s is None or not 0.0 < unix_s < 1e11:
        return None
    return datetime.datetime.fromtimestamp(unix_s, tz=datetime.UTC).isoformat(timespec="seconds")
