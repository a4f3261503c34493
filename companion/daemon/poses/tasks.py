"""Kinds of alignment: of gradienter and accelerometers at one place, and of accelerometers in six positions."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import ClassVar, Final

import numpy as np

from companion.autopilot.firmware.imu_calibration import changes_for, whole_accelerometer
from companion.autopilot.parameters.change import Change
from companion.configured import models
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.offsets.plan import WriteLog
from companion.daemon.poses.alignment import ActiveAlignment, ActiveSixPosition
from companion.daemon.poses.session import ARMED, STAND_S, PoseTask, SessionState
from companion.errors import CalibrationRefusedError
from companion.estimation.alignment.align import Alignment, ImuAlignment, align, in_words, turned
from companion.estimation.alignment.align_model import Ground, PoseMeans
from companion.estimation.alignment.faces import BIAS, SCALE, Face, FacesEstimate, faces, missing, mounting, seen_before
from companion.estimation.alignment.poses import (
    BY_EYE_SIGMA_DEG,
    LEVEL,
    AlignmentRequest,
    HeldPose,
    PoseRequest,
    asked_turn_deg,
    objection,
    wanted_pose,
)
from companion.estimation.means.pose import CompassModel, up_in_vehicle, vehicle_heading_rad
from companion.estimation.means.windows import ImuWindow, Window
from companion.estimation.records import align_record
from companion.estimation.records.align_record import AlignmentRecord, FacesRecord, HandRecord, TurnRecord
from companion.estimation.solution.site import LocalEarth
from companion.physics.frames import Array, vector
from companion.physics.units import DEG, MG

LEAST_POSES: Final = 3
READING_SIGMA_DEG: Final = 0.005  # Noise of one mean of a gradienter (docs/reference/method.md section 3.4, table)
SLOPE_WARNING_DEG: Final = 1.5
OFFSET_WARNING_SIGMAS: Final = 4.0
EXPECTED: Final = 11  # Least number of poses in a six-position alignment
MOST: Final = 24  # Maximum
NOT_WRITTEN: Final = "not written (--write does)"
SHORTEST_S: Final = 8.0
"""Shortest time without motion in one of the six positions: fewer seconds do not show that the aircraft leans."""
POSE_SIGMA_M_S2: Final = 0.1 * MG  # Noise of the mean of one pose: eleven poses then give half the allowed bias sigma
_FIRST: Final = PoseRequest("any side down, propped up, hands off")
TURN_LIMITED_M_S2: Final = 0.5 * MG
"""Sigma of accelerometer biases above which a wrong turning angle matters more than placement on the floor marks."""


class SamePlaceTask(PoseTask):
    """Base class of alignments in which the aircraft turns at one place; `result` is the estimate."""

    result: Alignment
    stands: Sequence[PoseMeans] = ()
    zero_deg: tuple[float, float] = (0.0, 0.0)

    def __init__(self, core: Core, request: AlignmentRequest) -> None:
        self._core, self.request = core, request
        self.total = self.fit_from = request.total

    def wish(self, state: SessionState) -> PoseRequest | None:
        return wanted_pose(self.request, state.poses) if len(state.poses) < self.total else None

    def _counted(self, state: SessionState, now: Window, up: Array, first_sigma_deg: float) -> HeldPose:
        if not state.poses:
            return HeldPose(up, 0.0, first_sigma_deg)
        before, imu = state.windows[-1], now.imus[0]
        bias = (np.array(before.imus[0].gyro_rad_s) + np.array(imu.gyro_rad_s)) / 2.0
        counted = self._core.collector.imus[imu.name].counted(before.end_s, now.start_s, bias)
        turn_deg, sigma_deg = asked_turn_deg(self.request, state.poses), BY_EYE_SIGMA_DEG
        if counted is not None:
            turn_deg, sigma_deg = counted.angle_rad / DEG, counted.sigma_rad / DEG
        return HeldPose(up, state.poses[-1].heading_deg + turn_deg, sigma_deg, counted=True)

    def _stand_records(self, state: SessionState) -> tuple[align_record.StandRecord, ...]:
        return tuple(
            align_record.stand_record(stand, attitude, window.end_s - window.start_s, self.zero_deg)
            for stand, attitude, window in zip(self.stands, self.result.attitudes, state.windows, strict=True)
        )

    def _make_stands(self, state: SessionState, names: Sequence[str], north_deg: float = 0.0) -> None:
        """Set `stands` to the mean readings in each pose; of IMUs, only those in `names` are included.

        `north_deg`: angle added to each pose's heading, which then counts from true north.
        """
        stands = []
        for number, (window, pose) in enumerate(zip(state.windows, state.poses, strict=True)):
            imus, tilt = {imu.name: imu for imu in window.imus}, window.tilt
            noise_deg = (1.0, 1.0) if tilt is None else (tilt.x_sigma_deg, tilt.y_sigma_deg)
            x_sigma_deg, y_sigma_deg = (math.hypot(READING_SIGMA_DEG, each) for each in noise_deg)
            stands.append(
                PoseMeans(
                    imus=tuple(imus[name] for name in names),
                    tilt_deg=None if tilt is None else (tilt.x_deg - self.zero_deg[0], tilt.y_deg - self.zero_deg[1]),
                    tilt_sigma_deg=(x_sigma_deg, y_sigma_deg),
                    heading_rad=(pose.heading_deg + north_deg) * DEG,
                    heading_sigma_rad=pose.heading_sigma_deg * DEG,
                    on_spot=number < self.request.on_spot,
                    counted=pose.counted,
                )
            )
        self.stands = stands

    def _check_fit(self, result: Alignment) -> None:
        self.result = result
        if result.complaint is not None:
            raise CalibrationRefusedError(in_words(result.complaint, gradienter=self.request.action != "turn"))


class ZeroTask(SamePlaceTask):
    """Measures the gradienter's zero; from tilted poses also its mounting relative to each IMU."""

    imus_alone: bool = False
    if_armed: ClassVar[str | None] = ARMED

    def __init__(self, core: Core, request: AlignmentRequest, kept: ActiveAlignment) -> None:
        super().__init__(core, request)
        self.fit_from = LEAST_POSES
        self._kept_instead = ""  # Text if the new zero is less exact than the active one, which it confirms
        self._kept, self._compass = kept, models.compass_model(core.config.compass)
        gradienter = models.gradienter_model(core.config.gradienter)
        assert gradienter is not None
        assert core.config.gradienter is not None
        self._gradienter, self.zero_deg = gradienter, core.config.gradienter.offset_deg

    def wish(self, state: SessionState) -> PoseRequest | None:
        wish, (ahead, right, down) = super().wish(state), state.poses[0].up if state.poses else LEVEL
        slope_deg = math.degrees(math.atan2(math.hypot(ahead, right), -down))
        if wish is None or len(state.poses) != 1 or slope_deg <= SLOPE_WARNING_DEG:
            return wish
        return wish._replace(words=f"{wish.words}: better on flatter ground, it slopes by {slope_deg:.1f} deg")

    def examine(self, state: SessionState, now: Window) -> tuple[HeldPose, str | None]:
        if now.tilt is None:
            raise CalibrationRefusedError("no reading of the gradienter in this pose")
        try:
            up = up_in_vehicle(self._gradienter, now.tilt.x_deg, now.tilt.y_deg)
        except ValueError as error:
            raise CalibrationRefusedError(str(error)) from None
        if self._compass is None or now.heading is None:
            pose = self._counted(state, now, up, 0.1)  # headings count from the first pose
        else:
            heading_deg = vehicle_heading_rad(self._compass, now.heading.heading_deg, up) / DEG
            pose = HeldPose(up, heading_deg, math.hypot(self._compass.sigma_deg, now.heading.sigma_deg))
        return pose, objection(self.request, state.poses, pose)

    def fit(self, state: SessionState, local: LocalEarth) -> list[str]:
        magnetic = self._compass is not None and self._compass.magnetic
        self._make_stands(state, readable(state.windows), local.declination_deg if magnetic else 0.0)
        law, mounted = self._gradienter.law, self._gradienter.vehicle_from_sensor
        try:
            found = align(law, mounted, self.stands, ground(local, self._compass))
        except CalibrationRefusedError as error:
            self._kept.doubt = str(error)
            raise
        self._kept.doubt = None
        self._check_fit(found)
        return []

    def record(self, state: SessionState, local: LocalEarth, log: WriteLog) -> AlignmentRecord:
        windows = state.windows
        result, settings, tilt = self.result, self._kept.settings(), windows[0].tilt
        assert settings is not None
        if result.slope_deg > SLOPE_WARNING_DEG:
            log.warnings.append(
                f"the spot slopes by {result.slope_deg:.1f} deg: heading errors widen sigma, use one below 1.5 deg"
            )
        largest_deg, usual_deg = float(np.abs(result.offset_deg).max()), self._gradienter.sigma_deg
        if largest_deg > OFFSET_WARNING_SIGMAS * usual_deg:
            log.warnings.append(
                f"the zero is off by {largest_deg:.2f} deg, {largest_deg / usual_deg:.0f} times sigma_deg of the"
                " configuration: does the aircraft stand level on its base, not on wheels nose up?"
            )
        x_deg, y_deg = np.round(result.offset_deg, 6).tolist()
        (xx, xy), (yx, yy) = result.offset_covariance_deg2.tolist()
        degrees = _temperatures(windows[0])
        return AlignmentRecord(
            kind="tilts" if self.request.action == "tilts" else "zero",
            measured_at=log.started,
            gradienter=settings,
            offset_deg=(x_deg, y_deg),
            sigma_deg=round(float(result.offset_sigma_deg.max()), 6),
            covariance_deg2=((xx, xy), (yx, yy)),
            slope_deg=round(result.slope_deg, 3),
            checked=result.checked,
            chi_square=round(result.chi_square, 3),
            freedom=result.freedom,
            temperature_degc=tilt.temperature_degc if tilt is not None else None,
            stands=self._stand_records(state),
            imus=tuple(align_record.imu_record(imu, degrees.get(imu.name)) for imu in result.imus),
        )

    async def keep(self, record: HandRecord) -> None:
        assert isinstance(record, AlignmentRecord)
        used = self._kept.used
        zero_deg, sigma_deg = (used.offset_deg, used.sigma_deg) if used else ((0.0, 0.0), self._gradienter.sigma_deg)
        apart_deg = max(abs(new - old) for new, old in zip(record.offset_deg, zero_deg, strict=True))
        if record.kind == "zero" and sigma_deg < record.sigma_deg and apart_deg < 2.0 * record.sigma_deg:
            self._kept_instead = (
                f"sigma {record.sigma_deg:.3f} deg; the active zero agrees and has {sigma_deg:.3f}: kept"
            )
        else:
            await self._kept.keep(record)

    def summary(self) -> str:
        if self._kept_instead:
            return self._kept_instead
        (x_deg, y_deg), sigma_deg = self.result.offset_deg, self.result.offset_sigma_deg.max()
        return f"zero x {x_deg:+.3f} y {y_deg:+.3f} deg, sigma {sigma_deg:.3f}; now: companion calibrate"


