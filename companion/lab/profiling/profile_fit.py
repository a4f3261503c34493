"""A noise profile out of an IMU's own recordings at rest: the stretches at rest, six fits, one choice for each triad.

The daemon takes samples one by one; here hours of them are there already. Seconds are summed up as there, and the
verdicts are those of the daemon's own gate.

What the recordings are too short to tell keeps the figure of another profile (the part's from the catalogue, or the
cautious one), as far as the recordings allow it. A drift (warm-up, temperature) is taken out before the fit and put
back as what it costs over the minutes that a calibration is for: as random walk it would be worth ten times more than
it is, or be hidden in it without a word.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.errors import CalibrationRefusedError
from companion.estimation.noise.allan import (
    FLOOR_OF_FLICKER,
    WARM_UP_K,
    AllanModel,
    NoiseProfile,
    floor_variance,
    slope_variance,
)
from companion.estimation.noise.allan_fit import AxisFit, curve, fit_axis, not_negative
from companion.estimation.seconds.batch import Batch, summary
from companion.estimation.stillness.gates import ImuGate
from companion.estimation.stillness.own_noise import learned_of
from companion.estimation.stillness.stretch import Stretch
from companion.physics.frames import Floats
from companion.samples import TRIADS, rows_of

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
    """What kept most of the others from counting, in the words of the first; empty where all counted."""

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

    Times (n,) ascend; readings are (n, 6), gyro in rad/s and accelerometer in m/s^2, of which rows that are not finite
    are left out; temperatures (n,) are NaN where unknown. `profile` is what the gate allows for before it has learned.
    """
    batches = seconds_of(t_s, readings, temperature_degc)
    own = learned_of(batches)
    gate, stretch = ImuGate(name, profile, own=own), Stretch(_MIN_GOOD, max(len(batches), 1))
    stretches: list[Rest] = []
    kept: list[Batch] = []
    obstacles: Counter[str] = Counter()
    words: dict[str, str] = {}
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
            gate.accept(batch)
            kept.append(batch)
        else:
            obstacles[verdict.what] += 1
            words.setdefault(verdict.what, verdict.words)
            if stretch.start is None:
                end()
    end()
    obstacle = words[obstacles.most_common(1)[0][0]] if obstacles else ""
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


LEAST_STILL_S: Final = 60
"""Less says nothing that a calibration does not measure itself."""
DRIFT_T: Final = 5.0
"""|t| of a slope against the noise found without it; random walk alone makes slopes of about one."""
DRIFT_LEAST_S: Final = 300
MEAN_S: Final = 60.0
HORIZON_S: Final = 180.0
"""The minutes for which a drift must be allowed for: a calibration's mean, and what it is used for."""
_AXES: Final = "xyz"
_NAMES: Final = ("N", "B", "K")


class AxisFinding(msgspec.Struct, frozen=True, kw_only=True):
    """One axis, in rad/s or m/s^2."""

    fit: AxisFit
    """Of the noise without the drift, where there is one."""
    drift_per_s: float = 0.0
    """Of the steepest stretch; zero where none is significant."""


class Finding(msgspec.Struct, frozen=True, kw_only=True):
    """What the recordings of one IMU tell."""

    profile: NoiseProfile
    axes: tuple[AxisFinding, ...]
    """Gyro x y z, accelerometer x y z."""
    kept: tuple[str, ...]
    """Which figures are another profile's, because the recordings tell nothing of them: "gyro K"."""
    still_s: int


