"""A noise profile from recordings of an IMU at rest: still stretches, a fit of each axis, one model for each triad.

A figure that the recordings are too short for is borrowed from another profile, as far as the recordings allow it. A
drift (warm-up, temperature) is removed before the fit and added to K as its cost over the minutes that a calibration is
for: counted as random walk it would cost ten times more.
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

MIN_SECONDS: Final = 16
"""Least seconds of a stretch: a shorter one shows nothing of what averaging leaves."""
LEAST_STILL_S: Final = 60
"""Least seconds at rest: a calibration measures as much itself."""
DRIFT_T: Final = 5.0
"""Least |t| of a slope that counts as a drift; random walk alone makes slopes of about one."""
DRIFT_LEAST_S: Final = 300
MEAN_S: Final = 60.0
HORIZON_S: Final = 180.0
"""Window and use of a calibration, for which K must contain a drift."""
HORIZONS_S: Final = tuple(itertools.product((10, 30, 60), (60, 180)))
"""Pairs of window and use for which flicker and walk must hold."""
LEAST_WINDOWS: Final = 8.0
"""Least windows side by side that count against a model."""
WARM_UP_LEAST_S: Final = 900
"""Least seconds of a recorded warm-up: boards warm up within 20 min, most of it in the first ten."""
_MIN_GOOD: Final = 10
_LEAST_IN_MINUTE: Final = 30
_LEAST_K: Final = 3.0
"""Least change of a thermometer that shows what a kelvin does."""
_AXES: Final = tuple(f"{triad} {axis}" for triad in TRIADS for axis in "xyz")
_NAMES: Final = ("N", "B", "K")


class Rest(msgspec.Struct, frozen=True):
    """One stretch at rest; a second that the gate rejected is missing in `slots`."""

    slots: NDArray[np.int64]
    """(m,) ascending: seconds of the recording's clock."""
    means: Floats
    """(m, 6): gyro in rad/s, accelerometer in m/s^2, in the IMU's own axes."""
    temperature_degc: Floats
    """(m,); NaN: not known."""


class Rests(msgspec.Struct, frozen=True):
    """Stretches at rest in one recording."""

    stretches: tuple[Rest, ...]
    seconds: int
    """Whole seconds in the recording."""
    obstacle: str
    """Most frequent reason of the rejected seconds, in the words of the first; empty: none was rejected."""

    @property
    def still_s(self) -> int:
        """Seconds in the stretches."""
        return sum(len(rest.slots) for rest in self.stretches)


class AxisFinding(msgspec.Struct, frozen=True, kw_only=True):
    """One axis, in rad/s or m/s^2."""

    fit: AxisFit
    """Noise without the drift, where there is one."""
    drift_per_s: float = 0.0
    """Slope of the steepest stretch; zero: none is significant."""


class Finding(msgspec.Struct, frozen=True, kw_only=True):
    """Noise of one IMU by its recordings."""

    profile: NoiseProfile
    axes: tuple[AxisFinding, ...]
    """Gyro x y z, accelerometer x y z."""
    kept: tuple[str, ...]
    """Figures borrowed from another profile, because the recordings do not show them: "gyro K"."""
    still_s: int


def seconds_of(t_s: Floats, readings: Floats, temperature_degc: Floats | None = None) -> list[Batch]:
    """Sum up every whole second of a recording, without the first and the last; arguments as for `rests`."""
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


def rests(t_s: Floats, readings: Floats, temperature_degc: Floats | None, name: str, profile: NoiseProfile) -> Rests:
    """Find the stretches of a recording in which the IMU lay still, by the daemon's gate.

    Times (n,) ascend; readings are (n, 6), gyro in rad/s and accelerometer in m/s^2; rows that are not finite are left
    out; temperatures (n,) are NaN where unknown. `profile` is the noise that the gate allows before it has learned.
    """
    batches = seconds_of(t_s, readings, temperature_degc)
    gate = ImuGate(name, profile, own=learned_of(batches))
    stretch = Stretch(_MIN_GOOD, max(len(batches), 1))
    stretches: list[Rest] = []
    kept: list[Batch] = []
    obstacles: Counter[str] = Counter()
    words: dict[str, str] = {}
    before: int | None = None

    def end() -> None:
        if len(kept) >= MIN_SECONDS:
            degc = [np.nan if batch.temperature_degc is None else batch.temperature_degc for batch in kept]
            slots, means = np.array([batch.slot for batch in kept]), np.array([batch.mean for batch in kept])
            stretches.append(Rest(slots, means, np.array(degc, dtype=np.float64)))
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


