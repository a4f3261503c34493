"""What comes into the rolling collector: its streams, each with batches, gate and verdict, and where samples go."""

from __future__ import annotations

import functools
import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final, Literal

import msgspec

from companion.estimation.deck.deck import Deck
from companion.estimation.means.pose import CompassModel, FieldHeading, GradienterModel
from companion.estimation.means.windows import ImuInput, integer_steps
from companion.estimation.seconds.batch import Batch, BatchSource
from companion.estimation.seconds.counting import Counted, TurnCounter
from companion.estimation.stillness.gates import STILL, ImuGate, PoseGate, Verdict
from companion.estimation.stillness.stretch import Settling
from companion.estimation.turning.watch import Turn, TurnWatch
from companion.physics.frames import Array
from companion.samples import CompassSample, ImuSample, MagSample, TiltSample

if TYPE_CHECKING:
    from companion.estimation.temperature.thermometer import Thermometers

Kind = Literal["imu", "gradienter", "compass"]

_SILENT_S: Final = 2.5
_LONGEST_UP_S: Final = 3e8
"""A clock that says more counts from somewhere else: UTC, say."""
_CARRY: Final = 2
"""Seconds for which a slow gradienter's or compass' last reading stands."""
LIMITS_IMU: Final = (1e3,) * 3 + (1e4,) * 3
_LIMITS_TILT: Final = (180.0,) * 2
_LIMITS_HEADING: Final = (1e3,)


class SourceStatus(msgspec.Struct, frozen=True, kw_only=True):
    """One source now."""

    kind: Kind
    name: str
    still: bool
    words: str
    """Why not still; empty when still."""
    rate_hz: int
    """Samples in its last whole second."""
    dropped: dict[str, int]
    lost: int
    """Samples that never came, by the device's counter or clock."""


class Source:
    """One stream: its batches, its gate, its last verdict."""

    hint = ""
    """Why nothing comes, where somebody knows better than "no data"."""

    def __init__(
        self,
        kind: Kind,
        name: str,
        batches: BatchSource,
        gate: ImuGate | PoseGate,
        settling: Settling | None = None,
        keep: int = 0,
    ) -> None:
        self.kind, self.name, self.batches, self.gate, self.settling = kind, name, batches, gate, settling
        self.may_move = False
        """Whether only faults count: on a deck."""
        self.verdict = Verdict(still=False)
        self.unsettled: deque[int] = deque(maxlen=keep)
        """Seconds in which its readings still followed a movement; good for the others, not for a mean of its own."""

    @property
    def label(self) -> str:
        """As a pilot calls it."""
        return f"imu {self.name}" if self.kind == "imu" else self.name

    def judge(self, slot: int, *, moved: bool = False) -> bool:
        """Whether this source was still in that second, in which by the IMUs the aircraft `moved`; remembers it."""
        # Of a slow pose sensor the last one, for a short while.
        first, batches = slot if self.kind == "imu" else slot - _CARRY, self.batches.batches
        batch = next((batches[at] for at in range(slot, first - 1, -1) if at in batches), None)
        if self.settling is not None:
            own = batch if batch is not None and batch.slot == slot else None
            if not self.settling.judge(slot, own, moved=moved):
                self.unsettled.append(slot)
        if batch is None:
            # Before the first whole second there is nothing to complain about.
            words = f"{self.label} was silent for a second" if batches else ""
            self.verdict = Verdict(still=False, words=words, fault=True)
        elif batch.slot == slot:
            verdict = self.gate.judge(batch)
            self.verdict = STILL if self.may_move and not verdict.fault else verdict
        return self.verdict.still

    def settled(self, slots: Sequence[int]) -> list[Batch]:
        """Its batches of these seconds that do not follow a movement any more."""
        batches, unsettled = self.batches.batches, frozenset(self.unsettled)
        return [batches[slot] for slot in slots if slot in batches and slot not in unsettled]

    def lacks(self, slots: Sequence[int], needed: int, left_s: int) -> str | None:
        """What its mean over these seconds and the next `left_s` has to wait for, after a movement; else None."""
        unsettled = sum(slot in self.unsettled for slot in slots) if self.unsettled else 0
        needed -= len(slots) - unsettled
        if self.settling is None or unsettled == 0 or needed <= 0 or self.settling.left_s + needed <= left_s:
            return None
        return f"{self.label} settles: {self.settling.left_s + needed} s more"

    def silence(self, now_s: float) -> str | None:
        """One line when nothing comes; None when data flows."""
        last = self.batches.last_s
        if last is None:
            return self.hint or f"no data from {self.label} yet"
        if now_s - last > _SILENT_S:
            return self.hint or f"no data from {self.label} for {now_s - last:.0f} s"
        return None

    def status(self, now_s: float) -> SourceStatus:
        """What can be shown of it."""
        silence = self.silence(now_s)
        newest = next(reversed(self.batches.batches.values()), None)
        return SourceStatus(
            kind=self.kind,
            name=self.name,
            still=self.verdict.still and silence is None,
            words=silence or self.verdict.words,
            rate_hz=newest.n if newest is not None and silence is None else 0,
            dropped=dict(self.batches.dropped),
            lost=self.batches.lost,
        )


