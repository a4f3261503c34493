"""Alignment of the autopilot's compasses: the aircraft turns on one place, and nobody has to know a heading."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from companion.autopilot.firmware.compass_calibration import COMPASSES, CompassCalibration
from companion.autopilot.telemetry.compass_fields import CompassFields, MeanField
from companion.configured import models
from companion.daemon.core import Core
from companion.daemon.job import Job
from companion.daemon.offsets.plan import WriteLog
from companion.daemon.poses.measuring import Estimator
from companion.daemon.poses.session import ARMED, SessionState
from companion.daemon.poses.tasks import NOT_WRITTEN, SamePlaceTask
from companion.daemon.poses.writes import AlignmentWrites, CompassStep
from companion.errors import AutopilotError, CalibrationRefusedError
from companion.estimation.alignment.compass import CompassEstimate, CompassPose, compass
from companion.estimation.alignment.faces import FACE_DEG, SIDES
from companion.estimation.alignment.poses import AlignmentRequest, HeldPose, PoseRequest, objection
from companion.estimation.means.windows import Window
from companion.estimation.records.align_record import CompassFiguresRecord, CompassRecord
from companion.estimation.solution.site import LocalEarth
from companion.estimation.solution.truth import NOTHING, truth_of, up_by_sides
from companion.physics.frames import Array, Matrix, wrap_deg
from companion.physics.units import DEG
from companion.samples import Vector

HEADING_SIGMA_DEG: Final = 2.0
"""Sigma of a heading that somebody types."""
LEANED_DEG: Final = 10.0
GOOD_DEG: Final = 3.0
"""Largest sigma of a heading that is written; the firmwares' own compass calibrations warn at about this error."""
MOST_TILT_DEG: Final = 15.0
_OWN_COMPASS_SIGMAS: Final = 3.0
RIVAL: Final = "cancel its compass calibration in the ground station"