def fit_profile(name: str, rests: Sequence[Rest], fallback: NoiseProfile) -> Finding:
    """The noise of one IMU from all its stretches at rest.

    Raises:
        CalibrationRefusedError: too little at rest, or an axis that never changes.
    """
    still_s = sum(len(rest.slots) for rest in rests)
    if still_s < LEAST_STILL_S:
        raise CalibrationRefusedError(f"only {still_s} s at rest; a profile needs {LEAST_STILL_S} s, better an hour")
    level = [_without_line(rest) for rest in rests]
    curves = [found for rest in rests if (found := curve(rest.slots, rest.means)) is not None]
    level_curves = [
        found
        for rest, (values, _) in zip(rests, level, strict=True)
        if (found := curve(rest.slots, values)) is not None
    ]
    axes: list[AxisFinding] = []
    for column in range(CHANNELS):
        if not any(each.variance[0, column] > 0.0 for each in curves):
            axis = f"{'gyro' if column < 3 else 'accel'} {_AXES[column % 3]}"
            raise CalibrationRefusedError(f"{axis} never changes: its noise is below its last digit")
        fit, drift = fit_axis(curves, column), 0.0
        without = fit_axis(level_curves, column)
        for rest, (_, slopes) in zip(rests, level, strict=True):
            if len(rest.slots) < DRIFT_LEAST_S:
                continue
            slope = float(slopes[column])
            if abs(slope) > DRIFT_T * _slope_sigma(rest, without.figures) and abs(slope) > abs(drift):
                drift = slope
        axes.append(AxisFinding(fit=without if drift else fit, drift_per_s=drift))
    models, kept = [], []
    for triad in TRIADS:
        part = rows_of(triad)
        model, unknown = _triad(axes[part], fallback.of(triad))
        models.append(within_horizon(model, [(rest.slots, rest.means[:, part]) for rest in rests]))
        kept += [f"{triad} {_NAMES[which]}" for which in unknown]
    return Finding(
        profile=NoiseProfile(name, models[0], models[1], fallback.warm_up),
        axes=tuple(axes),
        kept=tuple(kept),
        still_s=still_s,
    )


def _triad(axes: Sequence[AxisFinding], fallback: AllanModel) -> tuple[AllanModel, list[int]]:
    """One model that promises too much for none of the three axes, and which figures are the fallback's."""
    other = (fallback.white, fallback.flicker, fallback.walk)
    chosen, unknown = [0.0, 0.0, 0.0], []
    for which in range(3):
        told = [axis.fit.figures[which] for axis in axes if axis.fit.known[which]]
        # The axes of one part are alike: what one tells is a better guess for the others than another profile.
        guess = max(told) if told else other[which]
        for axis in axes:
            figure = axis.fit.figures[which]
            if not axis.fit.known[which]:
                figure = min(max(figure, guess), axis.fit.upper[which])
            chosen[which] = max(chosen[which], figure)
        if not told:
            unknown.append(which)
    white, flicker, walk = chosen
    drift = max(abs(axis.drift_per_s) for axis in axes)
    # A drift d moves the next H seconds by d (T + H) / 2 from the mean; K is raised until V(T, H) has that in it.
    walk = math.sqrt(walk**2 + 0.75 * drift**2 * (MEAN_S + HORIZON_S))
    flicker = max(flicker, *(_flicker_over(axis.fit) for axis in axes))
    return AllanModel(white, flicker, walk), unknown


def _flicker_over(fit: AxisFit) -> float:
    """B with which the Allan deviation lies nowhere above the model: noise of another kind counts as flicker."""
    white, flicker, walk = fit.figures
    if fit.excess is None:
        return flicker
    span, ratio = fit.excess
    model = white**2 / span + AllanModel(white, flicker, walk).floor ** 2 + walk**2 * span / 3.0
    return math.sqrt(flicker**2 + (ratio**2 - 1.0) * model / FLOOR_OF_FLICKER**2)


def _without_line(rest: Rest) -> tuple[Floats, Floats]:
    """Values without their straight line, and its slopes per second."""
    times = rest.slots - rest.slots.mean()
    slopes = (times[:, None] * rest.means).sum(axis=0) / max(float(np.square(times).sum()), 1.0)
    return rest.means - slopes * times[:, None], slopes


def _slope_sigma(rest: Rest, figures: tuple[float, float, float]) -> float:
    """Standard error of a least squares slope over the stretch under such noise."""
    white, flicker, walk = figures
    span_s = float(rest.slots[-1] - rest.slots[0] + 1)
    return math.sqrt(12.0 * white**2 / span_s**3 + float(slope_variance(flicker, walk, span_s)))


HORIZONS_S: Final = tuple(itertools.product((10, 30, 60), (60, 180)))
"""T and H."""
LEAST_WINDOWS: Final = 8.0
"""Side by side; fewer say nothing against a model."""
CAUTION_SIGMAS: Final = 1.0
"""By so much of its standard error more than was measured counts, and the largest of three axes."""