class TurnTask(SamePlaceTask):
    """Measures accelerometer biases and the ground's slope; after a six-position calibration also the board's tilt."""

    def __init__(
        self, core: Core, request: AlignmentRequest, imus: Mapping[str, AutopilotImu], known: ActiveSixPosition
    ) -> None:
        super().__init__(core, request)
        self._imus, self._known = imus, known

    def examine(self, state: SessionState, now: Window) -> tuple[HeldPose, str | None]:
        up = np.array(now.imus[0].accel_m_s2)
        pose = self._counted(state, now, up / np.linalg.norm(up), 0.01)
        return pose, objection(self.request, state.poses, pose)

    def fit(self, state: SessionState, local: LocalEarth) -> list[str]:
        self._make_stands(state, readable(state.windows, among=self._imus))
        self._check_fit(turned(self.stands, ground(local, None)))
        return []

    def record(self, state: SessionState, local: LocalEarth, log: WriteLog) -> TurnRecord:
        result, degrees = self.result, _temperatures(state.windows[-1])
        if self.request.headings == 2 and _level_sigma_m_s2(result) > TURN_LIMITED_M_S2:
            log.warnings.append(
                f"the spot slopes by {result.slope_deg:.1f} deg: turn it the same way both times, or --headings 4"
            )
        first, faces = result.imus[0], self._known.record
        sides = self._known.known(first.name, self._imus[first.name].in_force, degrees.get(first.name))
        self.board = None if sides is None else mounting(first, sides, local.gravity_m_s2)
        if self.board is None and self.request.level:
            raise CalibrationRefusedError("these accelerometers have no faces alignment: align faces again")
        return TurnRecord(
            measured_at=log.started,
            slope_deg=round(result.slope_deg, 3),
            checked=result.checked,
            chi_square=round(result.chi_square, 3),
            freedom=result.freedom,
            stands=self._stand_records(state),
            imus=tuple(self._imu_record(imu, degrees.get(imu.name)) for imu in result.imus),
            board=None
            if self.board is None or faces is None
            else align_record.board_record(self.board, first.name, faces.measured_at),
        )

    def _imu_record(self, imu: ImuAlignment, temperature_degc: float | None) -> align_record.TurnImuRecord:
        whole = imu.level_bias_m_s2 + self._imus[imu.name].in_force.subtracted(temperature_degc)[3:]
        return align_record.turn_imu_record(imu, temperature_degc, whole)

    def changes(self) -> dict[str, list[Change]]:
        return {
            imu.name: changes_for(self._imus[imu.name].in_force, None, vector(imu.level_bias_m_s2))
            for imu in self.result.imus
        }

    def summary(self) -> str:
        result, board, request = self.result, self.board, self.request
        words = f"level known to {_level_sigma_m_s2(result) / MG:.2f} mg, the spot slopes by {result.slope_deg:.2f} deg"
        if board is not None:
            words += f"; the board sits at roll {board.roll_rad / DEG:+.2f}, pitch {board.pitch_rad / DEG:+.2f} deg"
        end = "level written" if request.level else "written" if request.write else NOT_WRITTEN
        return f"{words}: {end}"


