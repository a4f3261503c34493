"""The course of one alignment: stand by stand, each a still window, with words for whoever turns the aircraft.

Nobody has to press anything between the stands: a movement is seen, and the next stand begins when it has ended. So
one person alone can do it with the ground station's voice or the page; the command line only shows the same words.
"""

from __future__ import annotations

import asyncio
import dataclasses
import datetime
import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from companion.calibration.alignment.align import Alignment, align, in_words
from companion.calibration.alignment.align_model import Ground, ImuStand, Stand
from companion.calibration.alignment.align_record import AlignmentRecord, imu_record, stand_record
from companion.calibration.machine import Event
from companion.calibration.means.pose import GradienterModel, up_in_vehicle, vehicle_heading_rad
from companion.calibration.means.windows import Window
from companion.calibration.solution.site import LocalEarth, local_earth
from companion.component.statustext import Severity
from companion.configured import models
from companion.daemon.calibrating import align_steps
from companion.daemon.calibrating.align_steps import Plan, Seen
from companion.daemon.calibrating.alignment import AlignmentInForce
from companion.daemon.calibrating.course import POLL_S, Measuring
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import Job
from companion.errors import CalibrationRefusedError
from companion.physics.units import DEG

STAND_S: Final = 12.0
"""Seconds of stillness for each stand: averaging beyond 10 s buys an accelerometer nothing (method section 2.3)."""
SETTLE_S: Final = 1.0
READING_SIGMA_DEG: Final = 0.005
"""What one mean of a gradienter is good for besides its zero (the gradienter noise of method section 3's table)."""
GYRO_TURN_SIGMA_DEG: Final = 3.0
"""Sigma of a half turn by the gyros alone: scale errors of 1 %, and an axis that is not vertical."""
SLOPE_WARNING_DEG: Final = 1.5
OFFSET_WARNING_SIGMAS: Final = 4.0

ARMED: Final = "armed during the alignment; the earlier one stays in force"


def _changed(name: str) -> CalibrationRefusedError:
    return CalibrationRefusedError(f"the offsets of imu {name} were changed in between: align again")


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Taken:
    """One stand, measured; its heading counts from the compass' own north."""

    window: Window
    seen: Seen
    heading_sigma_deg: float
    offsets: dict[str, dict[str, float]]


class Aligner:
    """Measures alignments; who may start one is the conductor's."""

    def __init__(
        self,
        core: Core,
        imus: Mapping[str, AutopilotImu],
        measuring: Measuring,
        alignment: AlignmentInForce,
    ) -> None:
        self._core, self._config, self._vehicle, self._collector = core, core.config, core.vehicle, core.collector
        self._offload, self._say = core.offload, core.say
        self._machine, self._imus, self._measuring, self._alignment = core.machine, imus, measuring, alignment
        self._stand_s = max(STAND_S, core.config.calibration.min_still_s)

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
        while len(taken) < plan.total:
            taken.append(await self._stand(job, plan, model, taken))
            self._machine.on(Event.ENOUGH)
            if len(taken) >= min(3, plan.total):
                # What does not fit is said at once, not after five more stands.
                for name, imu in self._imus.items():
                    # Somebody may have changed its offsets without a word.
                    if not await imu.refresh():
                        raise _changed(name)
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
        loop = asyncio.get_running_loop()
        number, seen = len(taken) + 1, [one.seen for one in taken]
        wish = align_steps.request(plan, seen)
        self._say(Severity.NOTICE, f"Align {number}/{plan.total}: {wish}")
        # Whoever asks may yet put it down on a better spot: what was before that does not count.
        since_s = taken[-1].window.end_s if taken else loop.time()
        moved, why = not taken, ""
        while True:
            now_s = loop.time()
            status, waiting_for, hold_still_s = await self._measuring.read_state(job, ARMED)
            self._check_offsets(taken)
            moving = self._collector.glance(now_s).moving
            if moving:
                moved, since_s = True, now_s
            still_s = min(status.still_s, now_s - since_s - SETTLE_S)
            share = min(max(still_s, 0.0) / self._stand_s, 1.0) if moved and waiting_for is None else 0.0
            if not moved:
                words = f"{why or f'{number - 1} done. Now {wish}'}; waiting for it to move"
            elif waiting_for is not None:
                # Once it stands again, what to do is said by itself.
                words = waiting_for if hold_still_s is not None else f"{why or wish}; {waiting_for}"
            else:
                words = f"measuring, {max(still_s, 0.0):.0f} of {self._stand_s:.0f} s, hands off"
            self._measuring.show(measuring=share > 0.0)
            job.progress(100.0 * (number - 1 + share) / plan.total, f"{number} of {plan.total}: {words}")
            if moved and waiting_for is None and still_s >= self._stand_s:
                found = await self._measure(model, taken, since_s)
                objection = align_steps.objection(plan, seen, found.seen)
                if objection is None:
                    return found
                moved, why = False, objection
                self._measuring.show(measuring=False)
                self._say(Severity.NOTICE, f"Align: {objection}")
            await job.pause(POLL_S)

    def _check_offsets(self, taken: list[_Taken]) -> None:
        """Raises CalibrationRefusedError where what was measured before is void."""
        for name, offsets in self._offsets().items() if taken else ():
            if taken[0].offsets.get(name, offsets) != offsets:
                raise _changed(name)

    def _offsets(self) -> dict[str, dict[str, float]]:
        return {name: imu.calibration.offsets for name, imu in self._imus.items() if imu.calibration is not None}

    async def _measure(self, model: GradienterModel, taken: list[_Taken], since_s: float) -> _Taken:
        window = await self._core.window(since_s=since_s + SETTLE_S)
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
            heading = taken[-1].seen.heading_deg + self._turned_deg(taken[-1].window, window)
            sigma = GYRO_TURN_SIGMA_DEG
        else:
            heading, sigma = 0.0, 0.1  # north is where it points first
        return _Taken(window, Seen(up, heading), sigma, self._offsets())

    def _turned_deg(self, before: Window, now: Window) -> float:
        """By the gyros: the first IMU's means, second by second, about down."""
        name = now.imus[0].name
        bias = (before.imus[0].gyro_rad_s[2] + now.imus[0].gyro_rad_s[2]) / 2.0
        rates = self._collector.snapshot(before.end_s, None).rates_rad_s(name)
        between = [float(rate[2]) for second, rate in rates.items() if second < now.start_s]
        return align_steps.turned_deg(between, bias)

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
            imus=tuple(
                ImuStand(
                    name,
                    np.array(imus[name].accel_m_s2),
                    np.array(imus[name].accel_sigma_use_m_s2),
                    np.array(imus[name].gyro_rad_s),
                    np.array(imus[name].gyro_sigma_use_rad_s),
                )
                for name in names
            ),
            tilt_deg=(tilt.x_deg - configured[0], tilt.y_deg - configured[1]),
            tilt_sigma_deg=(
                math.hypot(READING_SIGMA_DEG, tilt.x_sigma_deg),
                math.hypot(READING_SIGMA_DEG, tilt.y_sigma_deg),
            ),
            heading_rad=(taken.seen.heading_deg + north_deg) * DEG,
            heading_sigma_rad=taken.heading_sigma_deg * DEG,
            on_spot=on_spot,
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
