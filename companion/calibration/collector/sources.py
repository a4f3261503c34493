"""One stream of the collector: its batches, its gate, its last verdict, and what it tells people."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Final, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.calibration.seconds.batch import Batch, BatchSource
from companion.calibration.stillness.gates import ImuGate, PoseGate, Verdict, compass_gate, gradienter_gate
from companion.calibration.stillness.settling import Lag, Settling

Kind = Literal["imu", "gradienter", "compass"]

_SILENT_S: Final = 2.5
_CARRY: Final = 2
"""Seconds for which a slow gradienter's or compass' last reading stands."""
_LIMITS_IMU: Final = (1e3,) * 3 + (1e4,) * 3
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
        self.kind = kind
        self.name = name
        self.batches = batches
        self.gate = gate
        self.settling = settling
        self.verdict = Verdict(still=False)
        self.unsettled: deque[int] = deque(maxlen=keep)
        """Seconds in which its readings still followed a movement; good for the others, not for a mean of its own."""

    @property
    def label(self) -> str:
        """As a pilot calls it."""
        return f"imu {self.name}" if self.kind == "imu" else self.name

    def batch_for(self, slot: int) -> Batch | None:
        """The batch of that second; of a slow pose sensor the last one, for a short while."""
        found = self.batches.batches.get(slot)
        if found is None and self.kind != "imu":
            for earlier in range(slot - 1, slot - _CARRY - 1, -1):
                found = self.batches.batches.get(earlier)
                if found is not None:
                    break
        return found

    def judge(self, slot: int, *, moved: bool = False) -> bool:
        """Whether this source was still in that second, in which by the IMUs the aircraft `moved`; remembers it."""
        batch = self.batch_for(slot)
        if self.settling is not None:
            own = batch if batch is not None and batch.slot == slot else None
            if not self.settling.judge(slot, own, moved=moved):
                self.unsettled.append(slot)
        if batch is None:
            # Before the first whole second there is nothing to complain about.
            words = f"{self.label} was silent for a second" if self.batches.batches else ""
            self.verdict = Verdict(still=False, words=words, fault=True)
        elif batch.slot == slot:
            self.verdict = self.gate.judge(batch)
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


def imu_source(name: str, gate: ImuGate, keep: int) -> Source:
    """A source of six channels: gyro in rad/s, accelerometer in m/s^2."""
    return Source("imu", name, BatchSource(_LIMITS_IMU, keep), gate)


def integer_batches(steps: NDArray[np.float64], keep: int) -> BatchSource:
    """Seconds of an IMU's stream of truncated integers, (6,) steps in SI units, outside of a collector."""
    batches = BatchSource(_LIMITS_IMU, keep)
    batches.steps = steps
    return batches


def gradienter_source(keep: int, lag: Lag) -> Source:
    """A source of two channels in degrees."""
    batches = BatchSource(_LIMITS_TILT, keep)
    return Source("gradienter", "gradienter", batches, gradienter_gate(), Settling(lag), keep)


def compass_source(keep: int, lag: Lag) -> Source:
    """A source of one heading in degrees."""
    batches = BatchSource(_LIMITS_HEADING, keep, circle=True)
    return Source("compass", "compass", batches, compass_gate(), Settling(lag, circle=True), keep)