def readable(windows: Sequence[Window], among: Mapping[str, AutopilotImu] | None = None) -> list[str]:
    """Return IMUs (of `among`) that measured acceleration in all poses; raise CalibrationRefusedError if none did."""
    read = [{imu.name for imu in window.imus if not imu.refused("accel")} for window in windows]
    names = [imu.name for imu in windows[0].imus if all(imu.name in each for each in read)]
    names = [name for name in names if among is None or name in among]
    if not names:
        raise CalibrationRefusedError("no IMU whose accelerometers can be read")
    return names


def ground(local: LocalEarth, compass: CompassModel | None) -> Ground:
    """Return gravity and the Earth's rotation rate; without a compass, headings count from the first pose."""
    rate, of_rate = local.rate_in_body(np.eye(3), heading_known=compass is not None)
    covariance = of_rate.copy()
    if compass is not None and compass.magnetic:
        east = local.rate_ned_rad_s[0] * local.declination_sigma_deg * DEG
        covariance[1, 1] += east**2
    return Ground(local.gravity_m_s2, local.gravity_sigma_m_s2, rate, covariance)


def _level_sigma_m_s2(found: Alignment) -> float:
    return max(float(np.sqrt(np.diag(imu.level_covariance_m2_s4))[:2].max()) for imu in found.imus)


