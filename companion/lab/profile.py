"""Noise profile of an IMU from recordings: intervals at rest, a fit of each axis, one model for each triad.

If the recordings are too short for a figure, it is borrowed from another profile, within the bounds that they show.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from companion.config.sections import AllanModel, NoiseProfile
from companion.errors import CalibrationRefusedError
from companion.estimation.collector.measurement import Stretch
from companion.estimation.noise.allan import AxisFit, curve, fit_axis
from companion.estimation.seconds.batch import Batch, summary
from companion.estimation.stillness.gates import ImuGate
from companion.estimation.stillness.own_noise import OwnNoise
from companion.physics.frames import Floats
from companion.samples import TRIADS, rows_of

MIN_SECONDS: Final = 16  # Least seconds of a stretch: a shorter one shows no flicker or walk
LEAST_STILL_S: Final = 60
"""Least total time at rest for a noise profile, s: as long as a calibration measures."""
_MIN_GOOD: Final = 10
_NAMES: Final = ("N", "B", "K")


Rest = tuple[NDArray[np.int64], Floats]
"""Interval at rest: whole seconds (m,) accepted by the gate, ascending; their means (m, 6), rad/s, m/s^2, IMU axes."""


def seconds_of(t_s: Floats, readings: Floats) -> list[Batch]:
    """Average the readings (n, 6) at times `t_s` (n,) over every whole second, except the first and the last."""
    finite = np.isfinite(t_s) & np.isfinite(readings).all(axis=1)
    t_s, readings = t_s[finite], readings[finite]
    slot_of = np.floor(t_s).astype(np.int64)
    starts = np.flatnonzero(np.diff(slot_of, prepend=-1 if len(t_s) == 0 else slot_of[0] - 1)).tolist()
    return [
        summary(int(slot_of[start]), t_s[start:end], readings[start:end], temperature_degc=None)
        for start, end in itertools.pairwise(starts[1:])
    ]


def rests(t_s: Floats, readings: Floats, name: str, profile: NoiseProfile) -> tuple[list[Rest], int, str]:
    """Find the intervals of a recording in which the IMU was motionless, with the daemon's stillness gate.

    Times (n,) ascend; readings are (n, 6) in rad/s and m/s^2; rows that are not finite are left out. `profile` is the
    noise that the gate allows until it has learned the actual noise.

    Returns:
        The intervals, the number of whole seconds, and the commonest reason to reject a second; empty: none rejected.
    """
    batches = seconds_of(t_s, readings)
    own = OwnNoise(at_rest=True)
    for batch in batches:
        own.add(batch)
    gate = ImuGate(name, profile, own=own)
    stretch = Stretch(_MIN_GOOD, max(len(batches), 1))
    stretches: list[Rest] = []
    kept: list[Batch] = []
    obstacles: Counter[str] = Counter()
    words: dict[str, str] = {}
    before: int | None = None

    def end() -> None:
        if len(kept) >= MIN_SECONDS:
            stretches.append((np.array([each.slot for each in kept]), np.array([each.mean for each in kept])))
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
            gate.accept(batch)
            kept.append(batch)
        else:
            obstacles[verdict.what] += 1
            words.setdefault(verdict.what, verdict.words)
            if stretch.start is None:
                end()
    end()
    obstacle = words[obstacles.most_common(1)[0][0]] if obstacles else ""
    return stretches, len(batches), obstacle


def seconds_at_rest(stretches: Iterable[Rest]) -> int:
    return sum(len(slots) for slots, _ in stretches)


def fit_profile(
    name: str, stretches: Sequence[Rest], fallback: NoiseProfile
) -> tuple[NoiseProfile, list[AxisFit], list[str]]:
    """Estimate the noise of one IMU from all its intervals at rest.

    Returns:
        The profile; the fits of gyro x y z and accelerometer x y z, in rad/s or m/s^2; the figures borrowed from
        `fallback`, such as "gyro K".

    Raises:
        CalibrationRefusedError: too little time at rest, or an axis that never changes.
    """
    still_s = seconds_at_rest(stretches)
    if still_s < LEAST_STILL_S:
        raise CalibrationRefusedError(f"only {still_s} s at rest; a profile needs {LEAST_STILL_S} s, better an hour")
    found = curve(stretches)
    for column in np.flatnonzero((found.variance == 0.0).all(axis=0)).tolist():
        axis = f"{TRIADS[column // 3]} {'xyz'[column % 3]}"
        raise CalibrationRefusedError(f"{axis} never changes: its noise is below its last digit")
    axes = [fit_axis(found, column) for column in range(6)]
    models, kept = [], []
    for triad in TRIADS:
        model, unknown = _triad(axes[rows_of(triad)], fallback.of(triad))
        models.append(model)
        kept += [f"{triad} {_NAMES[which]}" for which in unknown]
    return NoiseProfile(name, models[0], models[1], warm_up=fallback.warm_up), axes, kept


def _triad(axes: Sequence[AxisFit], fallback: AllanModel) -> tuple[AllanModel, list[int]]:
    """Choose a noise model that is not too optimistic for any of three axes; list which of N, B, K no axis shows."""
    other = fallback.white, fallback.flicker, fallback.walk
    chosen, unknown = [0.0, 0.0, 0.0], []
    for which in range(3):
        shown = [axis.figures[which] for axis in axes if axis.known[which]]
        # Axes of one part are similar: a figure of one axis is a better guess for the others than another profile's.
        guess = max(shown) if shown else other[which]
        for axis in axes:
            figure = axis.figures[which]
            if not axis.known[which]:
                figure = min(max(figure, guess), axis.upper[which])
            chosen[which] = max(chosen[which], figure)
        if not shown:
            unknown.append(which)
    return AllanModel(*chosen), unknown
