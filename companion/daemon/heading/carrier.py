"""Attitude estimator of the daemon, with its samples, its calibration and its alignments."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np

from companion.attitude.estimator import Attitude, AttitudeEstimator, AttitudeSettings, Phase
from companion.attitude.quaternion import Quaternion, conjugate, from_matrix, multiply, rotate
from companion.attitude.strapdown import HEADING_UNKNOWN_RAD
from companion.autopilot.firmware.firmwares import outcomes_of
from companion.autopilot.vehicle.vehicle import ArmState, VehicleEvent
from companion.config.sections import Config, Imu
from companion.configured import models
from companion.daemon.arming.in_force import ActiveCalibration
from companion.daemon.core import Core
from companion.daemon.poses.alignment import ActiveAlignment
from companion.errors import CalibrationRefusedError
from companion.estimation.means.pose import CompassModel, GradienterModel, vehicle_heading_rad
from companion.estimation.means.windows import Window
from companion.estimation.noise.allan import noise_profile
from companion.estimation.records.record import ImuRecord
from companion.estimation.solution.site import LocalEarth, Whereabouts, local_earth
from companion.estimation.solution.truth import truth_of
from companion.physics.frames import Matrix, rotation_matrix
from companion.physics.units import DEG, MG
from companion.samples import CompassSample, ImuSample, Sample, Triad, Vector

logger = logging.getLogger(__name__)

KEPT_S: Final = 5.0
"""Time for which samples are stored, to propagate an alignment from the end of its window (up to 2 s ago) to now."""
_NO_STAND: Final = {False: "waiting for an alignment: hold still", True: "waiting for an alignment: not on a deck"}
STOOD_S: Final = 7.0
CHECK_EVERY_S: Final = 10.0
TILT_FLOOR_RAD: Final = 0.5 * DEG
HEADING_FLOOR_RAD: Final = 3.0 * DEG
DISAGREES_SIGMAS: Final = 3.0
JUMP_RAD: Final = 1.0 * DEG
"""Minimum change of heading at an alignment that is reported to the autopilot as a reset."""
SLOWEST_AIRSPEED_M_S: Final = 5.0
UNCALIBRATED_ACCEL_MG: Final = 50.0
"""One sigma of a consumer accelerometer's bias, used if only the gyros were calibrated."""
_ZERO: Final[Vector] = (0.0, 0.0, 0.0)


def carrying_imu(config: Config) -> Imu:
    """Return the IMU for the attitude: the companion's own, if any, as it is faster, unfiltered and not shared."""
    return next((imu for imu in config.imu if imu.source == "serial"), config.imu[0])


def settings_of(imu: Imu, record: ImuRecord, local: LocalEarth, gyro_step_rad_s: float) -> AttitudeSettings | None:
    serial = imu.source == "serial"
    gyro = record.gyro_bias_rad_s if serial else _left(record, record.residual_gyro_rad_s, "gyro")
    accel = record.accel_bias_m_s2 if serial else _left(record, record.residual_accel_m_s2, "accel")
    if gyro is None or record.gyro_sigma_use_rad_s is None:
        return None
    covariance = np.diag(np.square(record.gyro_sigma_use_rad_s))
    if record.covariance is not None:
        full = [row[:3] for row in record.covariance[:3]]
        if not any(value is None for row in full for value in row):
            covariance = np.array(full, dtype=np.float64)
    # Add the quantisation error: a rate below one step reads zero.
    covariance = covariance + np.eye(3) * gyro_step_rad_s**2 / 12.0
    unknown = UNCALIBRATED_ACCEL_MG * MG
    # Use the sigma for a level pose: in flight the aircraft is mostly level, unlike perhaps at calibration.
    level = record.accel_sigma_use_m_s2 if record.effective is None else record.effective.level_sigma_m_s2
    return AttitudeSettings(
        vehicle_from_sensor=rotation_matrix(imu.mounting if serial else "ROTATION_NONE"),
        gravity_m_s2=local.gravity_m_s2,
        latitude_deg=local.site.latitude_deg,
        gyro_noise=noise_profile(imu.profile).gyro,
        gyro_bias_rad_s=gyro,
        gyro_covariance=covariance,
        accel_bias_m_s2=accel or _ZERO,
        accel_sigma_m_s2=(level if accel else None) or (unknown, unknown, unknown),
    )


def _left(record: ImuRecord, residual: Vector | None, triad: Triad) -> Vector | None:
    outcomes = outcomes_of(triad, record.written)
    return _ZERO if outcomes and outcomes <= {"verified", "stored"} else residual


