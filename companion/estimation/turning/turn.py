"""Angular rate of the platform under a standing aircraft: an estimate with a sigma, not an assumption.

A significant rate blocks a calibration. A smaller rate is not subtracted, because the ground usually does not turn, but
adds to the sigma of every gyro. A slow tilting of gravity's direction adds to the sigma of horizontal axes; the gates
reject a faster one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Literal

import msgspec
import numpy as np

from companion.estimation.noise.lines import FEWEST, fit_slope, hidden_by_steps, plain_slope
from companion.estimation.seconds.batch import Batch, decimal, few_distinct
from companion.physics.frames import Array, Matrix
from companion.physics.units import DEG
from companion.samples import Vector

LEAST_RAD_S: Final = 0.005 * DEG
"""Least rate that blocks a calibration: a warming compass drifts by some tenths of a degree in a minute."""
LEAST_BY_GYROS_RAD_S: Final = 0.01 * DEG
"""Least rate that blocks a calibration without a compass: an uneven warm-up of the gyro can show as much."""
SIGNIFICANT: Final = 4.0
"""Threshold in sigmas for a rate that is checked every second; by chance, 1 of 100 motionless minutes exceeds 3."""
CHANCE_SIGMAS: Final = 2.0
EVEN: Final = 0.25  # Share of the rate that each half of the headings must show; a jump shows in one half only


class Turn(msgspec.Struct, frozen=True, kw_only=True):
    """Angular rate of the platform during a window: about the vertical, and tilting about horizontal axes.

    `by` None: no sensor measures the rate. `noise_rad_s`: sigma of the gyros without warm-up. `step_rad_s`: error of
    the window's mean if a turn began within the window. `is_vouched`: a compass measured the turn during the rest with
    which the gyros are compared.
    """

    rate_rad_s: float = 0.0  # About the vertical, clockwise seen from above; never subtracted
    sigma_rad_s: float = 0.0
    noise_rad_s: float = 0.0
    by: Literal["compass", "gyros", "compass and gyros", "earlier calibrations"] | None = None
    tilting_rad_s: Vector = (0.0, 0.0, 0.0)  # Horizontal part, vehicle FRD
    tilting_sigma_rad_s: float = 0.0
    step_rad_s: float = 0.0
    is_vouched: bool = True

    @property
    def is_significant(self) -> bool:
        least = LEAST_BY_GYROS_RAD_S if self.by == "gyros" else LEAST_RAD_S
        return abs(self.rate_rad_s) > max(SIGNIFICANT * self.sigma_rad_s, least)

    @property
    def in_words(self) -> str:
        """Format the rate, for example 'turns 0.15 deg/s to the left'."""
        size = abs(self.rate_rad_s) / DEG
        digits = max(1, 1 - math.floor(math.log10(size))) if size > 0.0 else 2
        return f"turns {size:.{digits}f} deg/s to the {'right' if self.rate_rad_s > 0.0 else 'left'}"

    @property
    def is_chance(self) -> bool:
        return abs(self.rate_rad_s) <= CHANCE_SIGMAS * self.sigma_rad_s

    @property
    def is_told(self) -> bool:
        """True if the rate is measured and `is_vouched`; otherwise the ground counts as fixed to the Earth."""
        return self.by is not None and self.is_vouched

    @property
    def at_most_rad_s(self) -> float:
        return abs(self.rate_rad_s) + 2.0 * self.sigma_rad_s

    @property
    def variance(self) -> float:
        """Return the variance, (rad/s)^2, that the turn adds to the error of a vertical gyro.

        Unless `is_told`, the ground counts as fixed if the gyros show no more than their noise.
        """
        if self.is_told:
            return self.rate_rad_s**2 + self.sigma_rad_s**2 + self.step_rad_s**2
        known = self.rate_rad_s if abs(self.rate_rad_s) > self.noise_rad_s else 0.0
        return known**2 + self.step_rad_s**2

    def covariance(self, up: Array) -> Matrix:
        """Return the covariance (3, 3), vehicle FRD, that the turn adds to the gyros' errors; `up`: unit vector."""
        level = np.eye(3) - np.outer(up, up)
        tilting = level @ np.array(self.tilting_rad_s)
        return np.outer(up, up) * self.variance + np.outer(tilting, tilting) + level * self.tilting_sigma_rad_s**2

    def contradicts(self, other: Turn) -> bool:
        return abs(self.rate_rad_s - other.rate_rad_s) > SIGNIFICANT * math.hypot(self.sigma_rad_s, other.sigma_rad_s)


def by_compass(headings: Sequence[Batch]) -> Turn | None:
    """Estimate the platform's rate from the slope of the heading; a heading that jumps gives no significant rate."""
    if len(headings) < FEWEST:
        return None
    slots = np.array([batch.slot for batch in headings], dtype=np.int64)
    turned = np.unwrap(np.array([batch.mean for batch in headings]), period=360.0, axis=0)
    white, low, high, distinct = (
        np.array([getattr(batch, name) for batch in headings]) for name in ("white", "low", "high", "distinct")
    )
    step = max(float(np.where(distinct == 2, high - low, 0.0).max()), float(decimal(low, high)[0]))
    hidden = hidden_by_steps(step, float(white.mean()), enough=not few_distinct(distinct)[0])
    # Few seconds do not show their own noise well; the readings within them do.
    least = math.sqrt(float(np.mean([batch.white[0] / batch.n for batch in headings])))
    found = fit_slope(slots, turned, white=least, hidden=hidden)
    rate, sigma = float(found.per_s[0]), math.sqrt(float(found.variance[0]))
    half = len(slots) // 2
    parts = [plain_slope(slots[part], turned[part, 0]) for part in (slice(None, -half), slice(half, None))]
    if not all(part * rate > EVEN * rate**2 for part in parts):
        sigma = max(sigma, abs(rate) / SIGNIFICANT)
    return Turn(rate_rad_s=rate * DEG, sigma_rad_s=sigma * DEG, by="compass")


def by_gyros(turns: Sequence[Turn]) -> Turn | None:
    """Return the most precise of several IMUs' rates; if others contradict it, the least significant one."""
    if not turns:
        return None
    best = min(turns, key=lambda one: one.sigma_rad_s)
    rivals = [one for one in turns if one.contradicts(best)]
    return min([best, *rivals], key=lambda one: abs(one.rate_rad_s) / one.sigma_rad_s)


def by_both(gyros: Turn | None, seen: Turn | None) -> Turn:
    """Combine gyros and compass; in a contradiction, use the gyros if these show no turn, otherwise the compass."""
    if gyros is None or seen is None:
        return gyros or seen or Turn()
    if not gyros.is_vouched:
        return seen
    if gyros.contradicts(seen):
        return gyros if abs(gyros.rate_rad_s) <= SIGNIFICANT * gyros.sigma_rad_s else seen
    share = seen.sigma_rad_s**2 / (gyros.sigma_rad_s**2 + seen.sigma_rad_s**2)
    return Turn(
        rate_rad_s=share * gyros.rate_rad_s + (1.0 - share) * seen.rate_rad_s,
        sigma_rad_s=math.sqrt(share) * gyros.sigma_rad_s,
        by="compass and gyros",
    )
