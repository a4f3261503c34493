"""Where the aircraft stands and which offsets are in force, for a recording in which nobody calibrates."""

from __future__ import annotations

from collections.abc import Iterable

from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.calibration.solution.site import Whereabouts
from companion.config.sections import Config
from companion.configured import models
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.recording.details import Offsets
from companion.recording.journal import Journal


class Surroundings:
    """What a replay needs to know of the world, and the raw bytes do not say in one place."""

    def __init__(self, config: Config, vehicle: Vehicle, imus: Iterable[AutopilotImu], journal: Journal) -> None:
        self._journal = journal
        self._config, self._vehicle, self._imus = config, vehicle, {imu.name: imu for imu in imus}
        self._seen: dict[str, ImuCalibration | None] = dict.fromkeys(self._imus)
        self._where: Whereabouts | None = None

    def read_offsets(self) -> Offsets:
        """What the autopilot takes off each of its IMUs; None where that is not known."""
        return {name: imu.calibration for name, imu in self._imus.items()}

    def look(self, now_s: float) -> None:
        """Note what has changed."""
        offsets = self.read_offsets()
        if any(offsets[name] is not before for name, before in self._seen.items()):
            self._seen = offsets
            self._journal.set_in_force(now_s, "offsets", offsets)
        where = models.whereabouts(self._config, self._vehicle)
        if self._where is None or _coarse(where) != _coarse(self._where):
            self._where = where
            self._journal.set_in_force(now_s, "place", where)


def _coarse(where: Whereabouts) -> tuple[object, ...]:
    """As far as a change of the place matters: a GNSS receiver is never quite still."""
    degrees = [None if value is None else round(value, 3) for value in (where.latitude_deg, where.longitude_deg)]
    return *degrees, None if where.height_m is None else round(where.height_m, -1), where.source, where.date