class Intake(ABC):
    """The streams, and what is known of each. Nothing that a sample holds makes it raise."""

    def __init__(
        self, keep: int, gradienter: GradienterModel | None, compass: CompassModel | None, deck: Deck | None, span: int
    ) -> None:
        self._keep, self._gradienter, self._compass, self._deck = keep, gradienter, compass, deck
        self._inputs: dict[str, ImuInput] = {}
        self._imus: dict[str, Source] = {}
        self._tilt = None if gradienter is None else self._pose_source("gradienter")
        self._heading = None if compass is None else self._pose_source("compass")
        self._breaks: dict[str, int] = {}
        self._restarted_s: dict[str, float] = {}
        self._up: dict[str, tuple[float, float]] = {}
        """By IMU whose device tells: a time, and for how long it had been on by then."""
        self._field = None if compass is None else FieldHeading(compass, gradienter, keep)
        self._turns = TurnWatch(span)
        self._counters: dict[str, TurnCounter] = {}
        """By IMU, while turns on a spot are counted."""

    @functools.cached_property
    def thermometers(self) -> Thermometers:
        """Of the IMUs; not wanted before the first second."""
        from companion.estimation.temperature.thermometer import Thermometers

        return Thermometers()

    @abstractmethod
    def _evaluate(self) -> None:
        """A second of some stream has ended: judge what can be judged."""

    @abstractmethod
    def reset(self, why: str, imu: str | None = None) -> None:
        """Forget what was measured, of one IMU or of everything."""

    @abstractmethod
    def _break(self) -> None:
        """The still stretch is over."""

    # ------------------------------------------------------------------------------------------------- samples in

    def add_imu(self, name: str, sample: ImuSample) -> None:
        """Take one sample of the IMU of that name; of an unknown name it is dropped."""
        source = self._imus.get(name)
        if source is None:
            return
        if sample.breaks != self._breaks.get(name, 0):
            self._breaks[name] = sample.breaks
            self._restarted_s[name] = sample.t_s
            self._forget(name)
        if name in self._counters:
            self._counters[name].add(sample)
        stamp = sample.sequence if sample.sequence is not None else sample.t_device_s
        row = sample.gyro_rad_s + sample.accel_m_s2
        if source.batches.add(sample.t_s, row, sample.temperature_degc, stamp, sample.shared_variance):
            up_s = sample.t_device_s
            if self._inputs[name].clock_from_start and up_s is not None and 0.0 <= up_s < _LONGEST_UP_S:
                self._up[name] = (sample.t_s, up_s)
            self._evaluate()

    def add_tilt(self, sample: TiltSample) -> None:
        """Take one reading of the gradienter; dropped when none is expected."""
        if self._field is not None:
            self._field.take_tilt(sample)
        if self._tilt is not None and self._tilt.batches.add(
            sample.t_s, (sample.x_deg, sample.y_deg), sample.temperature_degc
        ):
            self._evaluate()

    def add_compass(self, sample: CompassSample) -> bool:
        """Take one heading of the device's own; whether it is the one that counts (else that from its field does)."""
        counts = self._field is None or self._field.takes_own(sample)
        if counts:
            self._take_heading(sample)
        return counts

    def add_field(self, sample: MagSample) -> CompassSample | None:
        """Take the compass' field; the heading that came of it, where that is the one that counts."""
        if self._heading is None or self._field is None:
            return None
        heading = self._field.add(sample)
        self._heading.hint = self._field.hint
        if heading is not None:
            self._take_heading(heading)
        return heading

    def _take_heading(self, sample: CompassSample) -> None:
        if self._heading is not None and self._heading.batches.add(sample.t_s, (sample.heading_deg,)):
            self._evaluate()

    def set_imu(self, imu: ImuInput) -> None:
        """Add an IMU, or say that its stream is another kind now: all that was learned of it is forgotten."""
        self._inputs[imu.name] = imu
        steps = (imu.gyro_step_rad_s, imu.accel_step_m_s2)
        gate = ImuGate(imu.name, imu.profile, steps, sways=self._deck is not None)
        self._turns.set_imu(imu.name, imu.rotation, imu.profile, steps)
        known = self._imus.get(imu.name)
        if self._deck is not None:
            self._deck.set_imu(imu)
        if known is None:
            batches = BatchSource(LIMITS_IMU, self._keep, steps=integer_steps(imu))
            name = imu.name
            batches.believed = lambda slot, degc: self.thermometers.believed(name, slot, degc)
            self._imus[imu.name] = source = Source("imu", imu.name, batches, gate)
            if self._deck is not None:
                source.may_move, batches.on_second = True, functools.partial(self._deck.take_imu, imu.name)
            # It has no share in the seconds so far.
            self._break()
        else:
            known.gate = gate
            known.batches.steps = integer_steps(imu)
            self.reset("another stream", imu.name)

    def expect(self, *, gradienter: bool, compass: bool) -> None:
        """Change which pose sensors are waited for, for example when one is found dead; the IMUs' history stays."""
        added = (gradienter and self._tilt is None) or (compass and self._heading is None)
        if gradienter != (self._tilt is not None):
            self._tilt = self._pose_source("gradienter") if gradienter else None
        if compass != (self._heading is not None):
            self._heading = self._pose_source("compass") if compass else None
        if added:
            self._break()

    def _pose_source(self, name: Literal["gradienter", "compass"]) -> Source:
        """A gradienter's two channels, or a compass' heading, in degrees."""
        circle = name == "compass"
        model = self._compass if circle else self._gradienter
        settling = None if model is None else Settling(model.lag_s, model.sigma_deg, circle=circle)
        batches = BatchSource(_LIMITS_HEADING if circle else _LIMITS_TILT, self._keep, circle=circle)
        source = Source(name, name, batches, PoseGate(name), settling, self._keep)
        if self._deck is not None:
            source.may_move = True
            batches.on_second = self._deck.take_heading if circle else self._deck.take_tilt
        return source

    @property
    def begun_s(self) -> dict[str, float]:
        """By IMU, since when it has been switched on: by its device's clock, else as long as its stream has come."""
        heard = {
            name: max(float(source.batches.begun), self._restarted_s.get(name, -math.inf))
            for name, source in self._imus.items()
            if source.batches.begun is not None
        }
        return heard | {name: t_s - up_s for name, (t_s, up_s) in self._up.items() if name in heard}

    def up_s(self, name: str) -> float | None:
        """For how long the device of an IMU had been on when that was heard last; None where it does not tell."""
        return self._up[name][1] if name in self._up else None

    def forces_m_s2(self, imu: str, start_s: float, end_s: float) -> list[Array]:
        """The mean specific force of each second between two times, (3,) in the IMU's own axes."""
        batches = self._imus[imu].batches.batches
        return [batches[slot].mean[3:] for slot in sorted(batches) if start_s <= slot < end_s]

    def count_turns(self, *, wanted: bool) -> None:
        """Begin to keep what turns on a spot are counted by, or stop it."""
        self._counters = {name: TurnCounter() for name in self._imus} if wanted else {}

    def counted(self, imu: str, start_s: float, end_s: float, bias_rad_s: Array) -> Counted | None:
        """`TurnCounter.counted` of an IMU; None where nothing was kept of it."""
        counter, kind = self._counters.get(imu), self._inputs[imu]
        cut_rad_s = kind.gyro_step_rad_s if kind.truncates else 0.0
        return None if counter is None else counter.counted(start_s, end_s, bias_rad_s, kind.rotation, cut_rad_s)

    @property
    def turn(self) -> Turn:
        """What is known of the platform's own rate."""
        return self._turns.turn

    def _watch_turn(self, slot: int, *, good: bool) -> bool:
        """Look for a turn in a second that has been judged; False where the still stretch ends with it."""
        others = [source.verdict for source in self._sources() if source is not self._heading]
        if self._deck is not None or any(verdict.fault for verdict in others):
            return True
        if not all(verdict.still for verdict in others):
            self._turns.moved(slot)
            return True
        heading = None if self._heading is None else next(iter(self._heading.settled([slot])), None)
        imus = {name: source.batches.batches[slot] for name, source in self._imus.items()}
        return self._turns.add_second(slot, imus, heading, good=good)

    def imu_seconds(self) -> dict[str, Batch]:
        """The last whole second of each IMU that has one, still or not."""
        newest = {name: next(reversed(source.batches.batches.values()), None) for name, source in self._imus.items()}
        return {name: batch for name, batch in newest.items() if batch is not None}

    def tilt_second(self) -> Batch | None:
        """The same of the gradienter."""
        return None if self._tilt is None else next(reversed(self._tilt.batches.batches.values()), None)

    def _forget(self, imu: str | None) -> None:
        if self._deck is not None:
            self._deck.forget(imu)
        for source in self._sources():
            if imu is None or (source.kind == "imu" and source.name == imu):
                source.batches.forget()
                source.verdict = Verdict(still=False)
                if isinstance(source.gate, ImuGate):
                    source.gate.forget_level()
        self._turns.forget(imu)
        self._break()

    def _sources(self) -> list[Source]:
        return [*self._imus.values(), *(source for source in (self._tilt, self._heading) if source is not None)]
