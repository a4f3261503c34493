"""Units told by the size of the readings: gravity is 9.8 m/s^2, a MEMS gyro's noise lies within two decades.

What the names leave open, the size decides, and it is said. Where it contradicts a name, the log is refused with the
names that would fit: a rate that is wrong by 57 would be a bias that is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from companion.calibration.noise.robust import median
from companion.errors import StorageError
from companion.physics.frames import Floats
from companion.physics.units import DEG, DEG_H, G
from companion.replay.columns import FORCES, IMU, RATES, TIMES, UNITS, Columns

QUIETEST_RAD_S: Final = 3.0 * DEG_H
LOUDEST_RAD_S: Final = 0.1 * DEG
"""White noise of a mean over a second: the best MEMS parts have 7 deg/h, the worst 150."""
MOST_TURN_RAD_S: Final = 10.0 * DEG
"""A gyro that reads more is turning; `calibration.stillness` says so too."""
ACCEL_REST_M_S2: Final = 0.05
"""Scatter of a second's mean specific force: more is handling, and tells nothing of the gyros."""
GRAVITY_M_S2: Final = (7.0, 12.6)
MOST_COLOURED: Final = 8.0
"""Scatter of means over that of as many independent samples: a sensor behind a low-pass of 1 Hz; sway has more."""
_LEAST_PAIRS: Final = 5
_QUARTILE: Final = 0.4506
"""Lower quartile of |difference of two means| over their sigma: 0.3186 sqrt(2)."""
_RATES_HZ: Final = (4.0, 4000.0)
_USUAL_FORCES: Final = ("m_s2", "g", "mg")
_SOME: Final = 20_000
_MOST: Final = 1_000_000
"""Lines that the noise is looked at in: more would only take memory."""


def seconds_per(steps: Floats) -> str | None:
    """The unit of a time whose stamps differ by such steps, by the rate that it makes; None: none is likely."""
    steps = steps[steps > 0.0]
    if not len(steps):
        return None
    usual = float(median(steps))
    return next((unit for unit, size in TIMES.items() if _RATES_HZ[0] <= 1.0 / (usual * size) <= _RATES_HZ[1]), None)


def units_of(columns: Columns, t_s: Floats, readings: Floats, where: str) -> tuple[dict[str, str], list[str]]:
    """The unit of each of the IMU's columns, of which names say it or do not, and what to say about them.

    Times are (n,), readings (n, 6) as they stand in the file.

    Raises:
        StorageError: the size contradicts a name, or does not tell.
    """
    named = {what: columns.used[what].unit for what in IMU}
    notes: list[str] = []
    forces = _forces(columns, named, readings[:, 3:], where, notes)
    first = readings[:_MOST]
    rest = first[:, 3:] * [FORCES[forces[what]] for what in IMU[3:]]
    rates = _rates(columns, {**named, **forces}, (t_s[:_MOST], first[:, :3], rest), where, notes)
    return {**rates, **forces}, notes


