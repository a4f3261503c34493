"""A whole recording of an IMU at once: seconds from samples, and the stretches in which it lay still.

The daemon takes samples one by one (`batches`); here hours of them are there already. Seconds are summed up as there,
and the verdicts are those of the daemon's own gate.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.calibration.noise.allan import NoiseProfile
from companion.calibration.seconds.batch import Batch, summary
from companion.calibration.stillness.gates import ImuGate
from companion.calibration.stillness.stretch import Stretch
from companion.physics.frames import Floats

CHANNELS: Final = 6
MIN_SECONDS: Final = 16
"""A stretch that is shorter tells nothing of what averaging leaves."""
_MIN_GOOD: Final = 10


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
            obstacles[verdict.what] += 1
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
    """Every whole second of a recording; the first and the last are cut and left out. Arguments as for `rests`."""
    if temperature_degc is None:
        temperature_degc = np.full(len(t_s), np.nan)
    finite = np.isfinite(t_s) & np.isfinite(readings).all(axis=1)
    t_s, readings, temperature_degc = t_s[finite], readings[finite], temperature_degc[finite]
    slot_of = np.floor(t_s).astype(np.int64)
    starts = np.flatnonzero(np.diff(slot_of, prepend=-1 if len(t_s) == 0 else slot_of[0] - 1)).tolist()
    batches = []
    for start, end in itertools.pairwise(starts[1:]):
        known = temperature_degc[start:end][np.isfinite(temperature_degc[start:end])]
        degc = float(known.mean()) if len(known) else None
        batches.append(summary(int(slot_of[start]), t_s[start:end], readings[start:end], temperature_degc=degc))
    return batches