def fit_profile(name: str, rests: Sequence[Rest], fallback: NoiseProfile) -> Finding:
    """Estimate the noise of one IMU from all its stretches at rest.

    Raises:
        CalibrationRefusedError: too little at rest, or an axis that never changes.
    """
    still_s = sum(len(rest.slots) for rest in rests)
    if still_s < LEAST_STILL_S:
        raise CalibrationRefusedError(f"only {still_s} s at rest; a profile needs {LEAST_STILL_S} s, better an hour")
    level = [_without_line(rest) for rest in rests]
    curves = [found for rest in rests if (found := curve(rest.slots, rest.means)) is not None]
    flat = [curve(rest.slots, values) for rest, (values, _) in zip(rests, level, strict=True)]
    level_curves = [found for found in flat if found is not None]
    axes: list[AxisFinding] = []
    for column, axis in enumerate(_AXES):
        if not any(each.variance[0, column] > 0.0 for each in curves):
            raise CalibrationRefusedError(f"{axis} never changes: its noise is below its last digit")
        without, drift = fit_axis(level_curves, column), 0.0
        white, flicker, walk = without.figures
        for rest, (_, slopes) in zip(rests, level, strict=True):
            slope, span_s = float(slopes[column]), float(rest.slots[-1] - rest.slots[0] + 1)
            sigma = math.sqrt(12.0 * white**2 / span_s**3 + float(slope_variance(flicker, walk, span_s)))
            if len(rest.slots) >= DRIFT_LEAST_S and abs(slope) > max(DRIFT_T * sigma, abs(drift)):
                drift = slope
        axes.append(AxisFinding(fit=without if drift else fit_axis(curves, column), drift_per_s=drift))
    models, kept = [], []
    for triad in TRIADS:
        part = rows_of(triad)
        model, unknown = _triad(axes[part], fallback.of(triad))
        models.append(within_horizon(model, [(rest.slots, rest.means[:, part]) for rest in rests]))
        kept += [f"{triad} {_NAMES[which]}" for which in unknown]
    profile = NoiseProfile(name, models[0], models[1], fallback.warm_up)
    return Finding(profile=profile, axes=tuple(axes), kept=tuple(kept), still_s=still_s)


def _triad(axes: Sequence[AxisFinding], fallback: AllanModel) -> tuple[AllanModel, list[int]]:
    """Choose one model that promises too much for none of three axes; return it and the figures that no axis shows."""
    other = (fallback.white, fallback.flicker, fallback.walk)
    chosen, unknown = [0.0, 0.0, 0.0], []
    for which in range(3):
        shown = [axis.fit.figures[which] for axis in axes if axis.fit.known[which]]
        # The axes of one part are alike: the figure of one is a better guess for the others than another profile.
        guess = max(shown) if shown else other[which]
        for axis in axes:
            figure = axis.fit.figures[which]
            if not axis.fit.known[which]:
                figure = min(max(figure, guess), axis.fit.upper[which])
            chosen[which] = max(chosen[which], figure)
        if not shown:
            unknown.append(which)
    white, flicker, walk = chosen
    drift = max(abs(axis.drift_per_s) for axis in axes)
    # A drift d moves the next H seconds by d (T + H) / 2 from the mean; raise K until V(T, H) contains that.
    walk = math.sqrt(walk**2 + 0.75 * drift**2 * (MEAN_S + HORIZON_S))
    flicker = max(flicker, *(_flicker_over(axis.fit) for axis in axes))
    return AllanModel(white, flicker, walk), unknown


