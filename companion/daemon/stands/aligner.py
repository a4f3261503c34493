"""The course of one alignment: stand by stand, each a still window, with words for whoever turns the aircraft.

Nobody has to press anything between the stands: a movement is seen, and the next stand begins when it has ended. So
one person alone can do it with the ground station's voice or the page; the command line only shows the same words.
"""

from __future__ import annotations

import dataclasses
import datetime
import math
from typing import Final

import numpy as np

from companion.calibration.alignment.align import Alignment, align, in_words
from companion.calibration.alignment.align_model import Ground, Stand
from companion.calibration.machine import Event
from companion.calibration.means.pose import GradienterModel, up_in_vehicle, vehicle_heading_rad
from companion.calibration.means.windows import Window
from companion.calibration.records.align_record import AlignmentRecord, imu_record, stand_record
from companion.calibration.solution.site import LocalEarth, local_earth
from companion.configured import models
from companion.daemon.core import Core
from companion.daemon.job import Job
from companion.daemon.stands import align_steps
from companion.daemon.stands.align_steps import Plan, Seen
from companion.daemon.stands.alignment import AlignmentInForce
from companion.daemon.stands.stands import Asked, Stands, imu_stand
from companion.errors import CalibrationRefusedError
from companion.physics.units import DEG

READING_SIGMA_DEG: Final = 0.005
"""What one mean of a gradienter is good for besides its zero (the gradienter noise of method section 3's table)."""
SLOPE_WARNING_DEG: Final = 1.5
OFFSET_WARNING_SIGMAS: Final = 4.0


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Taken:
    """One stand, measured; its heading counts from the compass' own north, else from the first stand."""

    window: Window
    seen: Seen
    heading_sigma_deg: float
    counted: bool = False
    """By how much it was turned since the stand before."""


