"""Input streams of the collector, each with a gate that checks stillness, and the types of the collector's state.

The readings of a gradienter, or of a compass that averages, continue to change after the aircraft has stopped. They
approach the true value with a time constant: in a field gradienter's fluid, the error falls to a tenth in each second
(BEI INC manual; sensors.md sections 2.2 and 2.7). The gate detects only the steep beginning. After a movement that the
IMUs detected, readings of gradienter and compass are used again once their largest possible error is a tenth of sigma.
Readings of the IMUs are used at once.
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
_LONGEST_UP_S: Final = 3e8  # A longer "time since power-up" has another origin, such as UTC
LIMITS_IMU: Final = (1e3,) * 3 + (1e4,) * 3
_LIMITS_TILT: Final = (180.0,) * 2
_LIMITS_HEADING: Final = (1e3,)
OFF_DEG: Final = 5.0  # Largest error of a pose sensor right after a movement
_SHARE: Final = 0.1

LOWEST_DEGC: Final = -40.0
HIGHEST_DEGC: Final = 105.0  # Widest range in data sheets of IMUs
_NONE_AFTER_S: Final = 10
_ADJACENT_S: Final = 3
JUMP_K: Final = 5.0  # Change within a second that is too fast for any board
_JUMPS: Final = 2
_WITHIN_S: Final = 600


class Settings(msgspec.Struct, frozen=True, kw_only=True):
    """Durations and target sigmas of a calibration; `math.inf`: no target."""

    min_still_s: float
    max_s: float
    target_gyro_sigma_rad_s: float
    target_accel_sigma_m_s2: float
    horizon_s: float = 180.0

    @property
    def min_slots(self) -> int:
        return max(math.ceil(self.min_still_s), 1)

    @property
    def max_slots(self) -> int:
        return max(math.floor(self.max_s), self.min_slots)


class CollectorObstacle(msgspec.Struct, frozen=True):
    """Reason why no measurement is possible now: a movement, a fault, or a wait."""

    words: str
    moving: bool = False  # True for a movement, which the operator can end; False for a fault
    hold_still_s: int | None = None
    """Further seconds for which the aircraft must be held still, if nothing else blocks the measurement; else None."""


class SourceStatus(msgspec.Struct, frozen=True, kw_only=True):
    """State of one sensor's stream; `words`: text on a movement, fault or silence of the sensor.

    `rate_hz`: samples in the last whole second. `lost`: number of missing samples, by the device's counter or clock.
    """

    kind: Kind
    name: str
    still: bool
    words: str
    rate_hz: int
    dropped: dict[str, int]
    lost: int


class CollectorStatus(msgspec.Struct, frozen=True, kw_only=True):
    """State of the collector; `RollingCollector.glance` leaves out the fields that need an estimate.

    A second is good if all sensors were motionless and worked. `still_s`: good seconds since the aircraft came to rest.
    `steady_s`: good seconds in a row until now. `hold_still_s`: seconds until a window is possible. `enough`: more
    seconds would not improve the result. `progress`: 0 to 1, from the start to `enough`. `measuring`: text on the
    measurement. `left`: text on the remaining time; on a deck only.
    """

    still_s: float
    steady_s: float
    good_now: bool  # True if the latest second counts
    hold_still_s: int = 0
    obstacle: CollectorObstacle | None = None
    """Present movement, or a silent or stuck sensor; in `RollingCollector.status`, also any other reason to wait."""
    enough: bool = False
    progress: float = 0.0
    sources: tuple[SourceStatus, ...] = ()
    measuring: str = ""
    left: str = ""

    @property
    def waiting_for(self) -> str | None:
        return None if self.obstacle is None else self.obstacle.words

    @property
    def moving(self) -> bool:
        return self.obstacle is not None and self.obstacle.moving

    @property
    def moves(self) -> str | None:
        """Description of the present movement; None if nothing moves."""
        found = self.obstacle
        return found.words if found is not None and found.moving and found.hold_still_s is None else None


class Thermometer:
    """Plausibility check of an IMU's thermometer, second by second.

    A thermometer with a wrong unit, or with jumps, is ignored, and the IMU counts as having none. A constant reading is
    not a fault: a board reaches a steady temperature, and a heater keeps its IMU warm.
    """

    def __init__(self) -> None:
        self._begin(math.inf)

    def _begin(self, slot: float) -> None:
        self.none = False  # True for an IMU whose messages carry no temperature
        self.wrong = ""
        """Reason, in one line, why the thermometer is ignored; empty if it is used or does not exist."""
        self._slot = slot  # Second of the latest reading, or the first second
        self._degc: float | None = None
        self._jumps: deque[float] = deque(maxlen=_JUMPS)

    def believed(self, slot: int, degc: float | None) -> float | None:
        if slot < self._slot:
            self._begin(slot)
        if degc is None or not math.isfinite(degc):
            self.none = slot - self._slot >= _NONE_AFTER_S
            return None
        jumped = self._degc is not None and abs(degc - self._degc) > JUMP_K and slot - self._slot <= _ADJACENT_S
        if jumped:
            self._jumps.append(slot)
        self._slot, self._degc, self.none, wrong = slot, degc, False, ""
        if not LOWEST_DEGC <= degc <= HIGHEST_DEGC:
            allowed = f"{LOWEST_DEGC:g} to {HIGHEST_DEGC:g} degC"
            wrong = f"shows {degc:.2f}, allowed {allowed}: in another unit?"
        elif len(self._jumps) == _JUMPS and slot - self._jumps[0] <= _WITHIN_S:
            wrong = f"jumps: more than {JUMP_K:g} K within a second, again and again"
        self.wrong = f"its thermometer {wrong}; its temperature is not used" if wrong else ""
        return None if wrong or jumped else degc


class Settling:
    """Detects the seconds in which a gradienter or compass has not yet settled after a movement.

    The readings approach the true value with the time constant `lag_s` (0: at once). The sensor has settled when the
    largest possible error is a tenth of `sigma_deg`.
    """

    def __init__(self, lag_s: float, sigma_deg: float) -> None:
        self.left_s = 0  # Seconds until its readings count again, as of the last second judged
        # Without a lag nothing settles, however small the stated sigma is.
        self._tail_s = math.ceil(lag_s * math.log(max(OFF_DEG / (_SHARE * sigma_deg), 1.0))) if lag_s > 0.0 else 0
        self._moved: int | None = None  # Last second in which the aircraft moved

    def judge(self, slot: int, *, moved: bool) -> bool:
        """Return true if the sensor is settled in second `slot`; seconds must ascend. `moved`: IMUs detected motion."""
        if moved:
            self._moved = slot
        self.left_s = 0 if self._moved is None else max(self._moved + 1 + self._tail_s - slot, 0)
        return self._tail_s == 0 or self._moved is None or slot > self._moved + self._tail_s


class Source:
    """Input stream of one sensor: its one-second batches, its gate (stillness check), and the gate's last verdict."""

    carry = 0  # Seconds for which the last reading stays valid

    def __init__(self, kind: Kind, name: str, batches: BatchSource, gate: ImuGate | PoseGate) -> None:
        self.kind, self.name, self.batches, self.gate = kind, name, batches, gate
        self.verdict = GateVerdict(still=False)
        self.hint = self.trouble = ""  # Texts in place of "no data": on the readings, and on the bytes of the port

    @property
    def label(self) -> str:
        return f"imu {self.name}" if self.kind == "imu" else self.name

    @property
    def newest(self) -> Batch | None:
        return next(reversed(self.batches.batches.values()), None)

    def judge(self, slot: int, *, moved: bool, may_move: bool) -> bool:
        """Return true if this sensor was motionless in second `slot`; `moved`: the IMUs detected a movement then.

        `may_move`: movements are allowed, and only a fault of the sensor makes the result false.
        """
        batches = self.batches.batches
        batch = next((batches[at] for at in range(slot, slot - self.carry - 1, -1) if at in batches), None)
        if batch is None:
            # Before the first whole second, silence is no fault.
            words = f"{self.label} was silent for a second" if batches else ""
            self.verdict = GateVerdict(still=False, words=words, fault=True)
        elif batch.slot == slot:
            verdict = self.gate.judge(batch)
            self.verdict = STILL if may_move and not verdict.fault else verdict
        return self.verdict.still

    def accept(self, slot: int) -> None:
        """Pass the gate a second in which all sensors were motionless, for comparison with later seconds."""
        if (batch := self.batches.batches.get(slot)) is not None:
            self.gate.accept(batch)

    def forget(self) -> None:
        self.batches.forget()
        self.verdict = GateVerdict(still=False)

    def silence(self, now_s: float) -> str | None:
        last = self.batches.last_s
        if last is not None and now_s - last <= _SILENT_S:
            return None
        since = "yet" if last is None else f"for {now_s - last:.0f} s"
        return self.trouble or self.hint or f"no data from {self.label} {since}"

    def status(self, now_s: float) -> SourceStatus:
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
    """Input stream of one IMU, with a turn counter. Beside a stream of integers, means in floats can arrive."""

    gate: ImuGate

    def __init__(self, imu: ImuInput, keep: int) -> None:
        super().__init__("imu", imu.name, BatchSource(LIMITS_IMU, keep, steps=imu.steps), _gate(imu))
        self.imu = imu
        self.raw = BatchSource(LIMITS_IMU, keep)
        """One-second batches of the means in floats that a device sends in addition to a stream of integers."""
        self._raw_count = 0
        self.counter: TurnCounter | None = None  # Set while the turns of an alignment are counted
        self._breaks = 0
        self._restarted_s = -math.inf
        self._up: tuple[float, float] | None = None
        """Host time of a sample, and the time since power-up in that sample, s; None if the device reports none."""

    def replace(self, imu: ImuInput) -> None:
        self.imu, self.gate, self.batches.steps = imu, _gate(imu), imu.steps

    def add_raw(self, t_s: float, row: tuple[float, ...], temperature_degc: float | None) -> None:
        self._raw_count += 1
        self.raw.add(t_s, row, temperature_degc, float(self._raw_count))

    def forget(self) -> None:
        super().forget()
        self.raw.forget()
        self.gate.forget_level()

    def has_restarted(self, sample: ImuSample) -> bool:
        if sample.breaks == self._breaks:
            return False
        self._breaks, self._restarted_s = sample.breaks, sample.t_s
        return True

    def add(self, sample: ImuSample) -> bool:
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
        """Host time of power-up by the device's clock, else of the first sample, s; None before the first sample."""
        if self.batches.begun is None:
            return None
        if self._up is not None:
            return self._up[0] - self._up[1]
        return max(float(self.batches.begun), self._restarted_s)

    @property
    def up_s(self) -> float | None:
        return None if self._up is None else self._up[1]

    def forces_m_s2(self, start_s: float, end_s: float) -> list[Array]:
        """Return the mean specific force (3,) of each second between two times, in the IMU's own axes."""
        batches = self.batches.batches
        return [batches[slot].mean[3:] for slot in sorted(batches) if start_s <= slot < end_s]

    def counted(self, start_s: float, end_s: float, bias_rad_s: Array) -> Counted | None:
        if self.counter is None:
            return None
        return self.counter.counted(start_s, end_s, bias_rad_s, self.imu.rotation, self.imu.gyro_step_rad_s)


