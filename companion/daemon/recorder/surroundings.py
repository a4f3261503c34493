"""Where the aircraft stands and which offsets are in force, for a recording in which nobody calibrates."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Iterable

from companion.autopilot.firmware.imu_calibration import ImuCalibration, ImuParameters
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.calibration.solution.site import Whereabouts
from companion.config import Config
from companion.configured import models
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.recording.journal import Journal


class Surroundings:
    """What a replay needs to know of the world, and the raw bytes do not say in one place."""

    def __init__(self, config: Config, vehicle: Vehicle, imus: Iterable[AutopilotImu]) -> None:
        self._config, self._vehicle, self._imus = config, vehicle, {imu.name: imu for imu in imus}
        self._seen: dict[str, ImuCalibration | None] = dict.fromkeys(self._imus)
        self.where = models.whereabouts(config, vehicle)
        """Place and date."""
        self.offsets = self.read_offsets()
        """As they were when somebody looked last."""

    def read_offsets(self) -> dict[str, ImuCalibration | None]:
        """What the autopilot takes off each of its IMUs; None where that is not known."""
        return {name: _plain_names(imu.calibration) for name, imu in self._imus.items()}

    def look(self, journal: Journal) -> None:
        """Note what has changed."""
        now_s = asyncio.get_running_loop().time()
        calibrations = {name: imu.calibration for name, imu in self._imus.items()}
        if any(calibrations[name] is not before for name, before in self._seen.items()):
            self._seen, self.offsets = calibrations, self.read_offsets()
            journal.event(now_s, "offsets", self.offsets)
        where = models.whereabouts(self._config, self._vehicle)
        if _coarse(where) != _coarse(self.where):
            self.where = where
            journal.event(now_s, "place", where)


def _plain_names(calibration: ImuCalibration | None) -> ImuCalibration | None:
    """Without what only one firmware knows of its parameters."""
    if calibration is None:
        return None
    names = calibration.parameters
    plain = ImuParameters(
        gyro_offset=names.gyro_offset,
        accel_offset=names.accel_offset,
        accel_scale=names.accel_scale,
        gyro_id=names.gyro_id,
        accel_id=names.accel_id,
    )
    return dataclasses.replace(calibration, parameters=plain)


def _coarse(where: Whereabouts) -> tuple[object, ...]:
    """As far as a change of the place matters: a GNSS receiver is never quite still."""
    degrees = [None if value is None else round(value, 3) for value in (where.latitude_deg, where.longitude_deg)]
    return *degrees, None if where.height_m is None else round(where.height_m, -1), where.source, where.date
