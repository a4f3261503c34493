"""Judgement of one sensor: from its calibrations, in order, to findings. It needs no database and no clock."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.fleet.models import Scatter, middle_of, scatter_of_part
from companion.fleet.sequential import Alarm, watch
from companion.physics.frames import Floats
from companion.physics.units import DEG, DEG_H, MG, G

LEARNS: Final = 16
"""Power-ups at the beginning that define what is usual, where no model does."""
_WITH_MODEL: Final = 10
"""Power-ups at the beginning that define the level, where a model defines the scatter."""
_OF_MODEL, _OF_OWN = 1.5, 3.0
"""Largest accepted scatter of a part, as a multiple of its model's or of that of its first power-ups."""
WANDER: Final = (0.03, 0.3)
"""Least and largest wander of a bias from one power-up to the next, in scatters."""
LEAST_SIZE: Final = 1.8
"""Least size of a finding, in scatters."""
LEAST_TIMES: Final = 1.4
"""Least factor by which a noise has grown in a finding."""
_FEW_TELL: Final = 1.2
"""Factor on the scatter of a part's first power-ups, which may be too small."""
_LEAST_NOISE: Final = 0.08
"""Least scatter of the logarithm of a noise that is measured over some ten seconds."""
_BOUND_DEG: Final = 5.0
"""Least bound of the heading's error in a finding."""
_DRIFT_AFTER: Final = 8
"""Power-ups until an alarm; a level that takes longer has drifted."""
SHOWN: Final = 30
"""Power-ups for which a level that has moved is shown."""
_AXES: Final = [f"{triad} {axis}" for triad in ("gyro", "accel") for axis in "xyz"]


class History(NamedTuple):
    """One IMU over its power-ups, in their order; NaN: not known."""

    at: Sequence[datetime.datetime]
    temperature_degc: Floats
    """(n,)"""
    biases: Floats
    """(n, 6) gyro rad/s, accelerometer m/s^2, by the readings alone."""
    sigma_use: Floats
    """(n, 6) sigma of the biases, same units."""
    white: Floats
    """(n, 6) white noise, same units times sqrt(s)."""
    new_zero: NDArray[np.bool_]
    """(n,) whether the gradienter's zero differs from the power-up before."""


class Columns(NamedTuple):
    """Arguments of `watch`, and the unit of each column."""

    values: Floats
    variance: Floats
    temperature_degc: Floats
    wander: Floats
    relevel: NDArray[np.bool_]
    first: NDArray[np.int_]
    most_own: Floats
    least: Floats
    unit: Floats


class Finding(NamedTuple):
    """Complaint about a sensor."""

    kind: str
    """bias, drift, scatter, noise, zero, compass."""
    axis: int
    """0 to 5; -1: none."""
    since: int
    """Index of the power-up."""
    size: float
    """Severity, as a multiple of what is usual."""
    words: str
    moved: float = 0.0
    """Move of a level, rad/s or m/s^2."""


def columns_of(history: History, model: Scatter | None) -> Columns:
    """Make the columns of the biases, (n, 6), and of their noise, (n, 6); `model`: scatter of the other parts."""
    own = scatter_of_part(history.biases[:LEARNS], history.temperature_degc[:LEARNS])
    turn_on, wander = _FEW_TELL * own.turn_on, np.full(6, WANDER[0])
    first, most_own = np.full(12, LEARNS), np.full(12, _OF_OWN)
    if model is not None:
        known = np.isfinite(model.turn_on)
        turn_on = np.where(known, model.turn_on, turn_on)
        wander = np.clip(np.nan_to_num(model.wander / turn_on), *WANDER)
        first[:6][known], most_own[:6][known] = _WITH_MODEL, _OF_MODEL
    unit = np.where(turn_on > 0.0, turn_on, np.nan)
    use = np.square(history.sigma_use)
    usual = np.array([middle_of(column) for column in use.T])
    # The usual sigma is part of the scatter already.
    variance = np.nan_to_num(np.maximum(use - usual, 0.0) / unit**2)
    noise = np.log(np.where(history.white > 0.0, history.white, np.nan))
    # At the end of a warm-up the sigma is that of a fitted line, which does not tell the noise.
    share = np.sqrt(use) / history.white
    noise = np.where(share > 3.0 * np.array([middle_of(column) for column in share.T]), np.nan, noise)
    of_noise = scatter_of_part(noise[:LEARNS], history.temperature_degc[:LEARNS]).turn_on
    of_noise = np.fmax(of_noise, np.where(np.isfinite(of_noise), _LEAST_NOISE, np.nan))
    values = np.hstack([history.biases / unit, noise / of_noise])
    n = len(values)
    relevel = np.zeros((n, 12), dtype=bool)
    relevel[:, 3:5] = history.new_zero[:, None]
    return Columns(
        values=values,
        variance=np.hstack([variance, np.zeros((n, 6))]),
        temperature_degc=np.repeat(history.temperature_degc[:, None], 12, axis=1),
        wander=np.concatenate([wander, np.full(6, WANDER[0])]),
        relevel=relevel,
        first=first,
        most_own=most_own,
        least=np.concatenate([np.full(6, LEAST_SIZE), np.log(LEAST_TIMES) / of_noise]),
        unit=np.concatenate([unit, of_noise]),
    )


