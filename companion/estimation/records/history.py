"""History of one IMU's biases, and the choice of the points that a prediction uses.

The history has biases as *measured*, without autopilot offsets, and never combined with a prior: a prior that learns
from itself becomes more certain with every calibration. One power-up counts as one point, whatever the number of its
calibrations, because they all include the same turn-on bias.

A start of the daemon reads thousands of points: they are stored as arrays and not tracked by the garbage collector.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Sequence
from typing import Annotated, Final

import msgspec

from companion.samples import Triad, Vector

_MOST: Final = 100.0
"""Largest stored bias and sigma, rad/s or m/s^2: above the worst IMU's, even with a wrong scale."""
_Bias = Annotated[float, msgspec.Meta(ge=-_MOST, le=_MOST)]
_Sigma = Annotated[float, msgspec.Meta(ge=0.0, le=_MOST)]
_Sigmas = tuple[_Sigma, _Sigma, _Sigma]
WEIGHS_FROM: Final = 5
"""Least number of earlier power-ups for a prediction that takes part in the estimate."""
NEW_AFTER: Final = 3
"""Number of power-ups in a row that contradict earlier ones: so many show a replaced sensor, fewer are outliers."""
KEEP_POWER_UPS: Final = 48
KEEP_POINTS: Final = 8  # Maximum points of a power-up
NEAR_K: Final = 2.0  # Temperature difference below which points are redundant
_LATEST: Final = 10
"""Number of latest power-ups that are stored whatever their temperature, because a sensor ages."""
SAME_START_S: Final = 60.0
"""Largest difference of two start times, s, that count as one power-up, because the wall clock can be adjusted."""


class PowerUp(msgspec.Struct, frozen=True, kw_only=True, array_like=True, gc=False):
    """Identity of a power-up: start of the companion computer (`host`), and of the sensor's own device.

    One matching start makes two power-ups the same: one too few makes a prior cautious, one too many overconfident.
    """

    host: str
    since_unix_s: float | None  # Start of the sensor's own device, by the wall clock; None: unknown

    def is_same(self, other: PowerUp) -> bool:
        """Return False only if the power was certainly off between both starts."""
        return self.host == other.host or self.started_with(other)

    def started_with(self, other: PowerUp) -> bool:
        """Return True if the sensor's own device has the same start time in both power-ups: it stayed powered."""
        mine, theirs = self.since_unix_s, other.since_unix_s
        return mine is not None and theirs is not None and abs(mine - theirs) < SAME_START_S


class MeasuredBias(msgspec.Struct, frozen=True, kw_only=True, array_like=True, gc=False):
    """Bias of one triad from the readings alone, without autopilot offsets, in vehicle axes (FRD), rad/s or m/s^2.

    `sigma_use` is from the sensor alone, `sigma_shared` from place and heading, without the gradienter's zero.
    `suspect`: contradicts its prediction. `chosen`: suspect, but written on request; earlier points no longer count.
    """

    bias: tuple[_Bias, _Bias, _Bias]
    sigma_stat: _Sigmas
    sigma_use: _Sigmas
    sigma_shared: _Sigmas
    suspect: bool = False
    chosen: bool = False

    @property
    def is_outlier(self) -> bool:
        return self.suspect and not self.chosen


class Point(msgspec.Struct, frozen=True, kw_only=True, array_like=True, gc=False):
    """Biases of one IMU from one calibration, or from a motionless window without calibration (`started_at` empty).

    `up` is the up vector during the measurement, in vehicle axes. `zero` identifies the gradienter's zero in
    use; None without a gradienter.
    """

    started_at: str
    unix_s: float
    power_up: PowerUp
    temperature_degc: float | None
    k_s: float = 0.0
    up: Vector
    zero: str | None = None
    zero_sigma_rad: float = 0.0
    gyro: MeasuredBias | None = None
    accel: MeasuredBias | None = None

    def of(self, triad: Triad) -> MeasuredBias | None:
        return self.gyro if triad == "gyro" else self.accel

    def measured(self, triad: Triad) -> MeasuredBias:
        found = self.of(triad)
        assert found is not None
        return found

    def as_chosen(self, *, gyro: bool = True) -> Point:
        """Mark suspect biases as chosen if their calibration was requested and is active; `gyro`: also the gyro's."""
        found: dict[Triad, MeasuredBias | None] = {"gyro": self.gyro if gyro else None, "accel": self.accel}
        chosen = {t: msgspec.structs.replace(one, chosen=True) for t, one in found.items() if one and one.suspect}
        return msgspec.structs.replace(self, **chosen)


def by_power_up(points: Sequence[Point]) -> list[list[Point]]:
    groups: list[list[Point]] = []
    for point in points:
        for group in reversed(groups):
            if any(point.power_up.is_same(other.power_up) for other in (group[0], group[-1])):
                group.append(point)
                break
        else:
            groups.append([point])
    return groups


def kept(points: Sequence[Point]) -> tuple[Point, ...]:
    """Choose the points to store, so that rare temperatures (winter) stay in the history.

    Among too many power-ups, the oldest one with the most common temperatures is dropped. Among too many points of one
    power-up, the latest and those at the most different temperatures stay.
    """
    groups = [_thinned(group) for group in by_power_up(points)]
    while len(groups) > KEEP_POWER_UPS:
        degcs = [[point.temperature_degc for point in group] for group in groups]
        told = [{None if degc is None else math.floor(degc / NEAR_K) for degc in group} for group in degcs]
        often = Counter(step for steps in told for step in steps)
        rarest = [min(often[step] for step in steps) for steps in told[:-_LATEST]]
        del groups[rarest.index(max(rarest))]
    return tuple(point for group in groups for point in group)


def _thinned(group: Sequence[Point]) -> Sequence[Point]:
    left = list(group)
    while len(left) > KEEP_POINTS:
        # Drop windows without a calibration first, chosen points last.
        ranks = [(any(of is not None and of.chosen for of in (p.gyro, p.accel)), bool(p.started_at)) for p in left[:-1]]
        steps = [abs((b.temperature_degc or 0.0) - (a.temperature_degc or 0.0)) for a, b in itertools.pairwise(left)]
        del left[min(range(len(steps)), key=lambda k: (ranks[k], steps[k]))]
    return left


def believed(points: Sequence[Point], triad: Triad) -> list[list[Point]]:
    """Choose the points for a prediction of one triad, grouped by power-up.

    Outliers are left out, and all points before `NEW_AFTER` power-ups of outliers in a row, or before a chosen point.
    """
    measured = [point for point in points if point.of(triad) is not None]
    start = max((k for k, point in enumerate(measured) if point.measured(triad).chosen), default=0)
    groups = by_power_up(measured[start:])
    trusted = [[point for point in group if not point.measured(triad).is_outlier] for group in groups]
    first = row = end = 0
    for k, group in enumerate(trusted):
        row = 0 if group else row + 1
        if row >= NEW_AFTER:
            first, end = k + 1 - row, k + 1
    return [*groups[first:end], *(group for group in trusted[end:] if group)]