def _flicker_over(fit: AxisFit) -> float:
    """Raise B until the Allan deviation lies nowhere above the model: noise of another kind counts as flicker."""
    white, flicker, walk = fit.figures
    if fit.excess is None:
        return flicker
    span, ratio = fit.excess
    model = white**2 / span + AllanModel(white, flicker, walk).floor ** 2 + walk**2 * span / 3.0
    return math.sqrt(flicker**2 + (ratio**2 - 1.0) * model / FLOOR_OF_FLICKER**2)


def _without_line(rest: Rest) -> tuple[Floats, Floats]:
    """Return the values without their straight line, and its slopes per second."""
    times = rest.slots - rest.slots.mean()
    slopes = (times[:, None] * rest.means).sum(axis=0) / max(float(np.square(times).sum()), 1.0)
    return rest.means - slopes * times[:, None], slopes


def within_horizon(model: AllanModel, stretches: Sequence[tuple[NDArray[np.int64], Floats]]) -> AllanModel:
    """Fit flicker and walk to means of 10 to 60 s and the 60 to 180 s after them, where the model exceeds these.

    A bounded random walk, as the wander of most parts is after some minutes, looks like a walk at averages of a minute
    and predicts too much for the next three. So the mean square of the difference that `sigma_use` speaks of is
    measured, and one standard error more than that, of the worst axis, bounds the model.

    `stretches`: slots (m,) and means (m, 3) of seconds at rest.
    """
    rows, targets = [], []
    for mean_s, next_s in HORIZONS_S:
        white = model.white**2 * (1.0 / mean_s + 1.0 / next_s)
        target = float(floor_variance(model.flicker, model.walk, mean_s, next_s)) + white
        measured, windows = _measured_change(stretches, mean_s, next_s)
        if windows >= LEAST_WINDOWS:
            target = min(target, measured * (1.0 + math.sqrt(2.0 / windows)))
        flicker, walk = float(floor_variance(1.0, 0.0, mean_s, next_s)), float(floor_variance(0.0, 1.0, mean_s, next_s))
        rows.append([flicker / target, walk / target])
        targets.append(max(target - white, 0.0) / target)
    by = np.array(rows)
    flicker2, walk2 = not_negative(by.T @ by, by.T @ np.array(targets)).tolist()
    return AllanModel(model.white, math.sqrt(flicker2), math.sqrt(walk2))


def _measured_change(
    stretches: Sequence[tuple[NDArray[np.int64], Floats]], mean_s: int, next_s: int
) -> tuple[float, float]:
    """Return the mean square change from a mean to the next seconds, of the worst axis, and the number of windows."""
    total, many = np.zeros(3), 0
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
    return (float(total.max()) / many if many else 0.0), many / length


def learn_warm_up(recordings: Sequence[Sequence[Rest]]) -> tuple[float, float]:
    """Estimate what `WARM_UP_K` do to gyro and accelerometer: rad/s and m/s^2 of the axis that moves most.

    The range of the minutes' means of each recording (its stretches at rest, in the order of time); where its
    thermometer moved, in proportion to that, but not less than the range itself.

    Raises:
        CalibrationRefusedError: too little at rest.
    """
    found = np.zeros(2)
    for rests in recordings:
        rows = []
        for rest in rests:
            minute, table = (rest.slots - rest.slots[0]) // 60, np.column_stack([rest.means, rest.temperature_degc])
            many = [minute == k for k in np.unique(minute) if (minute == k).sum() >= _LEAST_IN_MINUTE]
            rows += [table[these].mean(axis=0) for these in many]
        minutes = np.array(rows)
        seconds = sum(len(rest.slots) for rest in rests)
        if seconds < WARM_UP_LEAST_S or len(minutes) < 2:
            raise CalibrationRefusedError(
                f"--warm-up: {seconds} s at rest; to see a warm-up takes {WARM_UP_LEAST_S} s from the switch-on"
            )
        moved = np.ptp(minutes, axis=0)
        kelvin = float(moved[6])
        share = max(WARM_UP_K / kelvin, 1.0) if kelvin >= _LEAST_K else 1.0
        found = np.maximum(found, np.array([moved[:3].max(), moved[3:6].max()]) * share)
    return float(found[0]), float(found[1])
