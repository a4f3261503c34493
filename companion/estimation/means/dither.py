"""Known steps of the offsets below the last digit of an integer stream, so that its mean can be told after all.

Where the noise does not spread a truncated reading over three integers, the autopilot's own offset parameters can:
ten offsets, a tenth of a step apart, let every reading cross the edges of its integers at known places. The mean of
(integer + half a step away from zero - shift) over all ten is the mean of the sensor; the quantisation leaves at most
the bound of a step ten times finer (autopilots 9.3.1: 1.6 deg/h and 6 ug where the plain mean was 94 deg/h off).

Pure. Shifts are those of the output, in the vehicle's axes; `companion.daemon.offsets.dither` makes parameters of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np

from companion.config.sections import NoiseProfile
from companion.errors import CalibrationRefusedError
from companion.estimation.noise.allan import floor_variance
from companion.estimation.seconds.batch import Batch
from companion.physics.frames import Floats

STEPS: Final = 10
"""Offsets in one step of the stream."""

SECONDS: Final = 6
"""Whole seconds that are averaged at each of them: together a minute."""

BASE_LSB: Final = 4.0
"""Away from zero, where a reading is near it: zero is two steps wide, and the reading is known to about one."""

FAR_LSB: Final = 20.0
"""To and fro between neighbouring steps where a small change of an offset is ignored: PX4 wants the vector to change
by 0.01 rad/s and 0.01 m/s^2, and each of its three writes is such a change (autopilots 4.2, 9.3.2)."""

_NEAR_LSB: Final = 8.0
_MOVED_LSB: Final = 1.0
"""Between two of the ten, which quantisation can set apart by one step at most."""
_MOVED_SIGMAS: Final = 5.0


class Step(msgspec.Struct, frozen=True):
    """What was read at one shift."""

    shift_lsb: Floats
    """(6,) of the output, gyro then accelerometer, by the offsets read back."""
    batches: Sequence[Batch]
    """Its good seconds, at least two; of the stream's six channels."""


class Dithered(msgspec.Struct, frozen=True):
    """Means of one stream without the shifts; (6,), SI units."""

    mean: Floats
    sigma_stat: Floats
    sigma_use: Floats


def shifts_lsb(reading_lsb: Floats, *, alternate: bool) -> list[Floats]:
    """By how much the output is to be shifted at each step, (6,) each, LSB, of mean readings true to about one step.

    `alternate`: neighbouring steps must lie far apart.
    """
    side = np.where(reading_lsb < 0.0, -1.0, 1.0)
    fractions = [step / STEPS for step in range(STEPS)]
    if alternate:
        # To and fro must not lead to zero either.
        far = np.where(np.abs(np.abs(reading_lsb) - FAR_LSB) < _NEAR_LSB, FAR_LSB + 2.0 * _NEAR_LSB, FAR_LSB)
        return [(far if step % 2 == 0 else -far) + part for step, part in enumerate(fractions)]
    base = np.where(np.abs(reading_lsb) < _NEAR_LSB, BASE_LSB * side, 0.0)
    return [base + part for part in fractions]


def why_void(steps: Sequence[Step], latest: Step, steps_lsb: Floats) -> str | None:
    """Why the latest step says nothing: the aircraft moved, or the shift was not taken; None when it is sound.

    `steps` are the sound ones before it; `steps_lsb` (6,) of the stream, SI units.
    """
    if len(latest.batches) < 2:
        return "too few readings"
    corrected, scatter = _corrected(latest, steps_lsb)
    for batch in latest.batches:
        if _has_zero(batch):
            return "a reading too near to zero"
    if not steps:
        return None
    before = np.median([_corrected(step, steps_lsb)[0] for step in steps], axis=0)
    allowed = _MOVED_LSB + _MOVED_SIGMAS * np.sqrt(scatter)
    off = np.abs(corrected - before) - allowed
    worst = int(off.argmax())
    if off[worst] <= 0.0:
        return None
    part = "gyro" if worst < 3 else "accel"
    return f"{part} {'xyz'[worst % 3]} moved by {abs(float((corrected - before)[worst])):.1f} steps of its reading"


def combine(steps: Sequence[Step], steps_lsb: Floats, profile: NoiseProfile, horizon_s: float) -> Dithered:
    """The means over all steps, with what averaging left and what the next minutes, H of V(T, H), can expect.

    Raises:
        CalibrationRefusedError: a step is missing.
    """
    if len(steps) != STEPS:
        raise CalibrationRefusedError(f"dithering gave {len(steps)} of {STEPS} steps")
    means = np.array([_corrected(step, steps_lsb)[0] for step in steps])
    white = np.mean([_corrected(step, steps_lsb)[1] for step in steps], axis=0) / len(steps)
    mean = means.mean(axis=0)
    inside = np.mean([batch.variance for step in steps for batch in step.batches], axis=0)
    finer = 1.0 / STEPS
    # Of a subtractively dithered reading: that of the noise plus a twelfth of a step squared; ten shifts instead of
    # all there are may add two hundredths of that.
    noise = np.maximum(inside / np.square(steps_lsb) + means.var(axis=0) - (1.0 + 2.0 * finer**2) / 12.0, 0.0)
    hidden = finer / math.pi * np.exp(-2.0 * math.pi**2 * noise / finer**2)
    stat = (white + np.square(hidden)) * np.square(steps_lsb)
    seconds = float(sum(len(step.batches) for step in steps))
    triads = (profile.gyro, profile.accel)
    least = np.repeat([model.white**2 / seconds for model in triads], 3)
    floor = np.repeat([float(floor_variance(m.flicker, m.walk, seconds, horizon_s)) for m in triads], 3)
    return Dithered(
        mean=mean * steps_lsb,
        sigma_stat=np.sqrt(stat),
        sigma_use=np.sqrt(np.maximum(stat, least) + floor),
    )


def _corrected(step: Step, steps_lsb: Floats) -> tuple[Floats, Floats]:
    """Mean of one step without truncation's half step and without the shift, and that mean's variance; LSB."""
    integers = np.array([batch.mean for batch in step.batches]) / steps_lsb
    values = integers + 0.5 * np.sign(integers) - step.shift_lsb
    return values.mean(axis=0), values.var(axis=0, ddof=1) / len(values)


def _has_zero(batch: Batch) -> bool:
    counts = batch.counts
    if counts is None:
        return True
    integers = counts.lowest + np.arange(len(counts.table), dtype=np.int64)[:, None]
    return bool((counts.table[integers == 0] > 0).any())