class CompassTask(SamePlaceTask):
    """Measures hard and soft iron of all compasses of the autopilot at several headings on one place."""

    if_armed = ARMED

    def __init__(self, core: Core, request: AlignmentRequest, estimator: Estimator, fields: CompassFields) -> None:
        super().__init__(core, request)
        self._estimator, self._fields = estimator, fields
        self.imus_alone = request.sides or core.config.gradienter is None
        self.fit_from = 1
        self._compasses: dict[int, CompassCalibration] = {}
        self._found: dict[int, CompassEstimate] = {}
        self._heard: set[int] = set()
        self._left_out: list[str] = []
        self._latest: dict[int, MeanField] = {}
        self._means: list[dict[int, MeanField]] = []  # Of each pose, by compass
        self._tilts: list[tuple[Array, Matrix]] = []  # Vector up and its covariance in each pose
        self._sides = NOTHING

    async def prepare(self) -> None:
        """Read which compasses the autopilot has; raise AutopilotError if it has none."""
        why: AutopilotError | None = None
        for number in COMPASSES:
            try:
                found = await self._core.vehicle.kind.read_compass(self._core.parameters, number)
            except AutopilotError as error:
                why = why or error
            else:
                self._compasses[number] = found
        if not self._compasses:
            assert why is not None
            raise why

    def unsteady(self, window: Window) -> str | None:
        if self._fields.rival_runs:
            return f"{self._core.vehicle.name} is calibrating its own sensors: {RIVAL}"
        fields = {number: self._fields.mean(number, window.start_s, window.end_s) for number in self._compasses}
        self._heard |= {number for number, field in fields.items() if field is not None}
        for number, field in fields.items():
            if field is None and self._heard and number not in self._heard:
                self._left_out.append(f"compass {number} left out: no field of it arrives")
                del self._compasses[number]
            elif field is None:
                return f"no field of compass {number} arrives: is it connected?"
            elif field.change_gauss:
                return f"the field of compass {number} changes by {1e3 * field.change_gauss:.0f} mG: iron moves nearby"
            else:
                self._latest[number] = field
        return None

    def wish(self, state: SessionState) -> PoseRequest | None:
        left = list(SIDES.items())[len(state.poses) :]
        if not self.request.sides or not left:
            return super().wish(state)
        return PoseRequest(f"{left[0][0]}: propped up, hands off", left[0][1])

    def examine(self, state: SessionState, now: Window) -> tuple[HeldPose, str | None]:
        up = np.array(now.imus[0].accel_m_s2)
        up /= np.linalg.norm(up)
        self._sides = self._estimator.sides(now)
        if self.request.sides:
            off_deg = math.degrees(math.acos(np.clip(up @ state.wish.up, -1.0, 1.0)))
            wrong = f"tilted by {off_deg:.0f} degrees: {state.wish.words}" if off_deg > FACE_DEG else None
            return HeldPose(up, 0.0, math.inf), wrong
        pose = self._counted(state, now, up, 0.0)
        tilt_deg = math.degrees(math.acos(min(1.0, -float(pose.up[2]))))
        if tilt_deg > MOST_TILT_DEG:
            return pose, f"tilted by {tilt_deg:.0f} degrees: put it where it stands within {MOST_TILT_DEG:.0f}"
        return pose, objection(self.request, state.poses, pose)

    def fit(self, state: SessionState, local: LocalEarth) -> list[str]:
        if local.field is None:
            raise CalibrationRefusedError("the Earth's field is unknown without position and date: wait for GNSS")
        self._means.append(dict(self._latest))
        self._tilts = [self._tilt(one, local) for one in state.windows]
        least = self.total if self.request.sides else 2 if self.total > 1 and self.request.heading_deg is None else 1
        if len(state.poses) < least:
            return []
        tilt_sigma_rad = math.sqrt(max(float(np.diag(covariance)[:2].max()) for _, covariance in self._tilts))
        heading = self._known_heading(state.windows[0], local)
        for number, calibration in self._compasses.items():
            poses = [
                CompassPose(
                    up,
                    calibration.raw_gauss(field.mean_gauss),
                    np.full(3, float(field.sigma_gauss.max())),
                    (pose.heading_deg - before.heading_deg) * DEG,
                    pose.heading_sigma_deg * DEG,
                )
                for (up, _), field, pose, before in zip(
                    self._tilts,
                    (means[number] for means in self._means),
                    state.poses,
                    [state.poses[0], *state.poses],
                    strict=False,
                )
            ]
            self._found[number] = compass(poses, local.field, calibration.figures, tilt_sigma_rad, heading)
        worst_deg = max(found.sigma_rad() for found in self._found.values()) / DEG
        return [f"Heading good to {worst_deg:.1f} degrees so far"] if len(state.poses) < self.total else []

    def _tilt(self, window: Window, local: LocalEarth) -> tuple[Array, Matrix]:
        if self.request.sides:
            found = up_by_sides(window.imus, self._sides, local, [])
        else:
            seen = truth_of(window, self._estimator.alignment.model(), None, local, [], self._sides)
            found = None if seen.tilt_from is None else (seen.up, seen.up_covariance)
        if found is None:
            raise CalibrationRefusedError("the tilt is known to 3 deg only: align faces first, or connect a gradienter")
        return found

    def record(self, state: SessionState, local: LocalEarth, log: WriteLog) -> CompassRecord:
        assert local.field is not None
        log.warnings += self._left_out
        log.warnings += dict.fromkeys(words for one in self._compasses.values() for words in one.warnings)
        for number, found in self._found.items():
            if found.bent is not None:
                log.warnings.append(f"compass {number}: {found.bent}: iron near the spot, move by 5 m")
            if found.sigma_rad() > GOOD_DEG * DEG or found.strength_is_wrong:
                self.shortfall = f"compass {number}: heading only good to {found.sigma_rad() / DEG:.1f} deg"
                self.shortfall += "" if found.bent is None else f": {found.bent}: move by 5 m"
        first = next(iter(self._found.values()))
        heading_deg = (first.heading_rad / DEG + local.declination_deg) % 360.0
        log.warnings += self._beside_own_compass(state.windows[0], local, heading_deg, first.heading_sigma_rad / DEG)
        headings = [pose.heading_deg for pose in state.poses]
        return CompassRecord(
            measured_at=log.started,
            field_gauss=local.field.strength_gauss,
            inclination_deg=local.field.inclination_deg,
            declination_deg=local.declination_deg,
            tilt_deg=round(max(math.degrees(math.acos(min(1.0, -float(up[2])))) for up, _ in self._tilts), 2),
            heading_deg=round(heading_deg, 2),
            heading_sigma_deg=round(math.hypot(first.heading_sigma_rad / DEG, local.declination_sigma_deg), 2),
            turns_deg=() if self.request.sides else tuple(round(float(turn), 2) for turn in np.diff(headings)),
            compasses=tuple(self._figures_record(number, found) for number, found in self._found.items()),
        )

    def _known_heading(self, window: Window, local: LocalEarth) -> tuple[float, float] | None:
        """Return the magnetic heading of the first pose and its sigma, rad, as typed, or for one pose as our own."""
        if (heading_deg := self.request.heading_deg) is not None:
            sigma_deg = HEADING_SIGMA_DEG
        elif self.total > 1:
            return None
        else:
            own = self._own_heading(window, local, [])
            if own is None:
                raise CalibrationRefusedError("one heading needs a compass, which sends nothing: add --heading")
            heading_deg, sigma_deg = own
        return (heading_deg - local.declination_deg) * DEG, math.hypot(sigma_deg, local.declination_sigma_deg) * DEG

    def _own_heading(self, window: Window, local: LocalEarth, warnings: list[str]) -> tuple[float, float] | None:
        """Return the true heading by the companion's own compass and its sigma, deg; None: it has none."""
        own = models.compass_model(self._core.config.compass)
        if own is None or window.heading is None:
            return None
        seen = truth_of(window, self._estimator.alignment.model(), own, local, warnings, self._sides)
        if seen.heading_rad is None or seen.heading_sigma_rad is None:
            return None
        return seen.heading_rad / DEG, seen.heading_sigma_rad / DEG

    def _beside_own_compass(self, window: Window, local: LocalEarth, heading_deg: float, sigma_deg: float) -> list[str]:
        """Compare the heading found with that of the companion's own compass; return a warning if they contradict."""
        warnings: list[str] = []
        own = self._own_heading(window, local, warnings)
        if own is None:
            return warnings
        own_deg, limit_deg = own[0], _OWN_COMPASS_SIGMAS * math.hypot(own[1], sigma_deg)
        if abs(wrap_deg(own_deg - heading_deg)) >= limit_deg:
            words = f"the companion's own compass reads {own_deg % 360.0:.0f} deg, this alignment {heading_deg:.0f}"
            warnings.append(words)
        return warnings

    def _figures_record(self, number: int, found: CompassEstimate) -> CompassFiguresRecord:
        calibration, soft = self._compasses[number], found.figures.soft
        return CompassFiguresRecord(
            number=number,
            device_id=calibration.device_id,
            offset_mgauss=_rounded(1e3 * found.figures.offset_gauss, 3),
            offset_sigma_mgauss=_rounded(1e3 * found.offset_sigma_gauss, 3),
            soft_diagonal=_rounded(np.diag(soft), 5),
            soft_beside=_rounded(soft[[0, 0, 1], [1, 2, 2]], 5),
            heading_sigma_deg=round(found.sigma_rad() / DEG, 2),
            heading_sigma_leaned_deg=round(found.sigma_rad(LEANED_DEG) / DEG, 2),
            heading_before_deg=round(float(np.abs(found.errors_rad(calibration.figures)).max()) / DEG, 2),
            scatter_mgauss=round(1e3 * found.scatter_gauss, 2),
            strength=round(found.strength, 4),
        )

    async def write(self, writes: AlignmentWrites, job: Job, last: Window, log: WriteLog) -> None:
        if self._fields.rival_runs:
            raise CalibrationRefusedError(f"{self._core.vehicle.name} is calibrating its own sensors: {RIVAL}")
        steps = []
        for number, found in self._found.items():
            calibration, now = self._compasses[number], found.figures
            raw, old = calibration.raw_gauss(self._means[-1][number].mean_gauss), calibration.figures
            right = now.soft @ (raw + now.offset_gauss)
            step = right - old.soft @ (raw + old.offset_gauss)
            steps.append(CompassStep(number, calibration.changes(now), right, step))
            again = await self._core.vehicle.kind.read_compass(self._core.parameters, number)
            if again.stored != calibration.stored:
                raise CalibrationRefusedError(f"compass {number} was changed in between: align again")
        await writes.write_compasses(job, steps, self._fields, log)

    def summary(self) -> str:
        worst_deg = max(found.sigma_rad() for found in self._found.values()) / DEG
        before_deg = max(
            float(np.abs(found.errors_rad(self._compasses[number].figures)).max())
            for number, found in self._found.items()
        )
        end = "written" if self.request.write else NOT_WRITTEN
        return f"heading good to {worst_deg:.1f} deg, was up to {before_deg / DEG:.1f} deg off: {end}"


def _rounded(values: Array, digits: int) -> Vector:
    x, y, z = (round(float(value), digits) for value in values)
    return x, y, z
