"""One stream into the collector: its seconds, its gate and its verdict.

A gradienter, or a compass that averages, goes on moving after the aircraft has stopped: both follow the truth with a
time constant; the fluid of a field gradienter keeps a tenth of its error after every second (BEI INC manual; sensors
2.2 and 2.7). The gate sees only the steep beginning of that. So after every second that was not still by the IMUs, its
seconds count again once the largest error has died away to a tenth of its sigma. Those of the IMUs count meanwhile.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Final, Literal

import msgspec

from companion.estimation.means.pose import CompassModel, GradienterModel
from companion.estimation.means.windows import ImuInput
from companion.estimation.seconds.batch import Batch, BatchSource
from companion.estimation.seconds.counting import Counted, TurnCounter
from companion.estimation.stillness.gates import STILL, GateVerdict, ImuGate, PoseGate
from companion.physics.frames import Array
from companion.samples import ImuSample

Kind = Literal["imu", "gradienter", "compass"]
PoseKind = Literal["gradienter", "compass"]

_SILENT_S: Final = 2.5
_CARRY: Final = 2
"""Seconds for which a slow gradienter's or compass' last reading stands."""
_LONGEST_UP_S: Final = 3e8
"""A longer time since power-up counts from somewhere else, such as UTC."""
LIMITS_IMU: Final = (1e3,) * 3 + (1e4,) * 3
_LIMITS_TILT: Final = (180.0,) * 2
_LIMITS_HEADING: Final = (1e3,)


OFF_DEG: Final = 5.0
"""Largest error that a movement leaves in a pose sensor."""
_SHARE: Final = 0.1


class SourceStatus(msgspec.Struct, frozen=True, kw_only=True):
    """State of one source."""

    kind: Kind
    name: str
    still: bool
    words: str
    """Reason for not being still; empty when still."""
    rate_hz: int
    """Samples in its last whole second."""
    dropped: dict[str, int]
    lost: int
    """Samples that never came, by the device's counter or clock."""


class Settling:
    """Knows which seconds of a pose sensor are still the tail of a movement.

    The sensor follows the truth with the time constant `lag_s`, 0 for none; a tenth of `sigma_deg` may remain.
    """

    def __init__(self, lag_s: float, sigma_deg: float) -> None:
        self.left_s = 0
        """Seconds until its readings count again, as of the last second judged."""
        # Without a lag nothing follows, however exact the sensor is said to be.
        self._tail_s = math.ceil(lag_s * math.log(max(OFF_DEG / (_SHARE * sigma_deg), 1.0))) if lag_s > 0.0 else 0
        self._moved: int | None = None
        """Last second in which the aircraft moved."""

    def judge(self, slot: int, *, moved: bool) -> bool:
        """Judge whether the second counts, seconds ascending; `moved`: the IMUs were not still."""
        if moved:
            self._moved = slot
        self.left_s = 0 if self._moved is None else max(self._moved + 1 + self._tail_s - slot, 0)
        return self._tail_s == 0 or self._moved is None or slot > self._moved + self._tail_s


class Source:
    """One stream: its batches, its gate, its last verdict."""

    hint = ""
    """Reason for silence, where it is known."""

    def __init__(self, kind: Kind, name: str, batches: BatchSource, gate: ImuGate | PoseGate) -> None:
        self.kind, self.name, self.batches, self.gate = kind, name, batches, gate
        self.verdict = GateVerdict(still=False)
        self.settling: Settling | None = None
        self.unsettled: deque[int] = deque(maxlen=0)
        """Seconds in which its readings still followed a movement; good for the others, not for a mean of its own."""

    @property
    def label(self) -> str:
        """Name for a pilot."""
        return f"imu {self.name}" if self.kind == "imu" else self.name

    @property
    def newest(self) -> Batch | None:
        """The last whole second."""
        return next(reversed(self.batches.batches.values()), None)

    def judge(self, slot: int, *, moved: bool, may_move: bool) -> bool:
        """Return whether this source was still in a second in which, by the IMUs, the aircraft `moved`.

        `may_move`: only a fault of the source counts against it.
        """
        # A slow pose sensor's last batch counts for a short while.
        first, batches = slot if self.kind == "imu" else slot - _CARRY, self.batches.batches
        batch = next((batches[at] for at in range(slot, first - 1, -1) if at in batches), None)
        if self.settling is not None and not self.settling.judge(slot, moved=moved):
            self.unsettled.append(slot)
        if batch is None:
            # Before the first whole second there is nothing to complain about.
            words = f"{self.label} was silent for a second" if batches else ""
            self.verdict = GateVerdict(still=False, words=words, fault=True)
        elif batch.slot == slot:
            verdict = self.gate.judge(batch)
            self.verdict = STILL if may_move and not verdict.fault else verdict
        return self.verdict.still

    def accept(self, slot: int) -> None:
        """Let the gate learn from a second in which every source was still."""
        batch = self.batches.batches.get(slot)
        if batch is not None and (self.kind == "imu" or slot not in self.unsettled):
            self.gate.accept(batch)

    def forget(self) -> None:
        """Drop the seconds so far."""
        self.batches.forget()
        self.verdict = GateVerdict(still=False)
        if isinstance(self.gate, ImuGate):
            self.gate.forget_level()

    def settled(self, slots: Sequence[int]) -> list[Batch]:
        """Return the batches of these seconds that no longer follow a movement."""
        batches, unsettled = self.batches.batches, frozenset(self.unsettled)
        return [batches[slot] for slot in slots if slot in batches and slot not in unsettled]

    def lacks(self, slots: Sequence[int], needed: int, left_s: int) -> str | None:
        """Say how long its mean over these seconds and the next `left_s` has to wait after a movement, if at all."""
        unsettled = sum(slot in self.unsettled for slot in slots) if self.unsettled else 0
        needed -= len(slots) - unsettled
        if self.settling is None or unsettled == 0 or needed <= 0 or self.settling.left_s + needed <= left_s:
            return None
        return f"{self.label} settles: {self.settling.left_s + needed} s more"

    def silence(self, now_s: float) -> str | None:
        """Return one line when nothing comes; None when data flows."""
        last = self.batches.last_s
        if last is None:
            return self.hint or f"no data from {self.label} yet"
        if now_s - last > _SILENT_S:
            return self.hint or f"no data from {self.label} for {now_s - last:.0f} s"
        return None

    def status(self, now_s: float) -> SourceStatus:
        """Return the state to show."""
        silence, newest = self.silence(now_s), self.newest
        return SourceStatus(
            kind=self.kind,
            name=self.name,
            still=self.verdict.still and silence is None,
            words=silence or self.verdict.words,
            rate_hz=newest.n if newest is not None and silence is None else 0,
            dropped=dict(self.batches.dropped),
            lost=self.batches.lost,
        )


