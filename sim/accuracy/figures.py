"""Figures from many simulated stands, with standard errors; claims about the figures, and tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from sim.earth import Array


class Figure(NamedTuple):
    """A figure from simulation, and its standard error."""

    value: float
    error: float

    def times(self, factor: float) -> Figure:
        """Return the figure multiplied by a factor, such as for another unit."""
        return Figure(self.value * factor, self.error * abs(factor))


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Errors of one run, and the sigmas stated for these errors."""

    error: Array
    sigma: Array


def stack(runs: Sequence[object], name: str) -> Any:
    """Return one attribute of all runs as an array (runs, ...)."""
    return np.array([getattr(run, name) for run in runs])


def rms(errors: Array) -> Figure:
    """Return the rms of errors (stands, …); its standard error is from the scatter of the stands; NaN is left out."""
    each = np.square(errors).reshape(len(errors), -1)
    counted = np.isfinite(each).sum(axis=1)
    if not counted.any():
        return Figure(math.nan, math.nan)
    square = float(np.nanmean(each))
    # A ratio of sums over stands, for stands may count differently.
    apart = np.nansum(each - square, axis=1)
    error = math.sqrt(float(np.square(apart).sum())) / float(counted.sum())
    return Figure(math.sqrt(square), error / (2.0 * math.sqrt(square)) if square > 0.0 else 0.0)


def covered(errors: Array, sigmas: Array, times: float) -> Figure:
    """Return the share of errors (stands, …) within `times` sigmas, with a standard error; NaN is left out."""
    inside = (np.abs(errors) <= times * sigmas).astype(np.float64).reshape(len(errors), -1)
    known = np.isfinite(errors).reshape(len(errors), -1)
    count = float(known.sum())
    if count == 0.0:
        return Figure(math.nan, math.nan)
    share = float((inside * known).sum()) / count
    apart = ((inside - share) * known).sum(axis=1)
    # At 0 or 100 % the scatter says nothing: then as of one more that is on the other side.
    return Figure(share, max(math.sqrt(float(np.square(apart).sum())), 1.0 if share in {0.0, 1.0} else 0.0) / count)


def beside(errors: Array, efficient: Array) -> Figure:
    """Return the ratio of an estimator's rms error to an efficient estimator's, on the same readings (stands, …).

    Errors are in units of the bound. The difference of the errors is uncorrelated with the efficient error (Rao), so
    the ratio is sqrt(1 + rms(difference)^2). Common noise cancels: few stands resolve one per cent.
    """
    added = rms(errors - efficient)
    value = math.sqrt(1.0 + added.value**2)
    return Figure(value, added.value * added.error / value)


@dataclass(frozen=True, slots=True)
class Claim:
    """A limit on a figure; it fails beyond the chance variation of this number of stands (three sigmas)."""

    words: str
    unit: str
    found: Figure
    at_most: float
    at_least: float = 0.0

    @property
    def holds(self) -> bool:
        slack = 3.0 * self.found.error
        return self.at_least - slack <= self.found.value <= self.at_most + slack

    def __str__(self) -> str:
        allowed = f"<= {self.at_most:g}" if not self.at_least else f"{self.at_least:g} to {self.at_most:g}"
        return (
            f"{'yes' if self.holds else 'NO':4}{self.words:55}{self.found.value:9.3f} +- {self.found.error:.3f}"
            f" {self.unit:6}{allowed:>11}"
        )


@dataclass(slots=True)
class Section:
    title: str
    lines: list[str]
    claims: list[Claim] = field(default_factory=list)
