"""The calibrations of a recording again, from the windows that were measured to the records that were written."""

from __future__ import annotations

import datetime
from typing import Final

import msgspec
import numpy as np

from companion.autopilot.firmware.imu_calibration import ImuCalibration, whole_of
from companion.config.sections import Config
from companion.configured import models
from companion.configured.models import aligned
from companion.errors import CalibrationRefusedError
from companion.estimation.collector.measurement import Measurement
from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.means.windows import Window
from companion.estimation.records.record import AlignmentUsed, Record
from companion.estimation.request import What
from companion.estimation.solution.joint import weigh
from companion.estimation.solution.otherwise import NOTHING, Otherwise
from companion.estimation.solution.results import record_of
from companion.estimation.solution.site import Whereabouts, local_earth
from companion.estimation.solution.solve import ImuSolution, Solution, solve
from companion.physics.frames import Array
from companion.recording.messages import Measured, Solved

TOLERANCE_SIGMAS: Final = 0.01
"""The most that a replayed bias may differ from the recorded one, in its sigma_use."""
_SIGMAS: Final = {
    "gyro_bias_rad_s": "gyro_sigma_use_rad_s",
    "residual_gyro_rad_s": "gyro_sigma_use_rad_s",
    "accel_bias_m_s2": "accel_sigma_use_m_s2",
    "residual_accel_m_s2": "accel_sigma_use_m_s2",
}
"""What is compared, and the sigma that it is compared in."""

Offsets = dict[str, ImuCalibration | None]


class Difference(msgspec.Struct, frozen=True):
    """One bias that came out different."""

    field: str
    """Such as imus[fc].gyro_bias_rad_s[0]."""
    recorded: float | None
    replayed: float | None
    sigmas: float | None
    """Difference in sigma_use; None where one of them is missing."""

    def __str__(self) -> str:
        size = "" if self.sigmas is None else f" ({self.sigmas:.2g} sigma)"
        return f"{self.field}: recorded {self.recorded!r}, replayed {self.replayed!r}{size}"


class Replayed(msgspec.Struct, frozen=True):
    """One calibration again."""

    record: Record
    differences: list[Difference]
    """Biases that differ by more than the tolerance."""
    worst_sigmas: float | None
    """The largest difference of all biases, in sigma_use; None where nothing was recomputed."""
    not_recomputed: str | None
    """Why its estimates were taken from the recording, if so."""


def compared(recorded: Record, again: Record) -> Replayed:
    """Compare the biases of a record with those of a replay."""
    differences: list[Difference] = []
    worst = 0.0
    ours = {imu.name: imu for imu in again.imus}
    for imu in recorded.imus:
        for field, sigma in _SIGMAS.items():
            before, sigmas = getattr(imu, field), getattr(imu, sigma)
            now = getattr(ours.get(imu.name), field, None)
            if before is None and now is None:
                continue
            for axis in range(3):
                one, other = (None if values is None else values[axis] for values in (before, now))
                off = None if one is None or other is None else float(np.abs(other - one) / sigmas[axis])
                worst = worst if off is None else max(worst, off)
                if off is None or not off <= TOLERANCE_SIGMAS:
                    differences.append(Difference(f"imus[{imu.name}].{field}[{axis}]", one, other, off))
    return Replayed(again, differences, worst, None)


