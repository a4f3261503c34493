"""The calibrations of a recording again: from the means that were taken to the record that was written."""

from __future__ import annotations

from typing import Final

import msgspec

from companion.autopilot.firmware.imu_calibration import whole_of
from companion.calibration.collector.measurement import Measurement
from companion.calibration.collector.rolling import RollingCollector, Window
from companion.calibration.request import What
from companion.calibration.solution.draft import Draft, in_words
from companion.calibration.solution.joint import weigh
from companion.calibration.solution.record import AlignmentUsed, Record
from companion.calibration.solution.site import Whereabouts
from companion.calibration.solution.solve import ImuSolution, Solution, solve_at
from companion.config.sections import Config
from companion.configured import models
from companion.configured.models import aligned
from companion.errors import CalibrationRefusedError
from companion.physics.frames import Array
from companion.recording.details import Offsets, Solved
from companion.replay.again import record_again, refined_window
from companion.replay.compare import Difference, differences

WINDOWS_KEPT: Final = 4000
"""Means that were taken, for a calibration that may come of them."""


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
        """Why the estimator refuses here what was measured then."""
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
        self._alignment = (
            AlignmentUsed(measured_at="", offset_deg=(used[0], used[1]), sigma_deg=used[2]) if used else None
        )
        if window is None:
            self._no_solution = "its measurement is not in the recording"
            return
        try:
            if isinstance(window, CalibrationRefusedError):
                raise window
            solution = self._solved(refined_window(window.window(), detail.refined), What[detail.what])
            whole = {found.name: self._whole(found) for found in solution.imus}
            self._solution = weigh(solution, whole, detail.expectation).solution
        except CalibrationRefusedError as error:
            self._refused = f"refused here: {error}"

    def _solved(self, window: Window, what: What) -> Solution:
        config = self.config
        assert config is not None
        gradienter = aligned(models.gradienter_model(config.gradienter), self._alignment)
        compass = models.compass_model(config.compass)
        return solve_at(window, self.where, gradienter, compass, what)

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
        """What a calibration would have found now.

        Args:
            collector: as it stands.
            now_s: the samples' clock.
            draft: of the record.
            seconds: that it took.
        """
        try:
            draft.solution = self._solved(collector.window(now_s), What.BOTH)
        except CalibrationRefusedError as error:
            return draft.record("failed", str(error), seconds)
        for found in draft.solution.imus:
            calibration = self.offsets.get(found.name)
            if calibration is not None:
                draft.whole[found.name] = whole_of(calibration, found)
        return draft.record("done", in_words(draft.solution), seconds)
