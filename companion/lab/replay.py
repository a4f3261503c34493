"""Replay of a recording through decoders, collector and estimator, in the recorded order and at the recorded times.

Samples are computed again from their raw bytes, and from them batches, stillness, means, pose, biases and sigmas.
The replay copies from the recording the times of ticks and windows, the autopilot's parameters and the place. It also
copies the prediction from earlier power-ups, and all that only the autopilot knows, such as the outcome of a write.
"""

from __future__ import annotations

import dataclasses
import datetime
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from companion import __version__
from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.configured import models
from companion.configured.models import aligned, collect
from companion.errors import CalibrationRefusedError, StorageError
from companion.estimation.collector.measurement import Measurement
from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.machine import What
from companion.estimation.records.record import AlignmentUsed, Record, from_json
from companion.estimation.solution.joint import weigh
from companion.estimation.solution.results import imu_records, record_of
from companion.estimation.solution.site import Whereabouts, local_earth
from companion.estimation.solution.solve import ImuSolution, Solution, solve
from companion.lab.recording import Playback, Recording, reporting_damage
from companion.recording import messages
from companion.recording.messages import ImuState, Measured, Solved, Start, decode

FOLLOWS_S: Final = 3.0
"""Longest gap between consecutive files, s; a longer one means that a file between them is missing."""
TOLERANCE_SIGMAS: Final = 0.01
"""Largest accepted difference of a replayed bias from the recorded one, as a share of its sigma_use (stated sigma)."""
_SIGMAS: Final = {
    "gyro_bias_rad_s": "gyro_sigma_use_rad_s",
    "residual_gyro_rad_s": "gyro_sigma_use_rad_s",
    "accel_bias_m_s2": "accel_sigma_use_m_s2",
    "residual_accel_m_s2": "accel_sigma_use_m_s2",
}
_BEFORE: Final = "it was measured before the recording began"
"""Text of `Replayed.not_recomputed` for a window that began before the recording."""


class Replayed(msgspec.Struct, frozen=True):
    """Result of one replayed calibration.

    `differences` lists biases that differ by more than the tolerance; `worst_sigmas` is the largest difference
    in stated sigmas. Both are empty if the estimates were copied from the recording, for the reason `not_recomputed`.
    """

    record: Record
    differences: list[str]
    worst_sigmas: float | None
    not_recomputed: str | None


