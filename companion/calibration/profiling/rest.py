"""A whole recording of an IMU at once: seconds from samples, and the stretches in which it lay still.

The daemon takes samples one by one (`batches`); here hours of them are there already, so every second is worked out
by the same formulas for the whole column. The verdicts are those of the daemon's own gate.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.calibration.noise.allan import NoiseProfile
from companion.calibration.seconds.batches import Batch
from companion.calibration.stillness.gates import ImuGate
from companion.calibration.stillness.stretch import Stretch
from companion.physics.frames import Floats

CHANNELS: Final = 6
MIN_SECONDS: Final = 16
"""A stretch that is shorter tells nothing of what averaging leaves."""
_MIN_GOOD: Final = 10
_FEW: Final = 3
"""Distinct readings in a second are counted as far as this: nobody here asks for more."""


class Rest(msgspec.Struct, frozen=True):
    """One stretch at rest; a second that the gate rejected is a hole in `slots`."""

    slots: NDArray[np.int64]
    """(m,) ascending: seconds of the recording's clock."""
    means: Floats
    """(m, 6): gyro in rad/s, accelerometer in m/s^2, in the IMU's own axes."""
    temperature_degc: Floats
    """(m,); NaN where it is not known."""
    batches: tuple[Batch, ...]
    """The same seconds as the estimator takes them."""


class Rests(msgspec.Struct, frozen=True):
    """What of one recording was at rest."""

    stretches: tuple[Rest, ...]
    seconds: int
    """Whole seconds in the recording."""
    obstacle: str
    """What kept most of the others from counting; empty where all counted."""

    @property
    def still_s(self) -> int:
        """Seconds in the stretches."""
        return sum(len(rest.slots) for rest in self.stretches)


def joined(parts: Sequence[Rests]) -> Rests:
    """Those of one recording that was cut where its readings became others."""
    stretches = tuple(rest for part in parts for rest in part.stretches)
    obstacle = next((part.obstacle for part in parts if part.obstacle), "")
    return Rests(stretches, sum(part.seconds for part in parts), obstacle)


def rests(t_s: Floats, readings: Floats, temperature_degc: Floats | None, name: str, profile: NoiseProfile) -> Rests:
    """The stretches of a recording in which the IMU lay still, by the gate that the daemon uses.

    Args:
        t_s: (n,) times, ascending.
        readings: (n, 6) gyro in rad/s and accelerometer in m/s^2; a row that is not finite is left out.
        temperature_degc: (n,), NaN where unknown; None: not known at all.
        name: of the IMU, in words.
        profile: noise that the gate allows for before it has learned.
    """
    batches = seconds_of(t_s, readings, temperature_degc)
    gate, stretch = ImuGate(name, profile), Stretch(_MIN_GOOD, max(len(batches), 1))
    stretches: list[Rest] = []
    kept: list[Batch] = []
    obstacles: Counter[str] = Counter()
    before: int | None = None

    def end() -> None:
        if len(kept) >= MIN_SECONDS:
            stretches.append(_rest(kept))
        kept.clear()
        gate.new_stretch()

    for batch in batches:
        for slot in range(batch.slot if before is None else max(before + 1, batch.slot - _MIN_GOOD), batch.slot):
            if not stretch.add(slot, good=False):
                end()
        before = batch.slot
        verdict = gate.judge(batch)
        if not stretch.add(batch.slot, good=verdict.still):
            end()
        if verdict.still:
            gate.accept(batch, settled=stretch.begun)
            kept.append(batch)
        else:
            obstacles[" ".join(verdict.words.split()[:3])] += 1
            if stretch.start is None:
                end()
    end()
    obstacle = obstacles.most_common(1)[0][0] if obstacles else ""
    return Rests(tuple(stretches), len(batches), obstacle)


def _rest(batches: list[Batch]) -> Rest:
    unknown = [np.nan if batch.temperature_degc is None else batch.temperature_degc for batch in batches]
    return Rest(
        np.array([batch.slot for batch in batches], dtype=np.int64),
        np.array([batch.mean for batch in batches]),
        np.array(unknown, dtype=np.float64),
        tuple(batches),
    )


def seconds_of(t_s: Floats, readings: Floats, temperature_degc: Floats | None = None) -> list[Batch]:
    """Every whole second of a recording; the first and the last are cut and left out. Arguments as for `rests`.

    `distinct` counts up to three; `clipped` and lost samples are not looked for.
    """
    finite = np.isfinite(t_s)
    for channel in range(CHANNELS):
        finite &= np.isfinite(readings[:, channel])
    if not finite.all():
        t_s, readings = t_s[finite], readings[finite]
        temperature_degc = None if temperature_degc is None else temperature_degc[finite]
    if len(t_s) == 0:
        return []
    slot_of = np.floor(t_s).astype(np.int64)
    starts = np.flatnonzero(np.diff(slot_of, prepend=slot_of[0] - 1))
    slots, counts = slot_of[starts], np.diff(starts, append=len(t_s))
    index = np.repeat(np.arange(len(starts)), counts)
    shape = (len(starts), CHANNELS)
    mean, variance, white, low, high = (np.empty(shape) for _ in range(5))
    distinct = np.empty(shape, dtype=np.int64)
    within = np.diff(slot_of) == 0
    for channel in range(CHANNELS):
        values = np.ascontiguousarray(readings[:, channel])
        low[:, channel] = least = np.minimum.reduceat(values, starts)
        high[:, channel] = most = np.maximum.reduceat(values, starts)
        between = (values > least[index]) & (values < most[index])
        distinct[:, channel] = 1 + (most > least) + np.logical_or.reduceat(between, starts)
        # About the middle of the second, so that little is lost where the variance is small against the mean.
        centred = values - values[starts][index]
        offset = np.add.reduceat(centred, starts) / counts
        mean[:, channel] = values[starts] + offset
        squares = np.add.reduceat(np.square(centred), starts) - counts * np.square(offset)
        variance[:, channel] = np.maximum(squares, 0.0) / np.maximum(counts - 1, 1)
        steps = np.zeros(len(values))
        steps[1:][within] = np.square(np.diff(values)[within])
        white[:, channel] = np.add.reduceat(steps, starts) / (2.0 * np.maximum(counts - 1, 1))
    gaps = np.zeros(len(t_s))
    gaps[1:] = np.where(within, np.diff(t_s), 0.0)
    last = starts + counts - 1
    gap = np.maximum.reduceat(gaps, starts)
    gap = np.maximum(gap, np.maximum(t_s[starts] - slots, slots + 1.0 - t_s[last]))
    temperature = _temperatures(temperature_degc, starts)
    return [
        Batch(
            slot=int(slots[k]),
            n=int(counts[k]),
            first_s=float(t_s[starts[k]]),
            last_s=float(t_s[last[k]]),
            mean=mean[k],
            variance=variance[k],
            white=white[k],
            low=low[k],
            high=high[k],
            distinct=distinct[k],
            clipped=False,
            largest_gap_s=float(gap[k]),
            missing=None,
            temperature_degc=temperature[k],
        )
        for k in range(1, len(starts) - 1)
    ]


def _temperatures(temperature_degc: Floats | None, starts: NDArray[np.int64]) -> list[float | None]:
    if temperature_degc is None:
        return [None] * len(starts)
    known = np.isfinite(temperature_degc)
    total = np.add.reduceat(np.where(known, temperature_degc, 0.0), starts)
    count = np.add.reduceat(known.astype(np.float64), starts)
    return [float(sum_ / number) if number else None for sum_, number in zip(total, count, strict=True)]
