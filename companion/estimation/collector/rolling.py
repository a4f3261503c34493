"""Rolling collector: combines the streams of all sensors into one window (method.md sections 2.4, 3.1 and 3.2).

The collector has no clock: the time comes with the samples and with `now_s`. All sensors share one grid of 1 s. A
second counts if every sensor was motionless during it.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, Final

import msgspec

from companion.errors import CalibrationRefusedError
from companion.estimation.collector.intake import (
    CollectorObstacle,
    CollectorStatus,
    ImuSource,
    PoseKind,
    PoseSource,
    Settings,
    Source,
    Thermometer,
)
from companion.estimation.collector.measurement import MIN_BATCHES, GroundWindows, Measurement, WindowSource, Work
from companion.estimation.means.pose import CompassModel, FieldHeading, GradienterModel
from companion.estimation.means.windows import ImuInput, Window
from companion.estimation.seconds.batch import Batch
from companion.estimation.seconds.counting import TurnCounter
from companion.estimation.stillness.gates import GateVerdict
from companion.estimation.turning.turn import Turn
from companion.estimation.turning.watch import TurnWatch
from companion.samples import CompassSample, ImuSample, MagSample, TiltSample

_GRACE_S: Final = 1.0
"""Time to wait for a silent sensor after the end of a second: latency of a busy telemetry link."""
_CLOSE_S: Final = 0.25
_MARGIN: Final = 8


class RollingCollector:
    """Collects one-second batches of all sensors, judges stillness, and computes the means of a window.

    No sample value raises an exception; dropped samples are counted by reason. Memory is bounded to `max_s` batches per
    sensor, plus a margin. `gradienter`, `compass`: None if the aircraft has none. `windows` chooses the seconds of a
    window; None: `GroundWindows`, for an aircraft on the ground.

    Raises:
        ValueError: two IMUs have one name.
    """

    def __init__(
        self,
        settings: Settings,
        imus: Sequence[ImuInput],
        gradienter: GradienterModel | None = None,
        compass: CompassModel | None = None,
        windows: WindowSource | None = None,
    ) -> None:
        if len({imu.name for imu in imus}) != len(imus):
            raise ValueError("two IMUs have one name")
        self._settings = settings
        self._keep = settings.max_slots + _MARGIN
        self._gradienter, self._compass = gradienter, compass
        self._windows = GroundWindows(settings) if windows is None else windows
        self.imus: dict[str, ImuSource] = {}
        self._tilt = None if gradienter is None else self._pose_source("gradienter")
        self._heading = None if compass is None else self._pose_source("compass")
        self._field = None if compass is None else FieldHeading(compass, gradienter, self._keep)
        self._turns = TurnWatch(settings.max_slots)
        self.thermometers: defaultdict[str, Thermometer] = defaultdict(Thermometer)
        self._next: int | None = None
        self._now_s = -math.inf
        self._restarts = 0
        self.on_second: list[Callable[[], object]] = []
        """Callbacks after new seconds were judged. They delay the next samples, so they must be quick."""
        for imu in imus:
            self.set_imu(imu)

    # --- samples in

    def add_imu(self, name: str, sample: ImuSample) -> None:
        source = self.imus.get(name)
        if source is None:
            return
        if source.has_restarted(sample):
            self.reset("restarted", name)
        if source.add(sample):
            self._evaluate()

    def add_raw(self, name: str, t_s: float, row: tuple[float, ...], temperature_degc: float | None) -> None:
        """Add a mean in floats (gyro in rad/s, accelerometer in m/s^2) of an IMU whose stream has integers only.

        Stillness is judged by the integers. A window uses the floats if they determine the gyro biases better.
        """
        if name in self.imus:
            self.imus[name].add_raw(t_s, row, temperature_degc)

    def add_tilt(self, sample: TiltSample) -> None:
        if self._field is not None:
            self._field.take_tilt(sample)
        row = (sample.x_deg, sample.y_deg)
        if self._tilt is not None and self._tilt.batches.add(sample.t_s, row, sample.temperature_degc):
            self._evaluate()

    def add_compass(self, sample: CompassSample) -> bool:
        """Add a heading that the compass computed; return false if one from its magnetic field is used instead."""
        counts = self._field is None or self._field.takes_own(sample)
        if counts:
            self._add_heading(sample)
        return counts

    def add_field(self, sample: MagSample) -> CompassSample | None:
        """Add a magnetic field of the compass; return the heading computed from the field, if that heading is used."""
        if self._heading is None or self._field is None:
            return None
        heading = self._field.add(sample)
        self._heading.hint = self._field.hint
        if heading is not None:
            self._add_heading(heading)
        return heading

    def _add_heading(self, sample: CompassSample) -> None:
        if self._heading is not None and self._heading.batches.add(sample.t_s, (sample.heading_deg,)):
            self._evaluate()

    def tick(self, now_s: float) -> None:
        """Close the seconds that ended before `now_s` (on the samples' clock), even if a sensor is silent.

        Call this method a few times a second.
        """
        if math.isfinite(now_s):
            self._now_s = now_s
            for source in self.sources():
                source.batches.close_before(now_s - _CLOSE_S)
            for imu in self.imus.values():
                imu.raw.close_before(now_s - _CLOSE_S)
            if self._field is not None:
                self._field.batches.close_before(now_s - _CLOSE_S)
        self._evaluate()

    # --- changes of sensors and targets

    def set_imu(self, imu: ImuInput) -> None:
        """Add an IMU, or replace it when its stream changes its kind, and drop all data learned about it."""
        name, known = imu.name, self.imus.get(imu.name)
        self._turns.set_imu(name, imu.rotation, imu.profile, (imu.gyro_step_rad_s, imu.accel_step_m_s2))
        if known is None:
            self.imus[name] = source = ImuSource(imu, self._keep)
            source.batches.believed = self.thermometers[name].believed
            self._windows.set_imu(imu, source.batches, source.raw)
            # The seconds so far lack its samples.
            self._break()
        else:
            known.replace(imu)
            self._windows.set_imu(imu, known.batches, known.raw)
            self.reset("another stream", name)

    def expect(self, *, gradienter: bool, compass: bool) -> None:
        """Choose whether to wait for gradienter and compass, for example after one failed; keep the IMUs' history."""
        added = (gradienter and self._tilt is None) or (compass and self._heading is None)
        if gradienter != (self._tilt is not None):
            self._tilt = self._pose_source("gradienter") if gradienter else None
        if compass != (self._heading is not None):
            self._heading = self._pose_source("compass") if compass else None
        if added:
            self._break()

    def _pose_source(self, kind: PoseKind) -> PoseSource:
        model = self._compass if kind == "compass" else self._gradienter
        source = PoseSource(model, kind, self._keep)
        self._windows.set_pose(kind, source.batches)
        return source

    def retarget(self, settings: Settings) -> None:
        self._settings = msgspec.structs.replace(
            self._settings,
            target_gyro_sigma_rad_s=settings.target_gyro_sigma_rad_s,
            target_accel_sigma_m_s2=settings.target_accel_sigma_m_s2,
        )

    def reset(self, why: str, imu: str | None = None) -> None:
        """Drop the readings of one IMU, or of all sensors: after arming, a write of offsets, or a device's restart.

        The current second is dropped, too. The still stretch begins again. The learned noise is not dropped.
        """
        self._windows.forget(imu)
        for source in self.sources():
            if imu is None or (source.kind == "imu" and source.name == imu):
                source.forget()
        self._turns.forget(imu)
        self._break()

    def count_turns(self, *, wanted: bool) -> None:
        for source in self.imus.values():
            source.counter = TurnCounter() if wanted else None

    # --- state and results

    def sources(self) -> list[Source]:
        return [*self.imus.values(), *(source for source in (self._tilt, self._heading) if source is not None)]

    @property
    def begun_s(self) -> dict[str, float]:
        return {name: source.begun_s for name, source in self.imus.items() if source.begun_s is not None}

    def up_s(self, name: str) -> float | None:
        return self.imus[name].up_s if name in self.imus else None

    @property
    def turn(self) -> Turn:
        return self._turns.turn

    @property
    def wander_deg(self) -> float | None:
        return self._turns.wander_deg

    def imu_seconds(self) -> dict[str, Batch]:
        return {name: source.newest for name, source in self.imus.items() if source.newest is not None}

    def tilt_second(self) -> Batch | None:
        return None if self._tilt is None else self._tilt.newest

    def glance(self, now_s: float) -> CollectorStatus:
        """Return the status without an estimate, at a fraction of the cost of `status`."""
        return msgspec.structs.replace(self._windows.stillness, obstacle=self._obstacle(now_s))

    def pending(self, now_s: float, *, since_s: float | None = None) -> Work | None:
        """Return the computation that `window` needs now, for another thread; None if none is needed or possible."""
        return None if self._obstacle(now_s) is not None else self._windows.pending(since_s)

    def accept(self, work: Work, found: Any) -> None:
        self._windows.accept(work, found)

    def status(self, now_s: float) -> CollectorStatus:
        """Return the collector's state; its numbers may be one second old."""
        waits = self._waiting_for(now_s)
        found = self._windows.status(self._settings, waits=waits is not None)
        obstacle = waits or found.obstacle
        enough = found.enough and obstacle is None
        return msgspec.structs.replace(
            found,
            obstacle=obstacle,
            enough=enough,
            progress=min(found.progress, 1.0 if enough else 0.99),
            sources=tuple(source.status(now_s) for source in self.sources()),
        )

    def window(self, now_s: float, *, since_s: float | None = None) -> Window:
        """Return the means over the good seconds up to the latest complete one, at most `max_s` seconds.

        To verify a write at time `since_s`, only later seconds count, and on the ground 5 good seconds are enough.
        `duration_s` of an IMU is the number of seconds in its means.

        Raises:
            CalibrationRefusedError: not still, not still for long enough, or a sensor fails its checks.
        """
        return self.measurement(now_s, since_s=since_s).window()

    def measurement(self, now_s: float, *, since_s: float | None = None) -> Measurement:
        """Return the readings of `window` without the estimate, at a fraction of the cost.

        Raises:
            CalibrationRefusedError: not still, or not still for long enough.
        """
        if (reason := self._obstacle(now_s)) is not None:
            raise CalibrationRefusedError(reason.words)
        found = self._windows.measurement(since_s)
        if self._windows.may_move:
            return found
        return msgspec.structs.replace(
            found,
            settling=self._settles(list(found.slots), 0),
            tilt=None if self._tilt is None else self._tilt.settled(found.slots),
            heading=None if self._heading is None else self._heading.settled(found.slots),
            from_field=self._field is not None and self._field.from_field,
            wander_deg=self.wander_deg,
            field=self._field.window(found.slots) if self._field and self._heading else None,
            begun_s=self.begun_s,
            turn=self.turn,
        )

    # --- inside

    def _others(self) -> list[GateVerdict]:
        return [source.verdict for source in self.sources() if source is not self._heading]

    def _break(self) -> None:
        self._windows.new_stretch()
        self._turns.new_stretch()
        for source in self.sources():
            source.gate.new_stretch()

    def _evaluate(self) -> None:
        """Judge every second that all sensors have completed, or for which the wait for silent sensors is over."""
        sources = self.sources()
        restarts = sum(source.batches.restarts for source in sources)
        if restarts > self._restarts:
            # A part of the good seconds has been dropped.
            self._break()
        self._restarts = restarts
        known = [slot for source in sources if (slot := source.batches.closed_through) is not None]
        if not known:
            return
        ready = min(known) if len(known) == len(sources) else -math.inf
        if math.isfinite(self._now_s):
            ready = max(ready, math.floor(self._now_s - _GRACE_S) - 1)
        if not math.isfinite(ready):
            return
        last = int(ready)
        if self._next is None or max(known) < self._next - self._keep:
            # Start, or all clocks went back.
            self._break()
            self._next = min(last, *known)
        if last - self._next > self._keep:
            # No source closed a second for so long that no second is left.
            self._break()
            self._next = last - 1
        if last < self._next:
            return
        for slot in range(self._next, last + 1):
            self._judge(slot, sources)
        self._next = last + 1
        for notify in tuple(self.on_second):
            notify()

    def _judge(self, slot: int, sources: list[Source]) -> None:
        # Show every second to every gate: a skipped gate learns nothing.
        good, moved = True, False
        for source in sources:  # the IMUs first: they detect a movement
            good = source.judge(slot, moved=moved, may_move=self._windows.may_move) and good
            moved = moved or (source.kind == "imu" and not source.verdict.still and not source.verdict.fault)
        if not self._windows.add(slot, good=good):
            self._break()
        if not self._watch_turn(slot, good=good):
            self._break()
        if good:
            for source in sources:
                source.accept(slot)

    def _watch_turn(self, slot: int, *, good: bool) -> bool:
        """Check a judged second for a turn of the ground; return false if a turn ends the still stretch."""
        others = self._others()
        if self._windows.may_move or any(verdict.fault for verdict in others):
            return True
        if not all(verdict.still for verdict in others):
            self._turns.moved()
            return True
        heading = None if self._heading is None else next(iter(self._heading.settled([slot])), None)
        imus = {name: source.batches.batches[slot] for name, source in self.imus.items()}
        return self._turns.add_second(slot, imus, heading, good=good)

    def _obstacle(self, now_s: float) -> CollectorObstacle | None:
        sources = self.sources()
        if (silence := next(filter(None, (source.silence(now_s) for source in sources)), None)) is not None:
            return CollectorObstacle(silence)
        if self._turns.words and not any(verdict.words for verdict in self._others()):
            return CollectorObstacle(self._turns.words, moving=True)
        if self._windows.stillness.good_now:
            return None
        said = next((source.verdict for source in sources if source.verdict.words), None)
        if said is None:
            least_s = self._settings.min_slots
            return CollectorObstacle(f"hold still {least_s} s", moving=True, hold_still_s=least_s)
        moving = not any(source.verdict.fault for source in sources if source.verdict.words)
        if said.fault:
            return CollectorObstacle(said.words, moving)
        return CollectorObstacle(f"hold still: {said.words}", moving)

    def _waiting_for(self, now_s: float) -> CollectorObstacle | None:
        if (moves := self._obstacle(now_s)) is not None:
            return moves
        left_s = self._windows.stillness.hold_still_s
        settles = self._settles(self._windows.good_slots(None), left_s)
        if settles is not None:
            return CollectorObstacle(settles)
        return CollectorObstacle(f"hold still {left_s} s more", hold_still_s=left_s) if left_s else None

    def _settles(self, slots: list[int], left_s: int) -> str | None:
        sources, least = filter(None, (self._tilt, self._heading)), min(MIN_BATCHES, self._settings.min_slots)
        return next(filter(None, (source.lacks(slots, least, left_s) for source in sources)), None)