class Replay:
    """Replay of one recording: a single file, or several of a ring, the oldest first."""

    def __init__(self, recording: Recording) -> None:
        self._config = recording.config()
        self._playback = Playback(self._config)
        self._collector: RollingCollector | None = None
        self.calibrations: list[Replayed] = []
        self.notes: list[str] = []  # Notes on other versions and gaps
        if recording.companion != __version__:
            self.notes.append(f"recorded with companion {recording.companion}, here {__version__}")
        self.cut_short: str | None = None  # Reason of the early end of the first incomplete file
        self._is_cut = False
        self._first_s = self._now_s = self._begun_s = math.nan
        self._where = Whereabouts()
        self._measured: Measurement | CalibrationRefusedError | None = None
        self._offsets: dict[str, ImuCalibration | None] = {}  # Active offsets at the latest window, by IMU
        self._solution: Solution | None = None
        self._not_recomputed = _BEFORE

    def take(self, recording: Recording) -> None:
        """Replay one file; if its end is missing, the next file starts with an empty state."""
        for topic, t_s, data in recording.read():
            with reporting_damage(recording.path, topic):
                self._take(topic, data, t_s)
        self._is_cut = self._is_cut or recording.cut_short is not None
        self.cut_short = self.cut_short or recording.cut_short

    def _take(self, topic: str, data: bytes, t_s: float) -> None:
        if topic == messages.START:
            self._start(decode(topic, data), t_s)
        collector = self._collector
        if collector is None:
            return
        self._now_s = t_s
        imu = topic.removeprefix(messages.IMU)
        before = self._playback.state(imu)
        for role, part in self._playback.take(topic, data, t_s):
            collect(collector, role, part)
        if topic.startswith(messages.IMU) and (state := self._playback.state(imu)) is not None:
            _change(collector, before, state)
        elif topic == messages.TICK:
            collector.tick(t_s)
        elif topic == messages.RAW_MEAN:
            raw = decode(topic, data)
            collector.add_raw(raw.imu, t_s, raw.output, raw.temperature_degc)
        elif topic == messages.PLACE:
            self._where = decode(topic, data)
        elif topic == messages.MEASURED:
            states = {imu.name: self._playback.state(imu.name) for imu in self._config.imu}
            self._offsets = {name: state.calibration for name, state in states.items() if state is not None}
            self._measured = self._measure(collector, decode(topic, data), t_s)
        elif topic == messages.SOLVED:
            self._solve(decode(topic, data))
        elif topic == messages.RECORD:
            self.calibrations.append(self._compare(from_json(data)))

    def _start(self, start: Start, t_s: float) -> None:
        follows = start.continues and self._collector is not None and not self._is_cut
        if follows and t_s - self._now_s < FOLLOWS_S:
            return
        if start.lost:
            self.notes.append(f"{start.lost} messages were lost in recording; replayed from behind the gap")
        if math.isnan(self._first_s):
            self._first_s = t_s
        self._is_cut, self._begun_s = False, t_s
        self._collector = models.collector(self._config)
        self._playback.begin()
        self._measured = self._solution = None
        self._not_recomputed = _BEFORE

    def _measure(
        self, collector: RollingCollector, measured: Measured, now_s: float
    ) -> Measurement | CalibrationRefusedError | None:
        """Measure the recorded window again; return None if the window began before the recording."""
        if measured.start_s < self._begun_s:
            return None
        try:
            found = collector.measurement(now_s)
            if self._config.vehicle.platform == "ground" and found.slots[0] != measured.start_s:
                # The cause of a new stretch, such as arming, is not in the recorded bytes.
                found = collector.measurement(now_s, since_s=measured.start_s)
        except CalibrationRefusedError as error:
            return error
        return msgspec.structs.replace(
            found, wander_deg=measured.wander_deg, begun_s=measured.begun_s, turn=measured.turn
        )

    def _solve(self, detail: Solved) -> None:
        self._solution, self._where = None, detail.where
        if self._measured is None:
            self._not_recomputed = _BEFORE
            return
        config, used = self._config, detail.alignment
        alignment = AlignmentUsed(measured_at="", offset_deg=used[:2], sigma_deg=used[2]) if used else None
        try:
            if isinstance(self._measured, CalibrationRefusedError):
                raise self._measured
            solution = solve(
                self._measured.window(), local_earth(self._where),
                aligned(models.gradienter_model(config.gradienter), alignment), models.compass_model(config.compass),
                What[detail.what], config.vehicle.platform, any_bias=config.calibration.any_bias,
                otherwise=detail.otherwise,
            )  # fmt: skip
            imus = tuple(map(self._with_offsets, solution.imus))
            self._solution = weigh(dataclasses.replace(solution, imus=imus), detail.expectation)
        except CalibrationRefusedError as error:
            self._not_recomputed = f"refused here: {error}"

    def _with_offsets(self, imu: ImuSolution) -> ImuSolution:
        calibration = self._offsets.get(imu.name)
        if calibration is None:
            return imu
        return dataclasses.replace(imu, subtracted=calibration.subtracted(imu.temperature_degc))

    def _compare(self, recorded: Record) -> Replayed:
        """Compare a recorded calibration with its replay; values that only the autopilot knows are copied."""
        solution, self._solution = self._solution, None
        if recorded.pose is None:
            return Replayed(recorded, [], None, "it ended before anything was worked out")
        if solution is None:
            return Replayed(recorded, [], None, self._not_recomputed)
        began, seconds = datetime.datetime.fromisoformat(recorded.started_at), recorded.duration_s
        earlier = {imu.name: imu for imu in recorded.imus}
        imus = tuple(
            msgspec.structs.replace(imu, written=was.written, gyro_id=was.gyro_id, accel_id=was.accel_id)
            for imu, was in ((imu, earlier[imu.name]) for imu in imu_records(solution) if imu.name in earlier)
        )
        again = record_of(solution, began, seconds, state=recorded.state, reason=recorded.reason, imus=imus)
        again = msgspec.structs.replace(again, system_id=recorded.system_id, alignment=recorded.alignment)
        return compared(recorded, again)

    @property
    def seconds(self) -> float:
        return 0.0 if math.isnan(self._first_s) else self._now_s - self._first_s


def compared(recorded: Record, again: Record) -> Replayed:
    differences: list[str] = []
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
                    size = "" if off is None else f" ({off:.2g} sigma)"
                    where = f"imus[{imu.name}].{field}[{axis}]"
                    differences.append(f"{where}: recorded {one!r}, replayed {other!r}{size}")
    return Replayed(again, differences, worst, None)


def _change(collector: RollingCollector, before: ImuState | None, state: ImuState) -> None:
    name = state.input.name
    if before is None or messages.encode(before.input) != messages.encode(state.input):
        collector.set_imu(state.input)
    one, other = None if before is None else before.calibration, state.calibration
    is_like = one is other if one is None or other is None else one.corrects_like(other)
    if not is_like:
        collector.reset("offsets written", name)


def replay(paths: Iterable[Path]) -> Replay:
    recordings = map(Recording, paths)
    first = next(recordings)
    found = Replay(first)
    found.take(first)
    for recording in recordings:
        if not first.is_same_run(recording):
            raise StorageError(
                f"{recording.path}: not of the same run of the daemon as the file before; replay it alone"
            )
        found.take(recording)
    return found