def without_truncation(sample: ImuSample, step_rad_s: float) -> ImuSample:
    x, y, z = (rate + math.copysign(0.5 * step_rad_s, rate) if rate else 0.0 for rate in sample.gyro_rad_s)
    return ImuSample(t_s=sample.t_s, gyro_rad_s=(x, y, z), accel_m_s2=sample.accel_m_s2)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class MeasuredAttitude:
    """Attitude of the motionless aircraft at the end of a measuring window."""

    t_s: float
    body_from_ned: Matrix
    covariance: Matrix
    """Covariance (3, 3) of the attitude error, as rotations about north, east and down, rad^2."""
    heading_known: bool
    local: LocalEarth


def standing_attitude(
    window: Window, where: Whereabouts, gradienter: GradienterModel | None, compass: CompassModel | None
) -> MeasuredAttitude:
    """Estimate the motionless aircraft's attitude; raise CalibrationRefusedError if readings disagree. Blocking."""
    local = local_earth(where)
    truth = truth_of(window, gradienter if window.tilt is not None else None, compass, local, [])
    turn = truth.body_from_ned
    covariance = turn.T @ truth.attitude_covariance_rad2 @ turn
    if truth.heading_rad is None:
        covariance[2, 2] += HEADING_UNKNOWN_RAD**2
    return MeasuredAttitude(window.end_s, turn, covariance, truth.heading_rad is not None, local)


