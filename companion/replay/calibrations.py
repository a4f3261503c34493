"""The calibrations of a recording again, from the means that were taken to the record that was written.

What no recording can tell again is taken from the recorded one; the others are compared to the last bit.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from typing import Any, Final

import msgspec

from companion.autopilot.firmware.imu_calibration import ImuCalibration, whole_of
from companion.calibration.collector.measurement import Measurement
from companion.calibration.collector.rolling import RollingCollector
from companion.calibration.means.windows import Window
from companion.calibration.records.record import AlignmentUsed, Record
from companion.calibration.request import What
from companion.calibration.solution.draft import Draft, in_words
from companion.calibration.solution.joint import weigh
from companion.calibration.solution.otherwise import NOTHING, Otherwise
from companion.calibration.solution.site import Whereabouts, local_earth
from companion.calibration.solution.solve import ImuSolution, Solution, solve
from companion.config.sections import Config
from companion.configured import models
from companion.configured.models import aligned
from companion.errors import CalibrationRefusedError
from companion.physics.frames import Array
from companion.recording.journal import Offsets, Solved

_SIGMAS = {
    "gyro_bias_rad_s": "gyro_sigma_use_rad_s",
    "residual_gyro_rad_s": "gyro_sigma_use_rad_s",
    "accel_bias_m_s2": "accel_sigma_use_m_s2",
    "residual_accel_m_s2": "accel_sigma_use_m_s2",
}


class Difference(msgspec.Struct, frozen=True):
    """One field that is not the same."""

    field: str
    """Such as imus[fc].gyro_bias_rad_s[0]."""
    recorded: Any
    replayed: Any
    sigmas: float | None
    """By how many sigma_use a bias differs; None for anything else."""

    def __str__(self) -> str:
        size = "" if self.sigmas is None else f" ({self.sigmas:.2g} sigma)"
        return f"{self.field}: recorded {self.recorded!r}, replayed {self.replayed!r}{size}"


def differences(recorded: Record, replayed: Record) -> list[Difference]:
    """Every field in which they differ, even by the last bit."""
    found: list[Difference] = []
    _compare("", msgspec.to_builtins(recorded), msgspec.to_builtins(replayed), None, found)
    return found


def _compare(path: str, recorded: Any, replayed: Any, sigma: Any, found: list[Difference]) -> None:
    if isinstance(recorded, dict) and isinstance(replayed, dict):
        for key in {**recorded, **replayed}:
            inner = recorded.get(_SIGMAS.get(key, ""))
            _compare(f"{path}.{key}" if path else key, recorded.get(key), replayed.get(key), inner, found)
    elif isinstance(recorded, list | tuple) and isinstance(replayed, list | tuple) and len(recorded) == len(replayed):
        for index, (one, other) in enumerate(zip(recorded, replayed, strict=True)):
            name = one.get("name", index) if isinstance(one, dict) else index
            inner = sigma[index] if isinstance(sigma, list | tuple) and index < len(sigma) else None
            _compare(f"{path}[{name}]", one, other, inner, found)
    elif recorded != replayed:
        sigmas = None
        if isinstance(sigma, float) and sigma > 0.0 and isinstance(recorded, float) and isinstance(replayed, float):
            sigmas = abs(replayed - recorded) / sigma
        found.append(Difference(path, recorded, replayed, sigmas))


def record_again(recorded: Record, solution: Solution, solved_with: Mapping[str, ImuCalibration | None]) -> Record:
    """The record of a calibration from a solution worked out again with the offsets in force when it was measured."""
    draft = Draft(datetime.datetime.fromtimestamp(0.0, tz=datetime.UTC), recorded.system_id, solution)
    corrected = {imu.name for imu in recorded.imus if imu.residual_gyro_rad_s or imu.residual_accel_m_s2}
    for found in solution.imus:
        calibration = solved_with.get(found.name)
        if calibration is not None and found.name in corrected:
            draft.whole[found.name] = whole_of(calibration, found)
    draft.written = {imu.name: dict(imu.written) for imu in recorded.imus}
    draft.device_ids = {imu.name: (imu.gyro_id, imu.accel_id) for imu in recorded.imus}
    draft.unchanged = {(imu.name, triad) for imu in recorded.imus for triad in imu.unchanged}
    words = in_words(draft)
    reason = recorded.reason
    if recorded.state == "done":
        reason = words + (reason[len(words) :] if reason.startswith(words) else "")
    again = draft.record(recorded.state, reason, recorded.duration_s)
    before = {imu.name: imu for imu in recorded.imus}
    return msgspec.structs.replace(
        again,
        started_at=recorded.started_at,
        alignment=recorded.alignment,
        duration_s=recorded.duration_s,
        warnings=_with_rest(again.warnings, recorded.warnings),
        imus=tuple(
            msgspec.structs.replace(imu, warnings=_with_rest(imu.warnings, was.warnings))
            if (was := before.get(imu.name))
            else imu
            for imu in again.imus
        ),
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


WINDOWS_KEPT: Final = 4000
"""The most means kept for a calibration that may be made of them."""


class Replayed(msgspec.Struct, frozen=True):
    """One calibration again."""

    record: Record
    differences: list[Difference]
    not_recomputed: str | None
    """Why its estimates were taken from the recording, if so."""


class Calibrations:
    """What has been measured, solved and recorded so far."""

    def __init__(self) -> None:
        self.config: Config | None = None
        """The daemon's; nothing is solved before it is known."""
        self.again: list[Replayed] = []
        self.where = Whereabouts()
        self.offsets: Offsets = {}
        self._windows: dict[int, Measurement | CalibrationRefusedError] = {}
        self._solution: Solution | None = None
        self._solved_with: Offsets = {}
        """The offsets in force when that was measured; by now others may have been written."""
        self._no_solution = ""
        self._refused: str | None = None
        self._alignment: AlignmentUsed | None = None

    def begin(self) -> None:
        """Nothing is known yet of what follows."""
        self._windows.clear()
        self._solution, self._refused = None, None
        self._no_solution = "its measurement is not in the recording"

    def measured(self, number: int, found: Measurement | CalibrationRefusedError) -> None:
        """Means were taken; most of them nobody ever asks for."""
        self._windows[number] = found
        while len(self._windows) > WINDOWS_KEPT:
            del self._windows[next(iter(self._windows))]

    def solve(self, detail: Solved) -> None:
        """Work out what was solved from means that were taken before."""
        self._solution, self._no_solution, self._refused = None, "", None
        window = self._windows.get(-1 if detail.window is None else detail.window)
        self.where, self._solved_with = detail.where, detail.offsets
        used = detail.alignment
        self._alignment = AlignmentUsed(measured_at="", offset_deg=used[:2], sigma_deg=used[2]) if used else None
        if window is None:
            self._no_solution = "its measurement is not in the recording"
            return
        try:
            if isinstance(window, CalibrationRefusedError):
                raise window
            solution = self._solved(
                refined_window(window.window(), detail.refined), What[detail.what], detail.otherwise
            )
            whole = {found.name: self._whole(found) for found in solution.imus}
            self._solution = weigh(solution, whole, detail.expectation).solution
        except CalibrationRefusedError as error:
            self._refused = f"refused here: {error}"

    def _solved(self, window: Window, what: What, otherwise: Otherwise = NOTHING) -> Solution:
        config = self.config
        assert config is not None
        gradienter = aligned(models.gradienter_model(config.gradienter), self._alignment)
        compass = models.compass_model(config.compass)
        local, platform, any_bias = local_earth(self.where), config.vehicle.platform, config.calibration.any_bias
        return solve(window, local, gradienter, compass, what, platform, any_bias=any_bias, otherwise=otherwise)

    def _whole(self, found: ImuSolution) -> tuple[Array | None, Array | None]:
        calibration = self._solved_with.get(found.name)
        return (found.gyro_rad_s, found.accel_m_s2) if calibration is None else whole_of(calibration, found)

    def recorded(self, recorded: Record) -> None:
        """Take the record that ended a calibration."""
        solution, self._solution = self._solution, None
        if recorded.pose is None:
            # It ended before anything was worked out; there is nothing to recompute.
            self.again.append(Replayed(recorded, [], "it ended before anything was worked out"))
        elif solution is not None:
            again = record_again(recorded, solution, self._solved_with)
            self.again.append(Replayed(again, differences(recorded, again), None))
        elif self._refused is not None:
            gone = msgspec.structs.replace(
                recorded, state="failed", reason=self._refused, pose=None, site=None, imus=()
            )
            self.again.append(Replayed(gone, differences(recorded, gone), None))
        else:
            self.again.append(Replayed(recorded, [], self._no_solution))

    def estimate(self, collector: RollingCollector, now_s: float, draft: Draft, seconds: float) -> Record:
        """What a calibration that took so long would have found now."""
        try:
            draft.solution = self._solved(collector.window(now_s), What.BOTH)
        except CalibrationRefusedError as error:
            return draft.record("failed", str(error), seconds)
        for found in draft.solution.imus:
            calibration = self.offsets.get(found.name)
            if calibration is not None:
                draft.whole[found.name] = whole_of(calibration, found)
        return draft.record("done", in_words(draft), seconds)
