"""Accelerometers of the autopilot from stands in any orientation: measured, said, and written where that was asked for.

It needs neither a gradienter nor a level spot. Every stand says what is still missing; it ends by itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final, NamedTuple

import msgspec
import numpy as np

from companion.autopilot.firmware.imu_calibration import whole_accelerometer
from companion.autopilot.parameters.change import Change
from companion.component.statustext import Severity
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import Job
from companion.daemon.offsets.plan import WriteLog
from companion.daemon.stands.accel_writes import AccelWrites
from companion.daemon.stands.align_steps import LEVEL, Hold
from companion.daemon.stands.faces_in_force import FacesInForce
from companion.daemon.stands.stands import Asked, Stands
from companion.errors import CalibrationRefusedError
from companion.estimation.alignment.faces import BIAS, SCALE, Face, Faces, faces
from companion.estimation.alignment.missing import Missing, missing, seen_before, up_of
from companion.estimation.machine import Event
from companion.estimation.means.windows import ImuWindow, Window
from companion.estimation.records.align_record import FaceRecord, FacesImuRecord, FacesRecord, faces_imu_record
from companion.estimation.solution.site import LocalEarth
from companion.physics.frames import Array, vector
from companion.physics.units import MG

EXPECTED: Final = 12
"""How many stands it takes, about."""
MOST: Final = 24
_FIRST: Final = "any side down, propped up, hands off"


class _Known(NamedTuple):
    """What the stands so far tell."""

    by_imu: dict[str, Faces]
    wish: str | None
    """The stand that is missing, in words; None where nothing is."""
    hold: Hold = Hold(LEVEL)
    """The same as a picture."""
    unknown: tuple[str, ...] = ()
    """As in `Missing`."""


class Facing:
    """Measures accelerometers so; who may start it is the manager's."""

    def __init__(
        self, core: Core, imus: Mapping[str, AutopilotImu], stands: Stands, writes: AccelWrites, kept: FacesInForce
    ) -> None:
        self._core, self._machine, self._imus = core, core.machine, imus
        self._stands, self._writes, self._kept = stands, writes, kept

    async def run(self, job: Job, *, write: bool) -> str:
        """Measure stand after stand, work out, write; returns the result in one line.

        Raises:
            CompanionError: it failed, and why; what was written is back, or it is said what is not.
            JobCancelledError: cancelled; likewise.
        """
        windows: list[Window] = []
        known = _Known({}, _FIRST)
        local: LocalEarth | None = None
        if write:
            await self._writes.prepare()
        self._stands.begin(job, imus_alone=True)
        while known.wish is not None and len(windows) < MOST:
            windows.append(await self._next(job, known, len(windows) + 1))
            local = await self._core.local_earth()
            try:
                before, known = known, await self._core.offload(self._solve, windows, local)
            except CalibrationRefusedError:
                # Somebody's other offsets in between would do that.
                await self._stands.check_offsets()
                raise
            self._name_left_out(before, known)
        assert local is not None
        await self._stands.check_offsets()
        draft = WriteLog()
        draft.warnings += local.warnings
        if known.wish is not None:
            draft.warnings.append(f"after {MOST} stands {known.wish.partition(': ')[2]}")
        measured = self._measured(windows[-1], known.by_imu)
        try:
            if write and known.wish is None:
                changes = self._changes(known.by_imu)
                draft.warnings += self._scales_left(known.by_imu)
                await self._writes.write(job, windows[-1], changes, draft)
        finally:
            job.deliver(record := self._record(windows, known.by_imu, local, draft, measured))
        if known.wish is None:
            await self._kept.keep(record)
        if not write:
            self._machine.on(Event.NOTHING_TO_WRITE)
        elif known.wish is not None:
            raise CalibrationRefusedError(f"nothing was written: after {MOST} stands {known.wish.partition(': ')[2]}")
        return _in_words(known.by_imu, written=write)

    async def _next(self, job: Job, known: _Known, number: int) -> Window:
        def take(window: Window) -> tuple[Window, str | None]:
            names = [imu.name for imu in window.imus if imu.name in known.by_imu]
            for name in names[:1]:
                read = self._face(next(imu for imu in window.imus if imu.name == name))
                found = known.by_imu[name]
                up = read.accel_m_s2 - found.figures[BIAS]
                again = seen_before(found, up / np.linalg.norm(up), self._imus[name].in_force.orientation)
                if again is not None:
                    return window, f"it stands as in stand {again + 1}: {known.wish}"
            return window, None

        asked = Asked(number, max(EXPECTED, number), known.wish or "", known.hold, known.unknown)
        # No stand hangs on another, so that a flight in between costs nothing.
        return await self._stands.next(job, asked, take, if_armed=None)

    def _name_left_out(self, before: _Known, now: _Known) -> None:
        for name, found in now.by_imu.items():
            earlier = before.by_imu[name].left_out if name in before.by_imu else ()
            for stand in set(found.left_out) - set(earlier):
                off_mg = float(found.off_m_s2[stand]) / MG
                self._core.say(Severity.NOTICE, f"Stand {stand + 1} is left out: it is {off_mg:+.1f} mg off")

    # --- working out

    def _solve(self, windows: list[Window], local: LocalEarth) -> _Known:
        """Blocking: for a thread."""
        by_imu: dict[str, Faces] = {}
        wish: Missing | None = None
        for name, imu in self._imus.items():
            means = [one for window in windows for one in window.imus if one.name == name and not one.refused("accel")]
            if len(means) < len(windows) or imu.calibration is None:
                continue
            wander = np.median(np.array([_wander(one) for one in means]), axis=0)
            found = faces([self._face(one) for one in means], local.gravity_m_s2, local.gravity_sigma_m_s2, wander)
            by_imu[name] = found
            wish = wish or missing(found, imu.calibration.orientation)
        if not by_imu:
            raise CalibrationRefusedError("no IMU whose accelerometers can be read")
        if wish is None:
            return _Known(by_imu, None)
        return _Known(by_imu, str(wish), Hold(up_of(wish.side)), wish.unknown)

    def _face(self, imu: ImuWindow) -> Face:
        """In the sensor's own axes, in which firmwares scale."""
        calibration = self._imus[imu.name].in_force
        turn = calibration.orientation.T
        sigma = np.sqrt(np.diag(turn @ np.diag(np.square(imu.accel_sigma_use_m_s2)) @ turn.T))
        return Face(turn @ np.array(imu.accel_m_s2), sigma)

    def _changes(self, by_imu: dict[str, Faces]) -> dict[str, list[Change]]:
        return {
            name: whole_accelerometer(
                self._imus[name].in_force, vector(found.figures[BIAS]), vector(found.figures[SCALE])
            )
            for name, found in by_imu.items()
        }

    def _scales_left(self, by_imu: dict[str, Faces]) -> Iterator[str]:
        """What of the scales the firmware would not keep, in words."""
        for name, found in by_imu.items():
            calibration = self._imus[name].in_force
            right = calibration.in_use() / (1.0 + found.figures[SCALE])
            if calibration.scale_unused_within and (calibration.in_use(vector(right)) == 1.0).all():
                off_mg = 2e3 * float(np.abs(right - 1.0).max())
                yield (
                    f"imu {name}: scales stay 1, for PX4 starts without such as are within 1 % of it; the offsets are"
                    f" right when level, on another side up to {off_mg:.1f} mg off"
                )

    # --- the record

    def _measured(self, last: Window, by_imu: dict[str, Faces]) -> list[FacesImuRecord]:
        """Before anything is written."""
        degrees = {imu.name: imu.temperature_degc for imu in last.imus}
        return [
            faces_imu_record(
                found,
                name=name,
                accel_id=self._imus[name].in_force.accel_id,
                corrections=self._imus[name].in_force.corrections,
                temperature_degc=degrees.get(name),
                running=self._kept.running(name),
                whole_m_s2=self._whole_m_s2(name, found),
            )
            for name, found in by_imu.items()
        ]

    def _whole_m_s2(self, name: str, found: Faces) -> Array:
        """Bias without any offset, in the sensor's own scale, as offsets take it off."""
        calibration = self._imus[name].in_force
        return np.asarray(calibration.accel_offset_m_s2) + found.figures[BIAS] / calibration.in_use()

    def _record(
        self,
        windows: list[Window],
        by_imu: dict[str, Faces],
        local: LocalEarth,
        draft: WriteLog,
        measured: list[FacesImuRecord],
    ) -> FacesRecord:
        first = next(iter(by_imu))
        ups = by_imu[first].up @ self._imus[first].in_force.orientation.T
        return FacesRecord(
            measured_at=draft.started,
            gravity_m_s2=local.gravity_m_s2,
            stands=tuple(
                FaceRecord(up=vector(np.round(up, 5)), seconds=window.end_s - window.start_s)
                for up, window in zip(ups, windows, strict=True)
            ),
            imus=tuple(msgspec.structs.replace(one, written=draft.written.get(one.name, {})) for one in measured),
            warnings=(*draft.warnings, *(words for each in draft.imu_warnings.values() for words in each)),
        )


def _wander(imu: ImuWindow) -> Array:
    """What the bias of the next minutes is away from that of this window, (3,)."""
    use, stat = np.array(imu.accel_sigma_use_m_s2), np.array(imu.accel_sigma_stat_m_s2)
    return np.asarray(np.sqrt(np.maximum(use**2 - stat**2, 0.0)))


def _in_words(by_imu: dict[str, Faces], *, written: bool) -> str:
    bias_mg = max(float(found.sigma[BIAS].max()) for found in by_imu.values()) / MG
    scale = max(float(found.sigma[SCALE].max()) for found in by_imu.values())
    end = "written" if written else "not written (--write does)"
    return f"accel bias known to {bias_mg:.2f} mg, scale to {100.0 * scale:.3f} %: {end}"
