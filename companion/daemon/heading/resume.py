"""Start of the daemon in flight: the attitude resumes with the last calibration, or not at all.

Roll and pitch come from the autopilot, the heading from the companion's compass. No attitude is sent to the autopilot
before it agrees with the autopilot's own attitude.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import msgspec
import numpy as np

from companion.attitude.quaternion import to_matrix
from companion.attitude.strapdown import HEADING_UNKNOWN_RAD
from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.autopilot.vehicle.vehicle import ArmState
from companion.configured import models
from companion.daemon.calibrating.subsystem import Calibrating
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.heading.carrier import AttitudeCarrier, MeasuredAttitude, settings_of
from companion.daemon.heading.health import HEADING_UNKNOWN, THEIR_TILT_DEG, Difference, disagreements
from companion.estimation.records.record import ImuRecord, Record
from companion.estimation.solution.site import LocalEarth, Whereabouts, local_earth
from companion.physics.frames import vector
from companion.physics.units import DEG

AGREES_S: Final = 0.7  # Time of agreement before the push starts, and of disagreement before the estimate starts anew
FRESH_S: Final = 1.0  # Largest age of the autopilot's attitude to start from; the gyros extrapolate it
LATEST: Final = 10  # Number of latest records searched for a calibration that is done
DECLINATION_SIGMA_DEG: Final = 1.0
"""One sigma of a stored declination: 0.3 to 0.5 deg from the model, the rest from the distance flown meanwhile."""


class Resume:
    """Resumes the attitude estimate in flight; call `step` several times a second until `pending` is false."""

    def __init__(
        self,
        core: Core,
        carrier: AttitudeCarrier,
        difference: Difference,
        calibrating: Calibrating,
        imu: AutopilotImu | None,
    ) -> None:
        self._core, self._carrier, self._difference, self._imu = core, carrier, difference, imu
        self._store, self._memory = calibrating.store, calibrating.memory
        self.pending = True
        self._record: Record | None = None
        self._looked = False
        self._differs: str | None = None
        self._agrees: bool | None = None
        self._since_s = self._unknown_s = 0.0

    async def step(self, now_s: float) -> None:
        carrier = self._carrier
        if not self.pending or self._core.vehicle.system_id is None:
            return
        if self._core.vehicle.arm_state is ArmState.DISARMED:
            self.pending, carrier.doubt = False, None
            carrier.forget()
            return
        known = carrier.estimator is not None and carrier.estimator.heading_known
        self._unknown_s = self._unknown_s if known else now_s
        if carrier.estimator is None or not carrier.estimator.aligned:
            self._agrees = None
            carrier.doubt = await self._begin(now_s) or self._differs or "comparing with the autopilot's attitude"
        elif known:
            self._compare(now_s)
        else:
            carrier.doubt = self._differs or HEADING_UNKNOWN

    async def _begin(self, now_s: float) -> str | None:
        name, theirs = self._carrier.imu.name, self._difference.theirs
        if theirs is None or now_s - theirs[0] > FRESH_S:
            return "waiting for the autopilot's attitude"
        if not self._looked:
            self._record, self._looked = await self._core.offload(self._latest), True
        record = self._record
        found = None if record is None else next((imu for imu in record.imus if imu.name == name), None)
        if record is None or found is None or found.gyro_bias_rad_s is None:
            return "no calibration is active"
        if self._imu is not None:
            if self._imu.calibration is None:
                return "reading the autopilot's offsets"
            found = _left_by(self._imu.calibration, found)
        if (why := self._memory.why_not_now(name, record.started_at)) is not None:
            return why
        local = await self._core.offload(_place, record, models.whereabouts(self._core.config, self._core.vehicle))
        settings = settings_of(self._core.profiles.imu(name), found, local, self._carrier.gyro_step_rad_s)
        if settings is None:
            return "no calibration is active"
        covariance = np.diag([(THEIR_TILT_DEG * DEG) ** 2] * 2 + [HEADING_UNKNOWN_RAD**2])
        stand = MeasuredAttitude(theirs[0], to_matrix(theirs[1]).T, covariance, heading_known=False, local=local)
        self._carrier.resume(settings, stand)
        return None

    def _latest(self) -> Record | None:
        done = (record for record in self._store.history(LATEST) if record.state == "done")
        record = next(done, None)
        return None if record is None or record.undone_at else record

    def _compare(self, now_s: float) -> None:
        attitude, latest = self._carrier.now(), self._difference.latest
        heard_s = self._difference.heard_s
        if attitude is None or latest is None or heard_s <= self._unknown_s or now_s - heard_s > FRESH_S:
            self._agrees = None
            return
        words = next(filter(None, disagreements(attitude, *latest)), None)
        if self._agrees is not (words is None):
            self._agrees, self._since_s = words is None, now_s
        if now_s - self._since_s < AGREES_S:
            return
        self._differs = self._carrier.doubt = words
        if words is None:
            self.pending = False
        else:
            self._carrier.forget()


def _left_by(in_force: ImuCalibration, found: ImuRecord) -> ImuRecord:
    whole = found.gyro_bias_rad_s, found.accel_bias_m_s2
    taken_off = np.split(in_force.subtracted(found.temperature_degc), 2)
    gyro, accel = (None if a is None else vector(np.subtract(a, b)) for a, b in zip(whole, taken_off, strict=True))
    return msgspec.structs.replace(found, written={}, residual_gyro_rad_s=gyro, residual_accel_m_s2=accel)


def _place(record: Record, where: Whereabouts) -> LocalEarth:
    site = record.site
    if site is None or site.declination_deg is None:
        return local_earth(where)
    local = local_earth(Whereabouts(site.latitude_deg, None, site.height_m, site.source))
    return dataclasses.replace(
        local, site=site, declination_deg=site.declination_deg, declination_sigma_deg=DECLINATION_SIGMA_DEG
    )