class Aligner:
    """Measures alignments; who may start one is the conductor's."""

    def __init__(
        self,
        core: Core,
        stands: Stands,
        alignment: AlignmentInForce,
    ) -> None:
        self._core, self._config, self._vehicle = core, core.config, core.vehicle
        self._offload, self._machine, self._alignment = core.offload, core.machine, alignment
        self._stands = stands

    async def run(self, job: Job, plan: Plan) -> str:
        """Measure all stands, work out, keep; returns the result in one line.

        Raises:
            CompanionError: it failed, and why; the alignment before stays in force.
            JobCancelledError: cancelled; likewise.
        """
        model = models.gradienter_model(self._config.gradienter)
        settings = self._alignment.settings()
        if model is None or settings is None:
            raise CalibrationRefusedError("there is no gradienter to align: none is configured")
        local: LocalEarth | None = None
        taken: list[_Taken] = []
        result: Alignment | None = None
        self._stands.begin(job)
        while len(taken) < plan.total:
            taken.append(await self._stand(job, plan, model, taken))
            self._machine.on(Event.ENOUGH)
            if len(taken) >= min(3, plan.total):
                # What does not fit is said at once, not after five more stands.
                await self._stands.check_offsets()
                where = models.whereabouts(self._config, self._vehicle)
                local = await self._offload(local_earth, where)
                result = await self._offload(self._solve, plan, model, taken, local)
                if result.complaint is not None:
                    raise CalibrationRefusedError(in_words(result.complaint))
            if len(taken) < plan.total:
                self._machine.on(Event.MOVED)
        assert result is not None
        assert local is not None
        record = self._record(plan, result, taken, local)
        job.deliver(record)
        await self._alignment.keep(record)
        self._machine.on(Event.NOTHING_TO_WRITE)
        x_deg, y_deg = record.offset_deg
        return f"zero x {x_deg:+.3f} y {y_deg:+.3f} deg, sigma {record.sigma_deg:.3f}; now: companion calibrate"

    # --- one stand

    async def _stand(self, job: Job, plan: Plan, model: GradienterModel, taken: list[_Taken]) -> _Taken:
        """Wait until it stands as it should, and measure.

        Raises:
            CalibrationRefusedError: armed, out of time, or what was measured before is void.
            JobCancelledError: cancelled.
        """
        seen = [one.seen for one in taken]

        def take(window: Window) -> tuple[_Taken, str | None]:
            found = self._taken(plan, model, taken, window)
            return found, align_steps.objection(plan, seen, found.seen)

        asked = Asked(len(taken) + 1, plan.total, align_steps.request(plan, seen), align_steps.hold(plan, seen))
        return await self._stands.next(job, asked, take)

    def _taken(self, plan: Plan, model: GradienterModel, taken: list[_Taken], window: Window) -> _Taken:
        if window.tilt is None:
            raise CalibrationRefusedError("no reading of the gradienter in this stand")
        try:
            up = up_in_vehicle(model, window.tilt.x_deg, window.tilt.y_deg)
        except ValueError as error:
            raise CalibrationRefusedError(str(error)) from None
        compass = models.compass_model(self._config.compass)
        if compass is not None and window.heading is not None:
            heading = vehicle_heading_rad(compass, window.heading.heading_deg, up) / DEG
            sigma = math.hypot(compass.sigma_deg, window.heading.sigma_deg)
        elif taken:
            turn, sigma = self._stands.turned_deg(plan, [one.window for one in taken], window)
            return _Taken(window, Seen(up, taken[-1].seen.heading_deg + turn), sigma, counted=True)
        else:
            heading, sigma = 0.0, 0.1  # north is where it points first
        return _Taken(window, Seen(up, heading), sigma)

    # --- the result

    def _solve(self, plan: Plan, model: GradienterModel, taken: list[_Taken], local: LocalEarth) -> Alignment:
        """Blocking: for a thread."""
        names = [
            imu.name
            for imu in taken[0].window.imus
            if all(imu.name in {one.name for one in each.window.imus if not one.refused("accel")} for each in taken)
        ]
        if not names:
            raise CalibrationRefusedError("no IMU whose accelerometers can be read")
        stands = self._as_stands(plan, taken, names, local)
        return align(model.law, model.vehicle_from_sensor, stands, self._ground(local))

    def _as_stands(self, plan: Plan, taken: list[_Taken], names: list[str], local: LocalEarth) -> list[Stand]:
        compass = self._config.compass
        north_deg = local.declination_deg if compass is not None and compass.reference == "magnetic" else 0.0
        return [self._as_stand(one, names, north_deg, on_spot=k < plan.on_spot) for k, one in enumerate(taken)]

    def _as_stand(self, taken: _Taken, names: list[str], north_deg: float, *, on_spot: bool) -> Stand:
        window, tilt, configured = taken.window, taken.window.tilt, self._configured
        assert tilt is not None
        imus = {imu.name: imu for imu in window.imus}
        return Stand(
            imus=tuple(imu_stand(imus[name]) for name in names),
            tilt_deg=(tilt.x_deg - configured[0], tilt.y_deg - configured[1]),
            tilt_sigma_deg=(
                math.hypot(READING_SIGMA_DEG, tilt.x_sigma_deg),
                math.hypot(READING_SIGMA_DEG, tilt.y_sigma_deg),
            ),
            heading_rad=(taken.seen.heading_deg + north_deg) * DEG,
            heading_sigma_rad=taken.heading_sigma_deg * DEG,
            on_spot=on_spot,
            counted=taken.counted,
        )

    @property
    def _configured(self) -> tuple[float, float]:
        gradienter = self._config.gradienter
        return (0.0, 0.0) if gradienter is None else gradienter.offset_deg

    def _ground(self, local: LocalEarth) -> Ground:
        compass = models.compass_model(self._config.compass)
        rate = local.rate_in_body(np.eye(3), heading_known=compass is not None)
        covariance = rate.covariance.copy()
        if compass is not None and compass.magnetic:
            east = local.rate_ned_rad_s[0] * local.declination_sigma_deg * DEG
            covariance[1, 1] += east**2
        return Ground(local.gravity_m_s2, local.gravity_sigma_m_s2, rate.mean, covariance)

    def _record(self, plan: Plan, result: Alignment, taken: list[_Taken], local: LocalEarth) -> AlignmentRecord:
        settings = self._alignment.settings()
        assert settings is not None
        names = [imu.name for imu in result.imus]
        stands = self._as_stands(plan, taken, names, local)
        degrees = {imu.name: imu.temperature_degc for imu in taken[0].window.imus}
        offset, covariance = result.offset_deg, result.offset_covariance_deg2
        tilt = taken[0].window.tilt
        return AlignmentRecord(
            kind=plan.kind,
            measured_at=datetime.datetime.now(tz=datetime.UTC).isoformat(timespec="milliseconds"),
            gradienter=settings,
            offset_deg=(round(float(offset[0]), 6), round(float(offset[1]), 6)),
            sigma_deg=round(float(result.offset_sigma_deg.max()), 6),
            covariance_deg2=tuple((float(row[0]), float(row[1])) for row in covariance),  # type: ignore[arg-type]
            slope_deg=round(result.slope_deg, 3),
            checked=result.checked,
            chi_square=round(result.chi_square, 3),
            freedom=result.freedom,
            temperature_degc=tilt.temperature_degc if tilt is not None else None,
            stands=tuple(
                stand_record(stand, result, k, taken[k].window.end_s - taken[k].window.start_s, self._configured)
                for k, stand in enumerate(stands)
            ),
            imus=tuple(imu_record(imu, degrees.get(imu.name)) for imu in result.imus),
            warnings=(*local.warnings, *self._warnings(result)),
        )

    def _warnings(self, result: Alignment) -> list[str]:
        found = []
        if result.slope_deg > SLOPE_WARNING_DEG:
            found.append(
                f"the spot slopes by {result.slope_deg:.1f} deg, so that each degree of heading error counts: a flatter"
                " one gives a better zero"
            )
        gradienter = models.gradienter_model(self._config.gradienter)
        largest = float(np.abs(result.offset_deg).max())
        if gradienter is not None and largest > OFFSET_WARNING_SIGMAS * gradienter.sigma_deg:
            found.append(
                f"the zero is off by {largest:.2f} deg, {largest / gradienter.sigma_deg:.0f} times sigma_deg of the"
                " configuration: does the aircraft stand level on its base, not on wheels nose up?"
            )
        return found