def _forces(
    columns: Columns, named: Mapping[str, str | None], readings: Floats, where: str, notes: list[str]
) -> dict[str, str]:
    some = readings[:: max(len(readings) // _SOME, 1)]
    open_ = [what for what in IMU[3:] if named[what] is None]
    known = np.array([1.0 if named[what] is None else FORCES[str(named[what])] for what in IMU[3:]])
    with np.errstate(over="ignore"):
        size = float(median(np.sqrt(np.square(some * known).sum(axis=1)))) if len(some) else math.nan
        raw = float(median(np.sqrt(np.square(some).sum(axis=1)))) if len(some) else math.nan
    fits = [unit for unit in _USUAL_FORCES if _within(raw * FORCES[unit], GRAVITY_M_S2)]
    if open_:
        if len(open_) < 3 or len(fits) != 1:
            raise StorageError(
                f"{where}: {', '.join(open_)} say no unit, and gravity reads {raw:.4g}: not in"
                f" {' or '.join(_USUAL_FORCES)}; name them: --columns {columns.named({})}"
            )
        notes.append(f"{', '.join(open_)}: taken for {fits[0]}, gravity reads {raw:.4g}")
        return dict.fromkeys(open_, fits[0])
    forces = {what: str(named[what]) for what in IMU[3:]}
    if not _within(size, GRAVITY_M_S2):
        unit = forces["ax"]
        why = f"{where}: found {size / FORCES[unit]:.4g} {unit} for gravity, which is {G / FORCES[unit]:.4g}"
        if fits:
            right = columns.named(dict.fromkeys(IMU[3:], fits[0]))
            raise StorageError(f"{why}; the unit is {fits[0]}, it seems: --columns {right}")
        linear = "gravity taken off by an app, perhaps" if size < 1.0 else "raw counts, perhaps"
        raise StorageError(f"{why}: {linear}; allowed: specific force in {' or '.join(_USUAL_FORCES)}")
    return forces


def _rates(
    columns: Columns,
    named: Mapping[str, str | None],
    log: tuple[Floats, Floats, Floats],
    where: str,
    notes: list[str],
) -> dict[str, str]:
    t_s, readings, forces = log
    noise, white = _noise(t_s, readings)
    turn = float(np.abs(np.array([median(each) for each in readings.T])).max())
    still = _noise(t_s, forces)[0] < ACCEL_REST_M_S2 and noise < MOST_COLOURED * white
    likely = [unit for unit, factor in RATES.items() if QUIETEST_RAD_S <= noise * factor <= LOUDEST_RAD_S]
    open_ = [what for what in IMU[:3] if named[what] is None]
    if open_:
        likely = [unit for unit in likely if unit in {"rad_s", "deg_s"}]
        if len(open_) < 3 or not still or len(likely) != 1:
            raise StorageError(
                f"{where}: {', '.join(open_)} say no unit, and their noise does not tell; name them: --columns"
                f" {columns.named(dict.fromkeys(IMU[:3], 'deg_s'))}, or with rad_s"
            )
        noise *= RATES[likely[0]] / DEG_H
        notes.append(f"{', '.join(open_)}: taken for {likely[0]}, by noise of {noise:.0f} deg/h in 1 s")
        return dict.fromkeys(open_, likely[0])
    rates = {what: str(named[what]) for what in IMU[:3]}
    factor = RATES[rates["gx"]]
    if not still or not noise:
        return rates
    small = next((unit for unit in likely if RATES[unit] < factor), None)
    if noise * factor > LOUDEST_RAD_S or (turn * factor > MOST_TURN_RAD_S and small is not None):
        found = f"gyros read {turn * factor / DEG:.3g} deg/s with noise of {noise * factor / DEG:.2g} deg/s in 1 s"
        remedy = ""
        if small is not None:
            remedy = f": {small} named {rates['gx']}? --columns {columns.named(dict.fromkeys(IMU[:3], small))}"
        raise StorageError(f"{where}: {found} while the accelerometers are still{remedy}")
    large = next((unit for unit in likely if RATES[unit] > factor), None)
    if noise * factor < QUIETEST_RAD_S and large is not None:
        notes.append(
            f"gyro noise of {noise * factor / DEG_H:.2g} deg/h in 1 s, less than any MEMS part has: {large} named"
            f" {rates['gx']}? Then: --columns {columns.named(dict.fromkeys(IMU[:3], large))}"
        )
    return rates


def factors(units: Mapping[str, str]) -> Floats:
    """(6,) factors to SI of the IMU's columns."""
    return np.array([UNITS[what][units[what]] for what in IMU])


def _noise(t_s: Floats, values: Floats) -> tuple[float, float]:
    """Scatter of a second's mean on the noisiest axis, in the quieter seconds, and its white part; infinite of few."""
    slots = np.floor(t_s - t_s[0]).astype(np.int64) if len(t_s) else np.zeros(0, dtype=np.int64)
    starts = np.flatnonzero(np.diff(slots, prepend=-1))
    if len(starts) < _LEAST_PAIRS + 2:
        return math.inf, math.inf
    counts = np.diff(np.append(starts, len(slots)))[:, None]
    means = np.add.reduceat(values, starts) / counts
    off = values - np.repeat(means, counts[:, 0], axis=0)
    variances = np.sort(np.add.reduceat(off * off, starts) / np.square(counts), axis=0)
    # The last second is cut.
    means = means[:-1]
    near = np.diff(slots[starts])[:-1] == 1
    steps = np.sort(np.abs(np.diff(means, axis=0))[near], axis=0)
    if len(steps) < _LEAST_PAIRS:
        return math.inf, math.inf
    return float((steps[len(steps) // 4] / _QUARTILE).max()), math.sqrt(float(variances[len(variances) // 4].max()))


def _within(value: float, limits: tuple[float, float]) -> bool:
    return limits[0] <= value <= limits[1]
