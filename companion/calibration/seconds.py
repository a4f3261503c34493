"""The whole seconds of a block of readings, summarised together: numpy's price is by the call, not by the second.

Only what is regular is worked out here: every reading believable, none repeated, none missing, no channel at the end of
its range. What is not is left to `BatchSource`, which knows every case; so nothing here may differ from it by a bit.
Sums over a second go through its rows in their order, whether one second is summed or a hundred of them beside each
other.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.calibration.batch import EVEN, PINNED_DISTINCT, PINNED_SAMPLES, Batch, Floats
from companion.protocols.bulk import Block

FEWEST_SECONDS: Final = 3
"""A block of fewer has none that is surely whole, or one for which it is not worth while."""


class Seconds:
    """The seconds of a block that are whole whatever came before and comes after: all but the first and the last.

    Args:
        block: the readings.
        limits: (c,) largest believable absolute value of every channel.
        circle: the single channel is an angle in degrees on [0, 360).
    """

    def __init__(self, block: Block, limits: Floats, *, circle: bool) -> None:
        self._block = block
        self._found: dict[int, Batch] = {}
        """By their first reading: what `BatchSource` would make of them, counts apart."""
        slots = np.floor(block.t_s)
        if len(block) == 0 or slots[-1] - slots[0] < FEWEST_SECONDS - 1 or not np.isfinite(slots).all():
            return
        cuts = np.flatnonzero(slots[1:] != slots[:-1]) + 1
        starts, stops = cuts[:-1], cuts[1:]
        if block.stamps is not None:
            # With the step from the second before.
            even = _even(np.diff(block.stamps), starts - 1, stops - 1)
            starts, stops = starts[even], stops[even]
        counts = stops - starts
        for n in set(counts.tolist()):
            if n > 1:
                chosen = counts == n
                self._summarise(starts[chosen], n, slots, limits, circle=circle)

    def of(self, start: int, stop: int) -> Batch | None:
        """The batch of the second that has exactly these readings of the block; None where it is to be worked out."""
        found = self._found.get(start)
        return found if found is not None and found.n == stop - start else None

    def _summarise(self, starts: NDArray[np.int64], n: int, slots: Floats, limits: Floats, *, circle: bool) -> None:
        """All seconds of n readings."""
        block = self._block
        at = starts[:, None] + np.arange(n)
        rows = block.rows[at]
        if circle:
            first = rows[:, :1]
            with np.errstate(invalid="ignore"):
                rows = first + np.mod(rows - first + 180.0, 360.0) - 180.0
        # NaN compares false, so this drops it too.
        sound = (np.abs(rows) <= limits).all(axis=(1, 2))
        if not sound.all():
            starts, at, rows = starts[sound], at[sound], rows[sound]
        if len(starts) == 0:
            return
        # A channel's readings side by side.
        ordered = np.sort(rows.transpose(0, 2, 1).copy(), axis=2)
        distinct = 1 + (ordered[:, :, 1:] != ordered[:, :, :-1]).sum(axis=2)
        low, high = ordered[:, :, 0].copy(), ordered[:, :, -1].copy()
        piled = np.zeros(len(starts), dtype=np.bool_)
        if n > PINNED_SAMPLES:
            tail = PINNED_SAMPLES - 1
            ends = (low == ordered[:, :, tail]) | (high == ordered[:, :, -1 - tail])
            piled = ((distinct >= PINNED_DISTINCT) & ends).any(axis=1)
        centre = np.add.reduce(rows, axis=1) / n
        off, steps = rows - centre[:, None], rows[:, 1:] - rows[:, :-1]
        variance = np.add.reduce(off * off, axis=1) / (n - 1)
        white = np.add.reduce(steps * steps, axis=1) / (n - 1) / 2.0
        mean = np.mod(centre, 360.0) if circle else centre
        times = block.t_s[at]
        first_s, last_s = times[:, 0], times[:, -1]
        slot_s = slots[starts]
        gap_s = np.maximum(np.maximum(first_s - slot_s, slot_s + 1.0 - last_s), np.diff(times, axis=1).max(axis=1))
        warm: list[float | None] = [None] * len(starts)
        if block.temperature_degc is not None:
            # From nothing on, one after the other.
            warmth = np.concatenate((np.zeros((len(starts), 1)), block.temperature_degc[at]), axis=1)
            warm = (np.add.accumulate(warmth, axis=1)[:, -1] / n).tolist()
        missing = None if block.stamps is None else 0
        figures = zip(
            slot_s.tolist(), starts.tolist(), first_s.tolist(), last_s.tolist(), gap_s.tolist(), warm, piled.tolist(),
            strict=True,
        )  # fmt: skip
        for k, (slot, start, begins_s, ends_s, largest_gap_s, temperature_degc, is_piled) in enumerate(figures):
            if is_piled:
                continue
            self._found[start] = Batch(
                slot=int(slot),
                n=n,
                first_s=begins_s,
                last_s=ends_s,
                mean=mean[k],
                variance=variance[k],
                white=white[k],
                low=low[k],
                high=high[k],
                distinct=distinct[k],
                clipped=False,
                largest_gap_s=largest_gap_s,
                missing=missing,
                temperature_degc=temperature_degc,
            )


def _even(steps: Floats, begins: NDArray[np.int64], ends: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Of each run of steps of a counter, whether all are one step each; a run ends where the next begins."""
    edges = np.append(begins, ends[-1:])
    least, most = np.minimum.reduceat(steps, edges)[:-1], np.maximum.reduceat(steps, edges)[:-1]
    return np.asarray((least > 0.0) & (most < EVEN * least))