def _gate(imu: ImuInput) -> ImuGate:
    return ImuGate(imu.name, imu.profile, (imu.gyro_step_rad_s, imu.accel_step_m_s2))


class PoseSource(Source):
    """Input stream of a gradienter (two channels) or of a compass (heading), in degrees."""

    carry = 2  # Allows for a slow gradienter or compass

    def __init__(self, model: GradienterModel | CompassModel | None, kind: PoseKind, keep: int) -> None:
        circle = kind == "compass"
        batches = BatchSource(_LIMITS_HEADING if circle else _LIMITS_TILT, keep, circle=circle)
        super().__init__(kind, kind, batches, PoseGate(kind))
        self._settling = Settling(0.0, 1.0) if model is None else Settling(model.lag_s, model.sigma_deg)
        self._unsettled: deque[int] = deque(maxlen=keep)
        """Seconds in which this sensor had not settled: means of other sensors use them, its own mean does not."""

    def judge(self, slot: int, *, moved: bool, may_move: bool) -> bool:
        if not self._settling.judge(slot, moved=moved):
            self._unsettled.append(slot)
        return super().judge(slot, moved=moved, may_move=may_move)

    def accept(self, slot: int) -> None:
        if slot not in self._unsettled:
            super().accept(slot)

    def settled(self, slots: Sequence[int]) -> list[Batch]:
        batches, unsettled = self.batches.batches, frozenset(self._unsettled)
        return [batches[slot] for slot in slots if slot in batches and slot not in unsettled]

    def lacks(self, slots: Sequence[int], needed: int, left_s: int) -> str | None:
        """Describe the wait for enough settled seconds among `slots` and the next `left_s` seconds; None: no wait."""
        unsettled = sum(slot in self._unsettled for slot in slots)
        needed -= len(slots) - unsettled
        wait_s = self._settling.left_s + needed
        if unsettled == 0 or needed <= 0 or wait_s <= left_s:
            return None
        return f"{self.label} settles: {wait_s} s more"