def _temperatures(window: Window) -> dict[str, float | None]:
    return {imu.name: imu.temperature_degc for imu in window.imus}


class SixPositionTask(PoseTask):
    """Measures bias and scale of accelerometers in poses of any orientation, until every bias and scale is known."""

    total = EXPECTED
    fit_from = 1

    def __init__(self, request: AlignmentRequest, imus: Mapping[str, AutopilotImu], kept: ActiveSixPosition) -> None:
        self.request, self._imus, self._kept = request, imus, kept
        self._by_imu: dict[str, FacesEstimate] = {}
        self._missing: PoseRequest | None = _FIRST

    def wish(self, state: SessionState) -> PoseRequest | None:
        return self._missing if len(state.poses) < MOST else None

    def examine(self, state: SessionState, now: Window) -> tuple[HeldPose, str | None]:
        pose = HeldPose(np.array(now.imus[0].accel_m_s2))
        imu = next((imu for imu in now.imus if imu.name in self._by_imu), None)
        if imu is None or self._missing is None:
            return pose, None
        found = self._by_imu[imu.name]
        up = self._face(imu)[0] - found.figures[BIAS]
        again = seen_before(found, up / np.linalg.norm(up), self._imus[imu.name].in_force.orientation)
        return pose, None if again is None else f"not counted, same pose as pose {again + 1}; now {self._missing.words}"

    def fit(self, state: SessionState, local: LocalEarth) -> list[str]:
        before, self._by_imu, self._missing = self._by_imu, {}, None
        for name in readable(state.windows, among=self._imus):
            if (calibration := self._imus[name].calibration) is None:
                continue
            means = [imu for window in state.windows for imu in window.imus if imu.name == name]
            sigmas = np.array([(imu.accel_sigma_use_m_s2, imu.accel_sigma_stat_m_s2) for imu in means])
            # One sigma of the bias change in the next minutes.
            wander = np.median(np.sqrt(np.maximum(sigmas[:, 0] ** 2 - sigmas[:, 1] ** 2, 0.0)), axis=0)
            found = faces([self._face(one) for one in means], local.gravity_m_s2, local.gravity_sigma_m_s2, wander)
            self._by_imu[name] = found
            self._missing = self._missing or missing(found, calibration.orientation)
            self.total = max(self.total, found.least_poses)
        if not self._by_imu:
            raise CalibrationRefusedError("no IMU whose accelerometers can be read")
        self.stand_s = self._needed_s(state.windows[-1])
        return [
            f"Pose {stand + 1} is left out: it is off by {float(found.off_m_s2[stand]) / MG:+.1f} mg"
            for name, found in self._by_imu.items()
            for stand in set(found.left_out) - set(before[name].left_out if name in before else ())
        ]

    def record(self, state: SessionState, local: LocalEarth, log: WriteLog) -> FacesRecord:
        if self._missing is not None:
            self.shortfall = f"after {MOST} poses {self._missing.lacks}"
            log.warnings.append(self.shortfall)
        elif self.request.write:
            log.warnings += self._scales_left()
        first = next(iter(self._by_imu))
        ups = self._by_imu[first].up @ self._imus[first].in_force.orientation.T
        degrees = _temperatures(state.windows[-1])
        return FacesRecord(
            measured_at=log.started,
            gravity_m_s2=local.gravity_m_s2,
            stands=tuple(
                align_record.FaceRecord(up=vector(np.round(up, 5)), seconds=window.end_s - window.start_s)
                for up, window in zip(ups, state.windows, strict=True)
            ),
            imus=tuple(
                align_record.faces_imu_record(
                    found,
                    name=name,
                    accel_id=calibration.accel_id,
                    corrections=calibration.corrections,
                    temperature_degc=degrees.get(name),
                    running=self._kept.running(name),
                    # Bias before any offset, in the sensor's own scale, which is the scale of offsets.
                    whole_m_s2=np.asarray(calibration.accel_offset_m_s2) + found.figures[BIAS] / calibration.in_use(),
                )
                for name, found in self._by_imu.items()
                for calibration in (self._imus[name].in_force,)
            ),
        )

    def changes(self) -> dict[str, list[Change]]:
        return {
            name: whole_accelerometer(
                self._imus[name].in_force, vector(found.figures[BIAS]), vector(found.figures[SCALE])
            )
            for name, found in self._by_imu.items()
        }

    async def keep(self, record: HandRecord) -> None:
        assert isinstance(record, FacesRecord)
        await self._kept.keep(record)

    def summary(self) -> str:
        bias_mg = max(float(found.sigma[BIAS].max()) for found in self._by_imu.values()) / MG
        scale = max(float(found.sigma[SCALE].max()) for found in self._by_imu.values())
        end = "written" if self.request.write else NOT_WRITTEN
        return f"accel bias known to {bias_mg:.2f} mg, scale to {100.0 * scale:.3f} %: {end}"

    def _face(self, imu: ImuWindow) -> Face:
        """Return mean acceleration and sigma, (3,) each, in sensor axes: autopilots apply the scale in these axes."""
        turn = self._imus[imu.name].in_force.orientation.T
        return turn @ np.array(imu.accel_m_s2), np.sqrt(np.square(turn) @ np.square(imu.accel_sigma_use_m_s2))

    def _needed_s(self, last: Window) -> float:
        """Return how long the next pose must be at rest, by the noise of the last one."""
        noise_m_s2 = max(max(imu.accel_sigma_stat_m_s2) for imu in last.imus if imu.name in self._by_imu)
        needed_s = (last.end_s - last.start_s) * (noise_m_s2 / POSE_SIGMA_M_S2) ** 2
        return min(max(needed_s, SHORTEST_S), STAND_S)

    def _scales_left(self) -> Iterator[str]:
        for name, found in self._by_imu.items():
            calibration = self._imus[name].in_force
            right = calibration.in_use() / (1.0 + found.figures[SCALE])
            if calibration.scale_unused_within and (calibration.in_use(vector(right)) == 1.0).all():
                off_mg = 2e3 * float(np.abs(right - 1.0).max())
                yield (
                    f"imu {name}: scales stay 1, for PX4 starts without such as are within 1 % of it; the offsets are"
                    f" right when level, on another side up to {off_mg:.1f} mg off"
                )