def within_horizon(model: AllanModel, stretches: Sequence[tuple[NDArray[np.int64], Floats]]) -> AllanModel:
    """The model with the flicker and walk that hold for means of 10 to 60 s and the 60 to 180 s after them.

    A random walk that is bounded, as the wander of most parts is after some minutes, looks like a walk at averages of
    a minute; of what it does in the next three minutes the walk says too much. So what is measured is the mean square
    of the difference of which `sigma_use` speaks; where it is less than the model's, flicker and walk are fitted to it.

    `stretches`: slots (m,) and means (m, 3) of seconds at rest.
    """
    rows, targets = [], []
    for mean_s, next_s in HORIZONS_S:
        white = model.white**2 * (1.0 / mean_s + 1.0 / next_s)
        target = float(floor_variance(model.flicker, model.walk, mean_s, next_s)) + white
        seen, windows = _seen(stretches, mean_s, next_s)
        if windows >= LEAST_WINDOWS:
            target = min(target, seen * (1.0 + CAUTION_SIGMAS * math.sqrt(2.0 / windows)))
        flicker, walk = float(floor_variance(1.0, 0.0, mean_s, next_s)), float(floor_variance(0.0, 1.0, mean_s, next_s))
        rows.append([flicker / target, walk / target])
        targets.append(max(target - white, 0.0) / target)
    by = np.array(rows)
    flicker2, walk2 = not_negative(by.T @ by, by.T @ np.array(targets)).tolist()
    return AllanModel(model.white, math.sqrt(flicker2), math.sqrt(walk2))


def _seen(stretches: Sequence[tuple[NDArray[np.int64], Floats]], mean_s: int, next_s: int) -> tuple[float, float]:
    """Mean square of what the next seconds differed by, of the worst axis; and for how many windows there was room."""
    total, many, windows = np.zeros(3), 0, 0.0
    length = mean_s + next_s
    for slots, means in stretches:
        if len(slots) < length:
            continue
        sums = np.concatenate([np.zeros((1, 3)), np.cumsum(means - means.mean(axis=0), axis=0)])
        past = (sums[mean_s : len(sums) - next_s] - sums[: len(sums) - length]) / mean_s
        coming = (sums[length:] - sums[mean_s : len(sums) - next_s]) / next_s
        whole = slots[length - 1 :] - slots[: len(slots) - length + 1] == length - 1
        total += np.square(coming - past)[whole].sum(axis=0)
        many += int(whole.sum())
        windows += float(whole.sum()) / length
    return (float(total.max()) / many if many else 0.0), windows


LEAST_S: Final = 900
"""Boards warm up within 20 min, most of it in the first ten."""
_BLOCK_S: Final = 60
_LEAST_IN_BLOCK: Final = 30
_LEAST_K: Final = 3.0
"""A thermometer that moves by less tells nothing of what a kelvin does."""


def learn_warm_up(recordings: Sequence[Sequence[Rest]]) -> tuple[float, float]:
    """What `WARM_UP_K` do to gyro and accelerometer: rad/s and m/s^2 of the axis that moves most.

    The range of the minutes' means of each recording (its stretches at rest, in the order of time); where its
    thermometer moved, in proportion to that, but not less than the range itself.

    Raises:
        CalibrationRefusedError: too little at rest.
    """
    found = np.zeros(2)
    for rests in recordings:
        minutes = np.array([row for rest in rests for row in _minutes(rest)])
        seconds = sum(len(rest.slots) for rest in rests)
        if seconds < LEAST_S or len(minutes) < 2:
            raise CalibrationRefusedError(
                f"--warm-up: {seconds} s at rest; to see a warm-up takes {LEAST_S} s from the switch-on"
            )
        moved = np.ptp(minutes, axis=0)
        kelvin = float(moved[6])
        share = max(WARM_UP_K / kelvin, 1.0) if kelvin >= _LEAST_K else 1.0
        found = np.maximum(found, np.array([moved[:3].max(), moved[3:6].max()]) * share)
    return float(found[0]), float(found[1])


def _minutes(rest: Rest) -> list[Floats]:
    """Means of six axes and the thermometer (NaN: none) over each minute that is mostly there."""
    block = (rest.slots - rest.slots[0]) // _BLOCK_S
    table = np.column_stack([rest.means, rest.temperature_degc])
    return [table[block == k].mean(axis=0) for k in np.unique(block) if (block == k).sum() >= _LEAST_IN_BLOCK]
