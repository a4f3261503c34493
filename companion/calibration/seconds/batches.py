"""One-second batches: all that is kept of a stream.

Batches lie on one grid for all sources (slot k holds k <= t < k + 1 s of the host's clock), so that a slot of one
IMU and the same slot of the gradienter speak of the same second. Samples are plain tuples until a slot is over;
then numpy looks at them once.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.calibration.seconds.batch import Batch, first_of_each, missing_of, summary, unrolled

MAX_SAMPLES: Final = 4096
"""Kept of one slot; what comes beyond is dropped and counted. Ten times the fastest stream."""

_MAX_TIME_S: Final = 1e12
_BACKWARD_SAMPLES: Final = 20
"""So many samples in a row from the past mean that the clock went back, not that some were late."""
_BACKWARD_S: Final = 2.0


class BatchSource:
    """Collects one stream into batches. Never raises on what arrives; counts what it drops by reason.

    Args:
        limits: (c,) largest believable absolute value of every channel; a sample beyond is dropped.
        keep: how many batches are kept; the oldest go first.
        circle: the single channel is an angle in degrees on [0, 360); means are taken on the circle.
    """

    steps: NDArray[np.float64] | None = None
    """(c,) of a stream of integers, of which every second keeps how often each one came; None for floats."""

    def __init__(self, limits: tuple[float, ...], keep: int, *, circle: bool = False) -> None:
        self.dropped: Counter[str] = Counter()
        self.batches: dict[int, Batch] = {}
        self.closed_through: int | None = None
        """No batch of this slot or an earlier one will come any more."""
        self.last_s: float | None = None
        self.lost = 0
        """Samples that never came, by the device's counter or clock, since the beginning."""
        self.restarts = 0
        """How often the clock went back and everything was dropped."""
        self._limits = np.asarray(limits)
        self._keep = keep
        self._circle = circle
        self._restart()

    def _restart(self) -> None:
        self._slot: int | None = None
        self._slot_start = self._slot_end = -math.inf
        self._newest = -_MAX_TIME_S
        self._partial = True
        self._backward = 0
        self._last_stamp = math.nan
        self._clear()

    def _clear(self) -> None:
        self._times: list[float] = []
        self._rows: list[tuple[float, ...]] = []
        self._stamps: list[float | None] = []
        self._temperature_sum = 0.0
        self._temperature_count = 0

    def forget(self) -> None:
        """Drop all batches and the second under way; what was counted stays."""
        self.batches.clear()
        if self._slot is not None:
            self.closed_through = self._slot
        # The rest of the running second may still hold what is to be forgotten, so it is skipped.
        self._partial = True
        self._last_stamp = math.nan
        self._clear()

    def add(
        self, t_s: float, row: tuple[float, ...], temperature_degc: float | None = None, stamp: float | None = None
    ) -> bool:
        """Take one sample; True when a second has ended with it, or its clock is found to have gone back."""
        ended = False
        if not self._newest <= t_s < self._slot_end:
            if not self._newest <= t_s < _MAX_TIME_S:
                return self._from_the_past(t_s)
            ended = self._open(math.floor(t_s))
        self._newest = t_s
        self.last_s = t_s
        self._backward = 0
        if len(self._rows) >= MAX_SAMPLES:
            self.dropped["too many a second"] += 1
            return ended
        self._times.append(t_s)
        self._rows.append(row)
        self._stamps.append(stamp)
        if temperature_degc is not None and math.isfinite(temperature_degc):
            self._temperature_sum += temperature_degc
            self._temperature_count += 1
        return ended

    def _from_the_past(self, t_s: float) -> bool:
        if not math.isfinite(t_s) or abs(t_s) >= _MAX_TIME_S:
            self.dropped["no valid time"] += 1
            return False
        self.dropped["late or out of order"] += 1
        self._backward = self._backward + 1 if t_s < self._newest - _BACKWARD_S else 0
        if self._backward < _BACKWARD_SAMPLES:
            return False
        self.dropped["time went back"] += 1
        self.restarts += 1
        self.batches.clear()
        self.closed_through = math.floor(t_s)
        self.last_s = t_s
        self._restart()
        self._newest = t_s
        return True

    def _open(self, slot: int) -> bool:
        first = self._slot is None
        self._close()
        self._slot = slot
        self._slot_start, self._slot_end = float(slot), slot + 1.0
        # A stream that has just begun did so in the middle of a second.
        self._partial = first
        self.closed_through = slot - 1
        return not first

    def close_before(self, t_s: float) -> bool:
        """Close the second under way if it ended before `t_s`; True when it did."""
        if self._slot is None or not self._slot_end <= t_s < _MAX_TIME_S:
            return False
        slot = math.floor(t_s)
        self._open(slot)
        # Whatever still comes from before is late now.
        self._newest = max(self._newest, self._slot_start)
        return True

    def _close(self) -> None:
        if self._slot is not None and self._rows and not self._partial:
            batch = self._summarise(self._slot)
            if batch is not None:
                self.batches[batch.slot] = batch
                while len(self.batches) > self._keep:
                    del self.batches[next(iter(self.batches))]
        self._clear()

    def _summarise(self, slot: int) -> Batch | None:
        times, rows = np.array(self._times), np.array(self._rows, dtype=np.float64)
        stamps = None if None in self._stamps else np.array(self._stamps, dtype=np.float64)
        if self._circle:
            rows = unrolled(rows)
        # NaN compares false, so this drops it too.
        believable = np.abs(rows) <= self._limits
        if not believable.all():
            sound = believable.all(axis=1)
            self.dropped["not a believable number"] += int((~sound).sum())
            rows, times = rows[sound], times[sound]
            stamps = None if stamps is None else stamps[sound]
        if stamps is not None:
            fresh = first_of_each(stamps, rows)
            if fresh is not None:
                self.dropped["repeated"] += int((~fresh).sum())
                rows, times, stamps = rows[fresh], times[fresh], stamps[fresh]
        if len(rows) == 0:
            return None
        if stamps is not None:
            self.lost += missing_of(np.concatenate(((self._last_stamp,), stamps)))
            self._last_stamp = stamps[-1]
        return summary(
            slot,
            times,
            rows,
            stamps,
            self._temperature_sum / self._temperature_count if self._temperature_count else None,
            circle=self._circle,
            steps=self.steps,
        )
