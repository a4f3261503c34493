"""A record worked out anew: what no recording can tell again is the recorded one's."""

from __future__ import annotations

import datetime
from collections.abc import Mapping

import msgspec

from companion.autopilot.firmware.imu_calibration import ImuCalibration, whole_of
from companion.calibration.means.windows import Window
from companion.calibration.solution.draft import Draft, in_words
from companion.calibration.solution.record import ImuRecord, Record
from companion.calibration.solution.solve import Solution


def record_again(recorded: Record, solution: Solution, solved_with: Mapping[str, ImuCalibration | None]) -> Record:
    """The record of a calibration from a solution that was worked out again.

    Args:
        recorded: as the daemon wrote it.
        solution: the new one.
        solved_with: the offsets that were in force when it was measured, by IMU.
    """
    draft = Draft(datetime.datetime.fromtimestamp(0.0, tz=datetime.UTC), recorded.system_id, solution)
    corrected = {imu.name for imu in recorded.imus if imu.residual_gyro_rad_s or imu.residual_accel_m_s2}
    for found in solution.imus:
        calibration = solved_with.get(found.name)
        if calibration is not None and found.name in corrected:
            draft.whole[found.name] = whole_of(calibration, found)
    words = in_words(solution)
    reason = recorded.reason
    if recorded.state == "done":
        reason = words + (reason[len(words) :] if reason.startswith(words) else "")
    again = draft.record(recorded.state, reason, recorded.duration_s)
    before = {imu.name: imu for imu in recorded.imus}
    return msgspec.structs.replace(
        again,
        started_at=recorded.started_at,
        alignment=recorded.alignment,
        # Records of earlier versions have none.
        cross_covariance=again.cross_covariance if recorded.cross_covariance else (),
        duration_s=recorded.duration_s,
        warnings=_with_rest(again.warnings, recorded.warnings),
        imus=tuple(_imu_again(imu, before.get(imu.name)) for imu in again.imus),
    )


def refined_window(window: Window, refined: Window | None) -> Window:
    """The window with the means that a dither has found."""
    if refined is None:
        return window
    found = {imu.name: imu for imu in refined.imus if imu.dithered}
    return msgspec.structs.replace(window, imus=tuple(found.get(imu.name, imu) for imu in window.imus))


def _with_rest(ours: tuple[str, ...], recorded: tuple[str, ...]) -> tuple[str, ...]:
    """Our warnings first, as ever; then those that come from the autopilot."""
    return (*ours, *recorded[len(ours) :])


def _imu_again(imu: ImuRecord, recorded: ImuRecord | None) -> ImuRecord:
    if recorded is None:
        return imu
    return msgspec.structs.replace(imu, written=recorded.written, warnings=_with_rest(imu.warnings, recorded.warnings))