class AttitudeCarrier:
    """Estimates the attitude from one IMU, between alignments and in flight."""

    def __init__(self, core: Core, imu: Imu, in_force: ActiveCalibration, alignment: ActiveAlignment) -> None:
        self.imu = imu
        self.estimator: AttitudeEstimator | None = None
        self.heard_s = -math.inf
        self.phase: Phase = "ground"
        self.still = False
        self.alignments = 0
        self.reset_counter = 0
        """Number of alignments at which the heading jumped."""
        self.airspeed_m_s: float | None = None
        self.gyro_step_rad_s = 0.0
        self.waiting_for = "waiting for a calibration"
        self.doubt: str | None = None
        self._core = core
        self._config, self._vehicle, self._collector = core.config, core.vehicle, core.collector
        self._in_force, self._alignment, self._offload = in_force, alignment, core.offload
        self._compass = models.compass_model(core.config.compass)
        self._local: LocalEarth | None = None
        self._record: ImuRecord | None = None
        self._recent: deque[Sequence[ImuSample]] = deque()
        """Samples of the last `KEPT_S`, one list per read; stored on the ground, and while there is no estimator."""
        self.align_wanted = False
        self._checked_s = -math.inf
        core.vehicle.on_event.add(self._on_event)

    # --- samples, in the event-loop turn that read them

    def add(self, samples: Sequence[ImuSample]) -> None:
        self.heard_s = samples[-1].t_s
        if self.phase == "ground" or self.estimator is None:
            recent = self._recent
            recent.append(samples)
            while recent[0][-1].t_s < self.heard_s - KEPT_S:
                recent.popleft()
        if self.estimator is not None:
            self.estimator.update(samples, phase=self.phase, still=self.still, airspeed_m_s=self.airspeed_m_s)

    def take_compass(self, samples: Sequence[Sample]) -> None:
        estimator, compass, local = self.estimator, self._compass, self._local
        if estimator is None or compass is None or local is None:
            return
        for sample in samples:
            if not isinstance(sample, CompassSample):
                continue
            if sample.north not in (None, "magnetic" if compass.magnetic else "true"):
                continue
            now = estimator.attitude()
            if now is None:
                return
            up = np.array(rotate(conjugate(now.quaternion), (0.0, 0.0, -1.0)))
            heading, sigma_deg = vehicle_heading_rad(compass, sample.heading_deg, up), compass.sigma_at(up)
            if compass.magnetic:
                heading += local.declination_deg * DEG
                sigma_deg = math.hypot(sigma_deg, local.declination_sigma_deg)
            estimator.add_heading(sample.t_s, heading, sigma_deg * DEG)

    def forget(self) -> None:
        self.estimator = self._record = None
        self._recent.clear()

    def now(self) -> Attitude | None:
        return None if self.estimator is None else self.estimator.attitude()

    def kept_at(self, t_s: float) -> tuple[float, Quaternion] | None:
        return None if self.estimator is None else self.estimator.kept_at(t_s)

    def _on_event(self, event: VehicleEvent) -> None:
        if event == "armed":
            self.phase, self.still = "flight", False
            self._recent.clear()
        elif event == "disarmed":
            self.phase = "ground"

    # --- calibration and alignment, a few times a second

    async def update(self, now_s: float) -> None:
        disarmed = self._vehicle.arm_state is ArmState.DISARMED
        # While the arm state is unknown, the rules for flight are the safe choice.
        self.phase = "ground" if disarmed else "flight"
        on_deck = self._config.vehicle.platform == "deck"
        self.still = disarmed and not on_deck and self._collector.glance(now_s).obstacle is None
        if not disarmed:
            return
        await self._follow_calibration()
        if self.estimator is None or not self.still:
            if self.estimator is not None and not self.estimator.aligned:
                self.waiting_for = _NO_STAND[on_deck]
            return
        lost = not self.estimator.aligned
        if self.align_wanted or lost or now_s - self._checked_s >= CHECK_EVERY_S:
            self._checked_s = now_s
            stand = await self._stand(now_s)
            if stand is not None and self._vehicle.arm_state is ArmState.DISARMED:
                self._local = stand.local
                if self.align_wanted or lost or self._disagrees(stand):
                    self._align(stand)

    async def _follow_calibration(self) -> None:
        found = self._in_force.record_of(self.imu.name)
        if found is None and self.imu.source == "serial":
            found = self._record  # an undo changes the autopilot's offsets, not the bias of our own sensor
        if found is self._record:
            return
        self._record = found
        if found is None:
            self.estimator, self.waiting_for = None, "waiting for a calibration"
            return
        local = self._local = await self._core.local_earth()
        settings = settings_of(self._core.profiles.imu(self.imu.name), found, local, self.gyro_step_rad_s)
        if settings is None:
            self.estimator, self.waiting_for = None, "waiting for a calibration of the gyros"
        elif self.estimator is None:
            self.estimator, self.align_wanted = AttitudeEstimator(settings), True
        else:
            self.estimator.settle(settings)
            self.align_wanted = True

    def resume(self, settings: AttitudeSettings, stand: MeasuredAttitude) -> None:
        self.estimator, self._local = AttitudeEstimator(settings), stand.local
        self._align(stand)

    async def _stand(self, now_s: float) -> MeasuredAttitude | None:
        try:
            window = await self._core.window(since_s=now_s - STOOD_S)
            where = models.whereabouts(self._config, self._vehicle)
            stand: MeasuredAttitude = await self._offload(
                standing_attitude, window, where, self._alignment.model(), self._compass
            )
        except CalibrationRefusedError as error:
            self.waiting_for = f"waiting for an alignment: {error}"
            return None
        return stand

    def _disagrees(self, stand: MeasuredAttitude) -> bool:
        now = self.now()
        if now is None:
            return True
        error = multiply(from_matrix(stand.body_from_ned.T), conjugate(now.quaternion))
        # Rotation error about north, east and down in rad (for large errors 2 sin(angle / 2)).
        north, east, down = (math.copysign(2.0, error[0]) * part for part in error[1:])
        tilt = math.hypot(north, east)
        own = max(now.sigma_rad[0], now.sigma_rad[1])
        tilt_sigma = math.hypot(own, math.sqrt(max(stand.covariance[0, 0], stand.covariance[1, 1])))
        heading_sigma = math.hypot(now.sigma_rad[2], math.sqrt(stand.covariance[2, 2]))
        if tilt > max(TILT_FLOOR_RAD, DISAGREES_SIGMAS * tilt_sigma):
            return True
        return stand.heading_known and abs(down) > max(HEADING_FLOOR_RAD, DISAGREES_SIGMAS * heading_sigma)

    def _align(self, stand: MeasuredAttitude) -> None:
        assert self.estimator is not None
        before = self.now()
        since = [sample for read in self._recent for sample in read if sample.t_s > stand.t_s]
        # Just after landing no samples are stored: then the attitude applies to the last sample.
        begun_s = stand.t_s if since else self.heard_s if math.isfinite(self.heard_s) else None
        self.estimator.align(begun_s, stand.body_from_ned, stand.covariance)
        self.estimator.update(since, phase=self.phase)
        after = self.now()
        self.align_wanted = False
        if after is None:
            return
        jump = math.inf if before is None else abs(math.remainder(after.yaw_rad - before.yaw_rad, 2.0 * math.pi))
        if self.alignments and jump > JUMP_RAD:
            self.reset_counter += 1
        self.alignments += 1
        roll, pitch, yaw = (angle / DEG for angle in (after.roll_rad, after.pitch_rad, after.yaw_rad))
        logger.info("attitude aligned: roll %.2f, pitch %.2f, heading %.1f deg", roll, pitch, yaw % 360.0)
