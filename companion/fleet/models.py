"""Scatter of IMU parts and of their models: how far biases scatter from power-up to power-up, and wander.

Pure functions of biases; columns are gyro x y z, then accelerometer x y z, vehicle FRD, SI units.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from companion.physics.frames import Floats
from companion.physics.statistics import MAD_TO_SIGMA

LEAST_POWER_UPS: Final = 8
"""Least power-ups for the scatter of a part."""
LEAST_PARTS: Final = 4
"""Least parts for the scatter of a model."""
WANDER_LAG: Final = 30
"""Power-ups between the two levels that tell the wander."""
_STEP_K: Final = 15.0
_FOR_A_TERM: Final = 24
"""Power-ups for each further power of the temperature."""
_LEAST_SPREAD: Final = 0.05
"""Least difference between the scatters of parts, as a share of the typical scatter."""
_OUTLIER: Final = 3.0
"""Sigmas beyond which a step is left out of the slope over temperature."""
_GROUPS: Final = (slice(0, 3), slice(3, 5), slice(5, 6))
"""Columns with one scatter: parts are mounted in any direction, but the gradienter adds to the level accelerometers."""


class Scatter(NamedTuple):
    """Scatter of one part, or of a model; (6,) each, NaN where not known."""

    power_ups: int
    turn_on: Floats
    """One sigma from one power-up to another at one temperature, errors of the calibrations included."""
    wander: Floats
    """One sigma of the step that stays, from one power-up to the next."""
    per_k: Floats
    """Slope over temperature, at the mean of the known temperatures."""


def scatter_of_part(biases: Floats, temperature_degc: Floats) -> Scatter:
    """Estimate the scatter of a part from its power-ups in order, (n, 6) and (n,); NaN: not measured.

    Steps between successive power-ups, less the part that follows the temperature, are the input: neither ageing nor a
    single move makes them larger.
    """
    turn_on, wander, per_k = np.array([_column(column, temperature_degc) for column in biases.T]).T
    return Scatter(len(biases), turn_on, wander, per_k)


def scatter_of_model(parts: Sequence[Scatter]) -> Scatter | None:
    """Give the median scatter of the parts; None: fewer than `LEAST_PARTS` have one."""
    telling = [part for part in parts if np.isfinite(part.turn_on).any()]
    if len(telling) < LEAST_PARTS:
        return None
    figures = np.array([part[1:] for part in telling])
    middle = np.empty((3, 6))
    for group in _GROUPS:
        middle[:, group] = [[middle_of(each)] for each in np.moveaxis(figures[:, :, group], 1, 0)]
    return Scatter(sum(part.power_ups for part in telling), *middle)


class Typical(NamedTuple):
    """Typical part of a model, and how much parts differ from it, one sigma; (6,) each, NaN where not known."""

    turn_on: Floats
    turn_on_spread: Floats
    per_k: Floats
    per_k_spread: Floats


def typical_part(parts: Sequence[Scatter]) -> Typical | None:
    """Describe the typical part of a model; None: fewer than `LEAST_PARTS` have a known scatter."""
    telling = [part for part in parts if np.isfinite(part.turn_on).any()]
    usual = scatter_of_model(telling)
    if usual is None:
        return None
    turn_on, per_k = (np.array([getattr(part, name) for part in telling]) for name in ("turn_on", "per_k"))
    slope = np.array([middle_of(column, LEAST_PARTS) for column in per_k.T])
    spread = np.maximum(_spread(turn_on, usual.turn_on), _LEAST_SPREAD * usual.turn_on)
    return Typical(usual.turn_on, spread, slope, _spread(per_k, slope))


def _spread(values: Floats, about: Floats) -> Floats:
    """Estimate one sigma of each column from the median deviation."""
    return MAD_TO_SIGMA * np.array([middle_of(off, LEAST_PARTS) for off in np.abs(values - about).T])


def middle_of(values: Floats, least: int = 1) -> float:
    """Give the median of the known values; NaN: fewer than `least` are known."""
    there = values[np.isfinite(values)]
    return float(np.median(there)) if len(there) >= least else np.nan


def _column(bias: Floats, temperature_degc: Floats) -> tuple[float, float, float]:
    there = np.isfinite(bias)
    value, degc = bias[there], temperature_degc[there]
    if len(value) < LEAST_POWER_UPS:
        return np.nan, np.nan, np.nan
    known = np.isfinite(degc)
    warmer = np.where(known, degc - (degc[known].mean() if known.any() else 0.0), 0.0) / _STEP_K
    # A line for few, up to a cubic for many.
    laws = warmer[:, None] ** np.arange(1, 2 + min(len(value) // _FOR_A_TERM, 2))
    step, by = np.diff(value), np.diff(laws, axis=0)
    weight = np.ones(len(step))
    for _ in range(3):
        terms = np.linalg.lstsq(by * weight[:, None], step * weight, rcond=None)[0]
        scale = _sigma(step - by @ terms)
        weight = (np.abs(step - by @ terms) <= _OUTLIER * scale).astype(np.float64)
    turn_on = scale / np.sqrt(2.0)
    if len(value) < 3 * WANDER_LAG:
        return turn_on, np.nan, terms[0] / _STEP_K
    level = value - laws @ terms
    far = _sigma(level[WANDER_LAG:] - level[:-WANDER_LAG])
    return turn_on, np.sqrt(max(far**2 - scale**2, 0.0) / (WANDER_LAG - 1)), terms[0] / _STEP_K


def _sigma(steps: Floats) -> float:
    return MAD_TO_SIGMA * float(np.median(np.abs(steps)))