def counts(alarm: Alarm) -> bool:
    """Tell whether an alarm of these columns is a complaint: a noise that falls or scatters is none."""
    return alarm.column < 6 or (alarm.kind == "level" and alarm.size > 0.0)


def judge(history: History, model: Scatter | None) -> list[Finding]:
    """List the findings against one IMU as of its latest power-up, the worst first."""
    columns = columns_of(history, model)
    n = len(history.biases)
    found: dict[tuple[int, str], Finding] = {}
    for alarm in filter(counts, watch(*columns[:-1])):
        axis, unit = alarm.column % 6, columns.unit[alarm.column]
        if alarm.column >= 6:
            _noise(found, alarm, columns, n)
        elif alarm.kind == "scatter" and alarm.until == n:
            its = "times its model's" if model is not None else "times what it was"
            words = f"{_AXES[axis]} turn-on scatter {alarm.size:.1f} {its}"
            found[axis, "scatter"] = Finding("scatter", axis, alarm.since, alarm.size, words)
        elif alarm.kind == "level" and n - alarm.at <= SHOWN:
            before = found.get((axis, "level"))
            size = alarm.size + (before.size if before else 0.0)
            since = before.since if before else alarm.since
            kind = "drift" if before or alarm.at - alarm.since >= _DRIFT_AFTER else "bias"
            moved = abs(size) * unit / (DEG_H if axis < 3 else MG)
            its = "its model's turn-on scatter" if model is not None else "its turn-on scatter"
            words = (
                f"{_AXES[axis]} bias has {'drifted' if kind == 'drift' else 'moved'} by {moved:.3g}"
                f" {'deg/h' if axis < 3 else 'mg'}, {abs(size):.1f} times {its}"
            )
            found[axis, "level"] = Finding(kind, axis, since, size, words, size * unit)
    # A grown scatter also raises alarms of the level.
    left = [each for (axis, what), each in found.items() if what != "level" or (axis, "scatter") not in found]
    return sorted((each._replace(size=abs(each.size)) for each in left), key=lambda each: -each.size)


def _noise(found: dict[tuple[int, str], Finding], alarm: Alarm, columns: Columns, n: int) -> None:
    axis, unit = alarm.column % 6, columns.unit[alarm.column]
    before = found.get((axis, "noise"))
    since = before.since if before else alarm.since
    values = columns.values[:, alarm.column] * unit
    times = float(np.exp(middle_of(values[-LEARNS:]) - middle_of(values[max(since - LEARNS, 0) : since])))
    found.pop((axis, "noise"), None)
    if times >= LEAST_TIMES:
        words = f"{_AXES[axis]} noise {times:.1f} times what it was"
        found[axis, "noise"] = Finding("noise", axis, since, times, words)


def judge_compass(heading_bound_deg: Floats) -> list[Finding]:
    """Judge the compass by the bound of the heading's error at each power-up, (n,); NaN: not known."""
    if len(heading_bound_deg) <= LEARNS:
        return []
    columns = compass_column(heading_bound_deg)
    found = []
    for alarm in watch(*columns[:-1]):
        now = middle_of(heading_bound_deg[-LEARNS // 2 :])
        before = middle_of(heading_bound_deg[max(alarm.since - LEARNS, 0) : alarm.since])
        if alarm.kind == "level" and now > max(_BOUND_DEG, LEAST_TIMES * before):
            words = f"compass: heading good to {now:.0f} deg, before to {before:.1f}: iron near it?"
            found = [Finding("compass", -1, alarm.since, now / before, words)]
    return found


def compass_column(heading_bound_deg: Floats) -> Columns:
    """Make the column of the heading's bound for `watch`."""
    bound = np.log(np.where(heading_bound_deg > 0.0, heading_bound_deg, np.nan))[:, None]
    n, nowhere = len(bound), np.full((len(bound), 1), np.nan)
    six = np.repeat(bound[:LEARNS], 6, axis=1)
    unit = np.fmax(scatter_of_part(six, nowhere[:LEARNS, 0]).turn_on[:1], _LEAST_NOISE)
    zeros, one = np.zeros((n, 1)), np.ones(1)
    first, least = np.full(1, LEARNS), np.log(LEAST_TIMES) / unit
    return Columns(bound / unit, zeros, nowhere, WANDER[0] * one, zeros > 0.0, first, _OF_OWN * one, least, unit)


ZERO_SIGMAS: Final = 8.0
"""Least move of a zero in a finding, in sigmas."""
ZERO_USUAL_DEG: Final = 0.05
"""One sigma between two alignments of a good gradienter, from the air's temperature."""


def judge_zero(offset_deg: Floats, sigma_deg: Floats) -> list[Finding]:
    """Judge the gradienter by its latest two alignments, (m, 2) and (m,); `since` is the index of the later one."""
    if len(offset_deg) < 2:
        return []
    moved = float(np.abs(offset_deg[-1] - offset_deg[-2]).max())
    sigmas = moved / float(np.sqrt(np.square(sigma_deg[-2:]).sum() + ZERO_USUAL_DEG**2))
    if not sigmas > ZERO_SIGMAS:
        return []
    words = f"gradienter: its zero has moved by {moved:.2f} deg between two alignments ({moved * G * DEG / MG:.1f} mg)"
    return [Finding("zero", -1, len(offset_deg) - 1, sigmas / 2.0, words)]
