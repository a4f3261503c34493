"""What the parts of one IMU model have in common: how far their biases scatter from power-up to power-up, and wander.

Pure functions of what calibrations have found; columns are gyro x y z, then accelerometer x y z, vehicle FRD, SI units.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

import msgspec
import numpy as np

from companion.calibration.noise.robust import median
from companion.physics.frames import Floats

LEAST_POWER_UPS: Final = 8
"""Of one part, before its scatter says something."""
LEAST_PARTS: Final = 4
"""Of a model, before it is one to compare with."""
WANDER_LAG: Final = 30
_MAD_TO_SIGMA: Final = 1.4826
_OUTLIER: Final = 3.0
"""Sigmas beyond which a step counts no more for the slope over temperature."""
_GROUPS: Final = ((0, 1, 2), (3, 4), (5,))
"""Columns whose scatter is one: parts are mounted in any direction, but that of the level accelerometers has the
gradienter's share in it."""


class Scatter(msgspec.Struct, frozen=True):
    """Of one part, or of a model: (6,) each, NaN where it is not known."""

    power_ups: int
    parts: int
    turn_on: Floats
    """One sigma from one power-up to another at one temperature, errors of the calibrations included."""
    wander: Floats
    """One sigma of the step that stays, from one power-up to the next."""


def model_of(firmware: Literal["ardupilot", "px4"] | None, gyro_id: int | None, accel_id: int | None) -> str | None:
    """The IMU model by the device types in its ids, whose numbers are each firmware's own; None: it is not known."""
    if not gyro_id or not accel_id or firmware is None:
        return None
    from companion.autopilot.firmware.firmwares import part_of

    types = f"{gyro_id >> 16 & 0xFF:#04x}/{accel_id >> 16 & 0xFF:#04x}"
    return part_of(firmware, gyro_id, accel_id) or f"{firmware} {types}"


def scatter_of_part(biases: Floats, temperature_degc: Floats) -> Scatter:
    """Of one part over its power-ups in their order, (n, 6) and (n,); NaN: not measured.

    Made of the steps between power-ups that follow one another, which neither a bias that ages nor one that has moved
    once makes larger, less a line over temperature.
    """
    found = [_column(column, temperature_degc) for column in biases.T]
    turn_on, wander = np.array(found).reshape(-1, 2).T
    return Scatter(len(biases), 1, turn_on, wander)


def scatter_of_model(parts: Sequence[Scatter]) -> Scatter | None:
    """The typical part's, by the median; None: there are fewer than `LEAST_PARTS` that tell."""
    telling = [part for part in parts if np.isfinite(part.turn_on).any()]
    if len(telling) < LEAST_PARTS:
        return None
    turn_on, wander = np.full(6, np.nan), np.full(6, np.nan)
    for group in map(list, _GROUPS):
        turn_on[group] = _middle(np.array([part.turn_on[group] for part in telling]))
        wander[group] = _middle(np.array([part.wander[group] for part in telling]))
    return Scatter(sum(part.power_ups for part in telling), len(telling), turn_on, wander)


def _middle(values: Floats) -> float:
    there = values[np.isfinite(values)]
    return float(median(there)) if there.size else np.nan


def _column(bias: Floats, temperature_degc: Floats) -> tuple[float, float]:
    there = np.isfinite(bias)
    value, degc = bias[there], temperature_degc[there]
    if len(value) < LEAST_POWER_UPS:
        return np.nan, np.nan
    step, warmer = np.diff(value), np.nan_to_num(np.diff(degc))
    slope = 0.0
    weight = np.ones(len(step))
    for _ in range(3):
        slope = float((weight * warmer * step).sum() / max(float((weight * warmer**2).sum()), 1e-9))
        scale = _sigma(step - slope * warmer)
        weight = (np.abs(step - slope * warmer) <= _OUTLIER * scale).astype(np.float64)
    turn_on = scale / np.sqrt(2.0)
    if len(value) < 3 * WANDER_LAG:
        return turn_on, np.nan
    known = np.isfinite(degc)
    level = value - slope * np.where(known, degc - (degc[known].mean() if known.any() else 0.0), 0.0)
    far = _sigma(level[WANDER_LAG:] - level[:-WANDER_LAG])
    return turn_on, float(np.sqrt(max(far**2 - scale**2, 0.0) / (WANDER_LAG - 1)))


def _sigma(steps: Floats) -> float:
    return _MAD_TO_SIGMA * float(median(np.abs(steps)))