class ImuSource(Source):
    """The stream of one IMU, with what is known of its device."""

    def __init__(self, imu: ImuInput, keep: int) -> None:
        batches = BatchSource(LIMITS_IMU, keep, steps=imu.steps)
        super().__init__("imu", imu.name, batches, _gate(imu))
        self.imu = imu
        self.raw = BatchSource(LIMITS_IMU, keep)
        """Means that come beside a stream of integers, in floats."""
        self._raw_count = 0
        self.counter: TurnCounter | None = None
        """Set while turns on a spot are counted."""
        self._breaks = 0
        self._restarted_s = -math.inf
        self._up: tuple[float, float] | None = None
        """A time, and the time since power-up by then, where the device tells."""

    def replace(self, imu: ImuInput) -> None:
        """Set the new kind of the stream."""
        self.imu, self.gate = imu, _gate(imu)
        self.batches.steps = imu.steps

    def add_raw(self, t_s: float, row: tuple[float, ...], temperature_degc: float | None) -> None:
        """Add a mean that tells more than the stream."""
        self._raw_count += 1
        self.raw.add(t_s, row, temperature_degc, float(self._raw_count))

    def forget(self) -> None:
        """Drop the seconds so far."""
        super().forget()
        self.raw.forget()

    def has_restarted(self, sample: ImuSample) -> bool:
        """Return whether the stream was interrupted just before a sample."""
        if sample.breaks == self._breaks:
            return False
        self._breaks, self._restarted_s = sample.breaks, sample.t_s
        return True

    def add(self, sample: ImuSample) -> bool:
        """Add a sample; return whether a second may have ended."""
        if self.counter is not None:
            self.counter.add(sample)
        stamp = sample.sequence if sample.sequence is not None else sample.t_device_s
        row = sample.gyro_rad_s + sample.accel_m_s2
        if not self.batches.add(sample.t_s, row, sample.temperature_degc, stamp, sample.shared_variance):
            return False
        up_s = sample.t_device_s
        if self.imu.clock_from_start and up_s is not None and 0.0 <= up_s < _LONGEST_UP_S:
            self._up = sample.t_s, up_s
        return True

    @property
    def begun_s(self) -> float | None:
        """Time of power-up by the device's clock, else of the first sample; None before it."""
        if self.batches.begun is None:
            return None
        if self._up is not None:
            return self._up[0] - self._up[1]
        return max(float(self.batches.begun), self._restarted_s)

    @property
    def up_s(self) -> float | None:
        """Time since power-up by the latest sample; None where the device does not tell."""
        return None if self._up is None else self._up[1]

    def forces_m_s2(self, start_s: float, end_s: float) -> list[Array]:
        """Return the mean specific force of each second between two times, (3,) in the IMU's own axes."""
        batches = self.batches.batches
        return [batches[slot].mean[3:] for slot in sorted(batches) if start_s <= slot < end_s]

    def counted(self, start_s: float, end_s: float, bias_rad_s: Array) -> Counted | None:
        """Return `TurnCounter.counted`; None where nothing was kept."""
        if self.counter is None:
            return None
        return self.counter.counted(start_s, end_s, bias_rad_s, self.imu.rotation, self.imu.gyro_step_rad_s)


def _gate(imu: ImuInput) -> ImuGate:
    return ImuGate(imu.name, imu.profile, (imu.gyro_step_rad_s, imu.accel_step_m_s2))


class PoseSource(Source):
    """The two channels of a gradienter, or the heading of a compass, in degrees."""

    def __init__(self, model: GradienterModel | CompassModel | None, kind: PoseKind, keep: int) -> None:
        circle = kind == "compass"
        batches = BatchSource(_LIMITS_HEADING if circle else _LIMITS_TILT, keep, circle=circle)
        super().__init__(kind, kind, batches, PoseGate(kind))
        self.settling = None if model is None else Settling(model.lag_s, model.sigma_deg)
        self.unsettled = deque(maxlen=keep)
