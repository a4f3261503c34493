"""An accelerometer looked at as the gradienter looks at gravity: by its law, and as late as its fluid.

Both feel the same specific force, so that what surge does to the one it does to the other; their difference is the
accelerometers' bias and the gradienter's zero, and nothing else to first order. What the lag is wrong by shows as a
difference that goes with the slope of the tilt; it is one unknown more, and takes nothing from a mean over some waves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from companion.estimation.deck.waves import Waves, fit_waves, whitened
from companion.estimation.means.pose import GradienterModel
from companion.physics.frames import Array, Floats, Matrix
from companion.physics.gradienter import readings_from_up


class Level(msgspec.Struct, frozen=True):
    """One second of gradienter and accelerometer; (2,) x and y in degrees, in the gradienter's axes."""

    reading: Floats
    difference: Floats
    """Gradienter minus what it would show by the accelerometer."""
    slope: Floats
    """Of the latter, in degrees a second."""


class Compared(NamedTuple):
    """What the gradienter shows more than the accelerometers would make it, over many seconds."""

    difference_deg: Array
    covariance_deg2: Matrix


class Fluid:
    """What the gradienter would show of one IMU's specific force."""

    def __init__(self, model: GradienterModel) -> None:
        self._law, self._turn, self.lag_s = model.law, model.vehicle_from_sensor, model.lag_s
        self._last: tuple[float, float, float] | None = None
        self._shown = (0.0, 0.0)

    def follow(self, times_s: Floats, forces_m_s2: Floats) -> Floats:
        """(n, 2) after its lag, for forces (n, 3) in the vehicle's axes; exact for a tilt that changes evenly."""
        felt = readings_from_up(self._law, forces_m_s2 @ self._turn)
        if self.lag_s <= 0.0:
            return felt
        found = np.empty_like(felt)
        lag_s = self.lag_s
        if self._last is None:
            self._last = float(times_s[0]), float(felt[0, 0]), float(felt[0, 1])
            self._shown = self._last[1], self._last[2]
        then, x_before, y_before = self._last
        x_shown, y_shown = self._shown
        for row, (now, (x, y)) in enumerate(zip(times_s.tolist(), felt.tolist(), strict=True)):
            span = now - then
            if span > 0.0:
                keep, behind = math.exp(-span / lag_s), lag_s / span
                x_late, y_late = (x - x_before) * behind, (y - y_before) * behind
                x_shown = x - x_late + (x_shown - x_before + x_late) * keep
                y_shown = y - y_late + (y_shown - y_before + y_late) * keep
            found[row] = x_shown, y_shown
            then, x_before, y_before = now, x, y
        self._last, self._shown = (then, x_before, y_before), (x_shown, y_shown)
        return found


def level(times_s: Floats, shown_deg: Floats, tilt_times_s: Floats, tilts_deg: Floats) -> Level | None:
    """One second, from what the fluid would show (n, 2) and what it shows (m, 2); None where they do not overlap."""
    inside = (tilt_times_s >= times_s[0]) & (tilt_times_s <= times_s[-1])
    if not inside.any():
        return None
    at, tilts = tilt_times_s[inside], tilts_deg[inside]
    would = np.column_stack([np.interp(at, times_s, shown_deg[:, axis]) for axis in range(2)])
    return Level(
        tilts.mean(axis=0),
        (tilts - would).mean(axis=0),
        (shown_deg[-1] - shown_deg[0]) / max(float(times_s[-1] - times_s[0]), 1e-6),
    )


def compare(levels: Sequence[Level]) -> Compared:
    """The difference over the seconds of a window, weighted by the waves that are left in it."""
    difference = np.array([one.difference for one in levels])
    slope = np.array([one.slope for one in levels])
    one, nothing = np.ones(len(levels)), np.zeros(len(levels))
    waves: Waves = fit_waves([column - column.mean() for column in difference.T])
    for _ in range(2):
        rows = np.vstack(
            [
                whitened(np.column_stack([one, nothing, -slope[:, 0], difference[:, 0]]), waves),
                whitened(np.column_stack([nothing, one, -slope[:, 1], difference[:, 1]]), waves),
            ]
        )
        regressors = rows[:, :3]
        # A lag may be off by a second, not by more: that keeps it out of what stands still.
        information = regressors.T @ regressors + np.diag([0.0, 0.0, 1.0])
        covariance = np.linalg.inv(information)
        x, y, lag = covariance @ (regressors.T @ rows[:, 3])
        left = difference - np.array([x, y]) + slope * lag
        waves = fit_waves([column - column.mean() for column in left.T])
    spent = 3 + len(waves.terms)
    widened = len(rows) / max(len(rows) - spent, len(rows) / 4.0)
    return Compared(np.array([x, y]), np.asarray(covariance[:2, :2] * widened))
