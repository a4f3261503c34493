"""One-second batches: all that is kept of a stream.

Batches lie on one grid for all sources (slot k holds k <= t < k + 1 s of the host's clock), so that a slot of one
IMU and the same slot of the gradienter speak of the same second. Samples are plain tuples until a slot is over;
then numpy looks at them once.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.calibration.batch import (
    MAX_LEVELS,
    Batch,
    Counts,
    Floats,
    counts_of,
    first_of_each,
    is_clipped,
    missing_of,
    unrolled,
)
from companion.protocols.bulk import Block

if TYPE_CHECKING:
    from companion.calibration.seconds import Seconds

__all__ = ["MAX_LEVELS", "MAX_SAMPLES", "Batch", "BatchSource", "Counts"]

_Piece = tuple[Floats, Floats, Floats | None]
"""Times, rows and stamps."""

MAX_SAMPLES: Final = 4096
"""Kept of one slot; what comes beyond is dropped and counted. Ten times the fastest stream."""

_MAX_TIME_S: Final = 1e12
_BACKWARD_SAMPLES: Final = 20
"""So many samples in a row from the past mean that the clock went back, not that some were late."""
_BACKWARD_S: Final = 2.0


class _Block:
    """A block that is being taken, and which part of it the second under way is, where it is nothing else."""

    __slots__ = ("block", "seconds", "start", "stop")

    def __init__(self, block: Block, seconds: Seconds) -> None:
        self.block, self.seconds = block, seconds
        self.start = self.stop = -1


class BatchSource:
    """Collects one stream into batches. Never raises on what arrives; counts what it drops by reason.

    Args:
        limits: (c,) largest believable absolute value of every channel; a sample beyond is dropped.
        keep: how many batches are kept; the oldest go first.
        circle: the single channel is an angle in degrees on [0, 360); means are taken on the circle.
    """

    _pieces: tuple[_Piece, ...] = ()
    """Of the second under way, what came in blocks; what came later one by one is in the lists."""
    _in_pieces = 0
    """Samples of the second under way that are in `_pieces`."""

    _block: _Block | None = None
    """That is being taken, to save work."""

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
        self._pieces = ()
        self._in_pieces = 0
        if self._block is not None:
            self._block.start = self._block.stop = -1
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
        if len(self._rows) + self._in_pieces >= MAX_SAMPLES:
            self.dropped["too many a second"] += 1
            return ended
        self._times.append(t_s)
        self._rows.append(row)
        self._stamps.append(stamp)
        if temperature_degc is not None and math.isfinite(temperature_degc):
            self._temperature_sum += temperature_degc
            self._temperature_count += 1
        return ended

    def take(self, block: Block, start: int, stop: int) -> tuple[int, bool]:
        """Take samples of a block up to `stop`, or to the end of a second: `add` of each, at once.

        Returns:
            Where to go on, and whether a second has ended with the first of them, as `add` says it.
        """
        times = block.t_s
        first_s = float(times[start])
        ended = False
        if not self._newest <= first_s < self._slot_end:
            if not self._newest <= first_s < _MAX_TIME_S:
                stamp = None if block.stamps is None else float(block.stamps[start])
                temperature_degc = None if block.temperature_degc is None else float(block.temperature_degc[start])
                return start + 1, self.add(first_s, tuple(block.rows[start].tolist()), temperature_degc, stamp)
            ended = self._open(math.floor(first_s))
        stop = start + int(times[start:stop].searchsorted(self._slot_end))
        self._newest = self.last_s = float(times[stop - 1])
        self._backward = 0
        room = MAX_SAMPLES - len(self._rows) - self._in_pieces
        kept = slice(start, min(stop, start + max(room, 0)))
        if stop > kept.stop:
            self.dropped["too many a second"] += stop - kept.stop
        self._note(block, start, kept.stop)
        self._collect_piece()
        stamps = None if block.stamps is None else block.stamps[kept]
        self._pieces = (*self._pieces, (times[kept], block.rows[kept], stamps))
        self._in_pieces += kept.stop - start
        if block.temperature_degc is not None and kept.stop > start:
            # One after the other, as `add` does.
            readings = np.concatenate(([self._temperature_sum], block.temperature_degc[kept]))
            self._temperature_sum = float(np.add.accumulate(readings)[-1])
            self._temperature_count += kept.stop - start
        return stop, ended

    def _note(self, block: Block, start: int, stop: int) -> None:
        """Remember which part of a block the second under way is."""
        known = self._block
        if known is None or known.block is not block:
            from companion.calibration.seconds import Seconds

            known = self._block = _Block(block, Seconds(block, self._limits, circle=self._circle))
        if not self._in_pieces and not self._rows:
            known.start, known.stop = start, stop
        elif known.stop == start:
            known.stop = stop
        else:
            known.start = known.stop = -1

    def _collect_piece(self) -> None:
        """Put what came one by one behind the pieces."""
        if not self._rows:
            return
        stamps = None if None in self._stamps else np.array(self._stamps, dtype=np.float64)
        piece = np.array(self._times), np.array(self._rows, dtype=np.float64), stamps
        self._pieces = (*self._pieces, piece)
        self._in_pieces += len(self._rows)
        self._times, self._rows, self._stamps = [], [], []

    def _whole(self) -> _Piece:
        """All samples of the second under way, at least one."""
        if not self._in_pieces:
            stamps = None if None in self._stamps else np.array(self._stamps, dtype=np.float64)
            return np.array(self._times), np.array(self._rows, dtype=np.float64), stamps
        self._collect_piece()
        pieces = self._pieces
        stamped = [stamps for _, _, stamps in pieces if stamps is not None]
        return (
            np.concatenate([times for times, _, _ in pieces]),
            np.concatenate([rows for _, rows, _ in pieces]),
            np.concatenate(stamped) if len(stamped) == len(pieces) else None,
        )

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
        if self._slot is not None and (self._rows or self._in_pieces) and not self._partial:
            batch = self._summarise(self._slot)
            if batch is not None:
                self.batches[batch.slot] = batch
                while len(self.batches) > self._keep:
                    del self.batches[next(iter(self.batches))]
        self._clear()

    def _worked_out(self) -> Batch | None:
        """The second under way, where it has been summarised together with others; else None."""
        known = self._block
        if known is None or known.stop - known.start != len(self._rows) + self._in_pieces:
            return None
        batch = known.seconds.of(known.start, known.stop)
        if batch is None:
            return None
        block = known.block
        if (stamps := block.stamps) is not None:
            if self._last_stamp != stamps[known.start - 1]:
                self.lost += missing_of(np.concatenate(((self._last_stamp,), stamps[known.start : known.stop])))
            self._last_stamp = stamps[known.stop - 1]
        if self.steps is not None:
            counts = counts_of(block.rows[known.start : known.stop], self.steps)
            batch = msgspec.structs.replace(batch, counts=counts)
        return batch

    def _summarise(self, slot: int) -> Batch | None:
        if (batch := self._worked_out()) is not None:
            return batch
        times, rows, stamps = self._whole()
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
        n = len(rows)
        if n == 0:
            return None
        if stamps is not None:
            self.lost += missing_of(np.concatenate(((self._last_stamp,), stamps)))
            self._last_stamp = stamps[-1]
        ordered = np.sort(rows, axis=0)
        distinct = 1 + (ordered[1:] != ordered[:-1]).sum(axis=0)
        # The very sums of `mean` and `var`, each once.
        centre = np.add.reduce(rows, axis=0) / n
        off, steps = rows - centre, rows[1:] - rows[:-1]
        gaps = times[1:] - times[:-1]
        edges = float(times[0]) - float(slot), slot + 1.0 - float(times[-1])
        return Batch(
            slot=slot,
            n=n,
            first_s=float(times[0]),
            last_s=float(times[-1]),
            mean=np.mod(centre, 360.0) if self._circle else centre,
            variance=np.add.reduce(off * off, axis=0) / (n - 1) if n > 1 else np.zeros(rows.shape[1]),
            white=np.add.reduce(steps * steps, axis=0) / (n - 1) / 2.0 if n > 1 else np.zeros(rows.shape[1]),
            low=ordered[0],
            high=ordered[-1],
            distinct=np.asarray(distinct, dtype=np.int64),
            clipped=is_clipped(ordered, distinct),
            largest_gap_s=max(*edges, float(gaps.max()) if n > 1 else 0.0),
            missing=None if stamps is None else missing_of(stamps),
            temperature_degc=self._temperature_sum / self._temperature_count if self._temperature_count else None,
            counts=None if self.steps is None else counts_of(rows, self.steps),
        )
