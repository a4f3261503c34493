"""The course of one alignment of the gradienter: stand by stand, each a still window."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from companion.configured import models
from companion.daemon.core import Core
from companion.daemon.job import Job
from companion.daemon.stands.align_steps import Plan, Seen
from companion.daemon.stands.alignment import AlignmentInForce
from companion.daemon.stands.stands import Stands
from companion.daemon.stands.taken import Taken, ground, readable
from companion.errors import CalibrationRefusedError
from companion.estimation.alignment.align import Alignment, align, in_words
from companion.estimation.alignment.align_model import Stand
from companion.estimation.machine import Event
from companion.estimation.means.pose import GradienterModel, up_in_vehicle, vehicle_heading_rad
from companion.estimation.means.windows import Window
from companion.estimation.records.align_record import AlignmentRecord, imu_record, stand_record
from companion.estimation.solution.site import LocalEarth
from companion.formats import utc_now
from companion.physics.units import DEG

LEAST_STANDS: Final = 3
"""Of every plan: the first that tell a zero."""
SLOPE_WARNING_DEG: Final = 1.5
OFFSET_WARNING_SIGMAS: Final = 4.0


class Aligner:
    """Measures alignments; who may start one is the manager's."""

    def __init__(self, core: Core, stands: Stands, alignment: AlignmentInForce) -> None:
        self._core, self._config, self._stands, self._alignment = core, core.config, stands, alignment
        self._zero_deg = (0.0, 0.0) if core.config.gradienter is None else core.config.gradienter.offset_deg
        """As configured."""

    def why_not(self) -> str | None:
        """Why there is nothing to measure; None where all is well."""
        has_one = self._config.gradienter is not None
        return None if has_one else "there is no gradienter to align: none is configured"

    async def run(self, job: Job, plan: Plan) -> str:
        """Measure all stands, work out, keep; returns the result in one line.

        Raises:
            CompanionError: it failed, and why; the alignment before stays in force.
            JobCancelledError: cancelled; likewise.
        """
        model = models.gradienter_model(self._config.gradienter)
        assert model is not None
        taken: list[Taken] = []

        def see(window: Window) -> Taken:
            return self._seen(plan, model, taken, window)

        self._stands.begin(job)
        while len(taken) < plan.total:
            taken.append(await self._stands.take(job, plan, taken, see))
            if len(taken) >= LEAST_STANDS:
                # What does not fit is said at once, not after five more stands.
                await self._stands.check_offsets()
                local = await self._core.local_earth()
                result = await self._core.offload(self._solve, plan, model, taken, local)
                if result.complaint is not None:
                    raise CalibrationRefusedError(in_words(result.complaint))
        record = self._record(plan, result, taken, local)
        job.deliver(record)
        await self._alignment.keep(record)
        self._core.machine.on(Event.NOTHING_TO_WRITE)
        x_deg, y_deg = record.offset_deg
        return f"zero x {x_deg:+.3f} y {y_deg:+.3f} deg, sigma {record.sigma_deg:.3f}; now: companion calibrate"

    # --- one stand

    def _seen(self, plan: Plan, model: GradienterModel, taken: Sequence[Taken], window: Window) -> Taken:
        if window.tilt is None:
            raise CalibrationRefusedError("no reading of the gradienter in this stand")
        try:
            up = up_in_vehicle(model, window.tilt.x_deg, window.tilt.y_deg)
        except ValueError as error:
            raise CalibrationRefusedError(str(error)) from None
        compass = models.compass_model(self._config.compass)
        if compass is None or window.heading is None:
            return self._stands.turned(plan, taken, window, up, 0.1)  # north is where it points first
        heading = vehicle_heading_rad(compass, window.heading.heading_deg, up) / DEG
        return Taken(window, Seen(up, heading), math.hypot(compass.sigma_deg, window.heading.sigma_deg))

    # --- the result

    def _solve(self, plan: Plan, model: GradienterModel, taken: list[Taken], local: LocalEarth) -> Alignment:
        """Blocking: for a thread."""
        stands = self._as_stands(plan, taken, readable(taken), local)
        around = ground(local, models.compass_model(self._config.compass))
        return align(model.law, model.vehicle_from_sensor, stands, around)

    def _as_stands(self, plan: Plan, taken: list[Taken], names: list[str], local: LocalEarth) -> list[Stand]:
        compass = self._config.compass
        north_deg = local.declination_deg if compass is not None and compass.reference == "magnetic" else 0.0
        return [
            one.as_stand(names, on_spot=k < plan.on_spot, north_deg=north_deg, zero_deg=self._zero_deg)
            for k, one in enumerate(taken)
        ]

    def _record(self, plan: Plan, result: Alignment, taken: list[Taken], local: LocalEarth) -> AlignmentRecord:
        settings = self._alignment.settings()
        assert settings is not None
        names = [imu.name for imu in result.imus]
        stands = self._as_stands(plan, taken, names, local)
        degrees = {imu.name: imu.temperature_degc for imu in taken[0].window.imus}
        offset, covariance = result.offset_deg, result.offset_covariance_deg2
        tilt = taken[0].window.tilt
        return AlignmentRecord(
            kind=plan.kind,
            measured_at=utc_now(),
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
                stand_record(stand, result, k, taken[k].seconds, self._zero_deg) for k, stand in enumerate(stands)
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