class Calibrations:
    """What has been measured, solved and recorded so far."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self.again: list[Replayed] = []
        self.where = Whereabouts()
        self.begin(0.0)

    def begin(self, t_s: float) -> None:
        """Begin anew: nothing is known of what was measured before."""
        self._begun_s = t_s
        self._measured: Measurement | CalibrationRefusedError | None = None
        self._offsets: Offsets = {}
        self._solution: Solution | None = None
        self._not_recomputed = "it was measured before the recording began"

    def measured(self, collector: RollingCollector, measured: Measured, now_s: float, offsets: Offsets) -> None:
        """Take the window that was taken then: of the same seconds, as far as the recording has them."""
        self._offsets = offsets
        self._measured = None
        if measured.start_s < self._begun_s:
            return
        try:
            found = collector.measurement(now_s)
            if self._config.vehicle.platform == "ground" and found.slots[0] != measured.start_s:
                # What began the stretch anew, such as arming, is not in the bytes.
                found = collector.measurement(now_s, since_s=measured.start_s)
        except CalibrationRefusedError as error:
            self._measured = error
            return
        self._measured = msgspec.structs.replace(
            found, wander_deg=measured.wander_deg, begun_s=measured.begun_s, turn=measured.turn
        )

    def solve(self, detail: Solved) -> None:
        """Work out what was worked out from the window before."""
        self._solution, self.where = None, detail.where
        if detail.dithered:
            self._not_recomputed = "its means came from an offset dither"
            return
        if self._measured is None:
            self._not_recomputed = "it was measured before the recording began"
            return
        used = detail.alignment
        alignment = AlignmentUsed(measured_at="", offset_deg=used[:2], sigma_deg=used[2]) if used else None
        try:
            if isinstance(self._measured, CalibrationRefusedError):
                raise self._measured
            solution = self._solved(self._measured.window(), What[detail.what], alignment, detail.otherwise)
            whole = {found.name: self._whole(found) for found in solution.imus}
            self._solution = weigh(solution, whole, detail.expectation).solution
        except CalibrationRefusedError as error:
            self._not_recomputed = f"refused here: {error}"

    def _solved(
        self, window: Window, what: What, alignment: AlignmentUsed | None = None, otherwise: Otherwise = NOTHING
    ) -> Solution:
        config = self._config
        gradienter = aligned(models.gradienter_model(config.gradienter), alignment)
        compass = models.compass_model(config.compass)
        local, platform, any_bias = local_earth(self.where), config.vehicle.platform, config.calibration.any_bias
        return solve(window, local, gradienter, compass, what, platform, any_bias=any_bias, otherwise=otherwise)

    def _whole(self, found: ImuSolution) -> tuple[Array | None, Array | None]:
        calibration = self._offsets.get(found.name)
        return (found.gyro_rad_s, found.accel_m_s2) if calibration is None else whole_of(calibration, found)

    def recorded(self, recorded: Record) -> None:
        """Take the record that ended a calibration."""
        solution, self._solution = self._solution, None
        if recorded.pose is None:
            self.again.append(Replayed(recorded, [], None, "it ended before anything was worked out"))
        elif solution is None:
            self.again.append(Replayed(recorded, [], None, self._not_recomputed))
        else:
            self.again.append(compared(recorded, self._record(recorded, solution)))

    def _record(self, recorded: Record, solution: Solution) -> Record:
        """Make the record of a solution; what only the autopilot can tell is taken from the recorded one."""
        corrected = {imu.name for imu in recorded.imus if imu.residual_gyro_rad_s or imu.residual_accel_m_s2}
        began, seconds = datetime.datetime.fromisoformat(recorded.started_at), recorded.duration_s
        whole = {found.name: self._whole(found) for found in solution.imus if found.name in corrected}
        again = record_of(solution, began, seconds, state=recorded.state, reason=recorded.reason, whole=whole)
        were = {imu.name: imu for imu in recorded.imus}
        imus = tuple(
            msgspec.structs.replace(imu, written=was.written, gyro_id=was.gyro_id, accel_id=was.accel_id)
            for imu, was in ((imu, were[imu.name]) for imu in again.imus if imu.name in were)
        )
        return msgspec.structs.replace(again, imus=imus, system_id=recorded.system_id, alignment=recorded.alignment)

    def estimate(self, collector: RollingCollector, now_s: float, began: datetime.datetime, seconds: float) -> Record:
        """Return what a calibration would have found now."""
        try:
            solution = self._solved(collector.window(now_s), What.BOTH)
        except CalibrationRefusedError as error:
            return record_of(None, began, seconds, state="failed", reason=str(error))
        whole = {found.name: self._whole(found) for found in solution.imus if self._offsets.get(found.name)}
        return record_of(solution, began, seconds, whole=whole)

    def set_offsets(self, offsets: Offsets) -> None:
        """Take the offsets in force, for `estimate`."""
        self._offsets = offsets
