"""From earlier calibrations to what today's bias should be (method section 3, "prior / MAP" and "temperature").

Run to run a MEMS bias scatters (an ADIS16405 by 70 deg/h and 2 mg, method section 1.3). What is expected of today is
the mean of the earlier power-ups, or their line over temperature, and its sigma is that of *one more* power-up: the
scatter, widened as Student's for few points, and the error of the mean.

From three power-ups on that guards (`joint`), from five on it may take part in the estimate. Within one power-up the
bias is the one it started with, moved by temperature and drift: that guards best of all, and takes no part.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np

from companion.calibration.noise.allan import AllanModel, floor_variance
from companion.calibration.solution.history import Measured, Point, PowerUp, believed
from companion.calibration.solution.pose_effect import PoseEffect
from companion.physics.frames import Array, Floats, vector
from companion.physics.units import DEG_H, MG
from companion.samples import Triad, Vector

GUARDS_FROM: Final = 3
"""Power-ups."""
WEIGHS_FROM: Final = 5
LINE_FROM: Final = 5
LINE_OVER_K: Final = 5.0
VALID_K: Final = 3.0
"""So far beyond the temperatures seen the model holds (method section 3)."""
GATE_SIGMAS: Final = 4.0
TEMPERATURE_SIGMA_K: Final = 10.0
"""Between two calibrations of one power-up, where no temperature is told."""
CATALOGUE_SCATTER: Final[dict[Triad, float]] = {"gyro": 70.0 * DEG_H, "accel": 2.0 * MG}
"""Method section 1.3; here it only weighs the points against one another."""
CATALOGUE_PER_K: Final[dict[Triad, float]] = {"gyro": 54.0 * DEG_H, "accel": 0.2 * MG}
"""BMI088, the worse one of method section 2.1."""
_AT_LEAST: Final = 0.5
"""So much of what the points show counts as the sensor's scatter."""
_IN_RUN_MEAN_S: Final = 30.0
_SHORTEST_GAP_S: Final = 180.0


class Expected(msgspec.Struct, frozen=True, kw_only=True):
    """What one triad's whole bias should be today, vehicle FRD, rad/s or m/s^2."""

    value: Vector
    variance: Vector
    """Of today's bias about it, without the gradienter's zero."""
    limit: float
    """Of the gate, in sigmas: 4, or what is as improbable where the scatter is known from few points."""
    power_ups: int
    weighs: bool
    """Whether it may take part in the estimate."""
    by_temperature: bool = False
    same_zero: float = 0.0
    """The share of it that was measured with today's zero of the gradienter, whose error is in both."""
    other_zero_rad: float = 0.0
    """One sigma of the error of the other zeros in it."""


class ExpectedImu(msgspec.Struct, frozen=True, kw_only=True):
    """One IMU: from earlier power-ups, and from earlier in this one."""

    name: str
    gyro: Expected | None = None
    accel: Expected | None = None
    gyro_today: Expected | None = None
    accel_today: Expected | None = None
    effect: PoseEffect | None = None
    """How its accelerometers' bias moves with the attitude."""

    def of(self, triad: Triad, *, today: bool) -> Expected | None:
        """One of the four."""
        if today:
            return self.gyro_today if triad == "gyro" else self.accel_today
        return self.gyro if triad == "gyro" else self.accel


class Expectation(msgspec.Struct, frozen=True, kw_only=True):
    """Everything that a calibration knows from before."""

    imus: tuple[ExpectedImu, ...] = ()
    zero_is_known: bool = False
    """The sigma of the gradienter's zero is one that somebody measured or vouches for, and no cautious guess."""


class Now(msgspec.Struct, frozen=True, kw_only=True):
    """Today's circumstances of one IMU."""

    unix_s: float
    power_up: PowerUp
    temperature_degc: float | None
    up: Vector
    gravity_m_s2: float
    zero: str | None


def student_limit(freedom: float) -> float:
    """What is as improbable in Student's distribution as `GATE_SIGMAS` is in the normal one.

    Cornish-Fisher expansion to third order (Abramowitz and Stegun 26.7.5); from 6 degrees of freedom on, and below the
    exact value by at most a tenth.
    """
    x, n = GATE_SIGMAS, freedom
    first = (x**3 + x) / 4.0
    second = (5.0 * x**5 + 16.0 * x**3 + 3.0 * x) / 96.0
    third = (3.0 * x**7 + 19.0 * x**5 + 17.0 * x**3 - 15.0 * x) / 384.0
    return x + first / n + second / n**2 + third / n**3


def expect(points: Sequence[Point], triad: Triad, now: Now, effect: PoseEffect) -> Expected | None:
    """What the earlier power-ups say of today; None where they are too few."""
    chosen = [
        _nearest(group, now.temperature_degc)
        for group in believed(points, triad)
        if not any(point.power_up.is_same(now.power_up) for point in group)
    ]
    count = len(chosen)
    if count < GUARDS_FROM:
        return None
    found = [_of(point, triad) for point in chosen]
    bias, pose = _here(chosen, found, triad, now, effect)
    stat = np.square([one.sigma_stat for one in found])
    zeros = [point.zero_sigma_rad * now.gravity_m_s2 if triad == "accel" else 0.0 for point in chosen]
    # A point that is worse known than its power-up scatters counts less.
    weight = 1.0 / (CATALOGUE_SCATTER[triad] ** 2 + (stat + np.square(pose)).mean(axis=1) + np.square(np.array(zeros)))
    temperature, excess_k = _temperatures(chosen, now.temperature_degc)
    fit = _fitted(bias, weight, stat, None, 0.0, CATALOGUE_PER_K[triad] * excess_k)
    if temperature is not None and count >= LINE_FROM and np.ptp(temperature) >= LINE_OVER_K:
        line = _fitted(bias, weight, stat, temperature, excess_k, CATALOGUE_PER_K[triad] * excess_k)
        if line.variance.mean() < fit.variance.mean():
            fit = line
    # What one attitude or one place adds to all of them is not averaged away.
    together = np.square(np.abs(fit.share) @ np.abs(pose)) + np.max(np.square([f.sigma_shared for f in found]), axis=0)
    same, other = _zeros(chosen, fit.share, now.zero) if triad == "accel" else (0.0, 0.0)
    return Expected(
        value=vector(fit.value),
        variance=vector(fit.variance + together),
        limit=student_limit(fit.freedom),
        power_ups=count,
        weighs=count >= WEIGHS_FROM and excess_k == 0.0,
        by_temperature=fit.by_temperature,
        same_zero=same,
        other_zero_rad=other,
    )


def expect_today(last: Point, triad: Triad, now: Now, effect: PoseEffect, model: AllanModel) -> Expected | None:
    """What an earlier calibration in this very power-up says of now; None where it did not measure this."""
    found = last.of(triad)
    if found is None:
        return None
    bias, pose = _here([last], [found], triad, now, effect)
    if last.temperature_degc is None or now.temperature_degc is None:
        change_k = TEMPERATURE_SIGMA_K
    else:
        change_k = now.temperature_degc - last.temperature_degc
    gap_s = max(abs(now.unix_s - last.unix_s), _SHORTEST_GAP_S)
    drift = float(floor_variance(model.flicker, model.walk, _IN_RUN_MEAN_S, 2.0 * gap_s))
    variance = (
        np.square(found.sigma_use)
        + np.square(found.sigma_shared)
        + np.square(pose[0])
        + (CATALOGUE_PER_K[triad] * change_k) ** 2
        + drift
    )
    same = triad == "accel" and last.zero == now.zero
    return Expected(
        value=vector(bias[0]),
        variance=vector(variance),
        limit=GATE_SIGMAS,
        power_ups=1,
        weighs=False,
        same_zero=1.0 if same else 0.0,
        other_zero_rad=last.zero_sigma_rad if triad == "accel" and not same else 0.0,
    )


class _Fit(msgspec.Struct, frozen=True):
    value: Floats
    variance: Floats
    """Of one more point about it, (3,)."""
    share: Floats
    """Of every point in `value`, (points,); sums up to 1."""
    freedom: float
    by_temperature: bool


def _fitted(
    bias: Floats, weight: Floats, stat: Floats, temperature: Floats | None, beyond_k: float, least: float
) -> _Fit:
    """Mean, or line over temperature (of the points, less today's), and the variance of one more point about it.

    Args:
        bias: (points, 3).
        weight: (points,).
        stat: variance that the measurement of each point has left, (points, 3).
        temperature: K; None for a mean.
        beyond_k: so far today lies outside of what the points cover; the line ends there.
        least: sigma that this adds at least.
    """
    count = len(bias)
    share = weight / weight.sum()
    residual = bias - share @ bias
    freedom = count - 1.0
    steepest = 0.0
    if temperature is not None:
        middle = float(share @ temperature)
        about = temperature - middle
        along = share * about / float(share @ np.square(about))
        slope = along @ bias
        residual = residual - np.outer(about, slope)
        nearest = math.copysign(max(abs(middle) - beyond_k, 0.0), -middle)
        share = share + nearest * along
        freedom -= 1.0
        steepest = float(np.abs(slope).max()) * beyond_k
    each = (weight / weight.mean()) @ np.square(residual) / freedom
    # Three axes know the scatter better than one, but one may scatter more than the others.
    spread = np.maximum(each, each.mean())
    freedom *= 3.0
    measured = stat.mean(axis=0)
    # The measurement's own noise is in it, and is no scatter of the sensor; but few points cannot tell them apart, and
    # what is said of that noise may be too much (half a step of integers).
    scatter = np.maximum(
        spread * freedom / (freedom - 2.0) - measured, spread * max(math.sqrt(2.0 / freedom), _AT_LEAST)
    )
    variance = scatter + np.square(share) @ (scatter + stat) + max(least, steepest) ** 2
    return _Fit(share @ bias, variance, share, freedom, temperature is not None)


def _temperatures(points: Sequence[Point], today: float | None) -> tuple[Floats | None, float]:
    """Of the points, less today's; and by how much today is beyond them, and `VALID_K`. None: not known of all."""
    known = [point.temperature_degc for point in points if point.temperature_degc is not None]
    if today is None or not known:
        return None, 0.0
    excess_k = max(min(known) - VALID_K - today, today - max(known) - VALID_K, 0.0)
    return (np.array(known) - today if len(known) == len(points) else None), excess_k


def _nearest(group: Sequence[Point], temperature: float | None) -> Point:
    """The one of a power-up that was measured most nearly at this temperature; the last where that is not known."""
    known = [point for point in reversed(group) if point.temperature_degc is not None]
    if temperature is None or not known:
        return group[-1]
    return min(known, key=lambda point: abs((point.temperature_degc or 0.0) - temperature))


def _of(point: Point, triad: Triad) -> Measured:
    found = point.of(triad)
    assert found is not None  # `believed` gives no others
    return found


def _here(
    points: Sequence[Point], found: Sequence[Measured], triad: Triad, now: Now, effect: PoseEffect
) -> tuple[Floats, Floats]:
    """The biases as they would be at today's attitude, and one sigma of what that adds; each (points, 3)."""
    bias = np.array([one.bias for one in found])
    pose = np.zeros_like(bias)
    if triad == "accel":
        up: Array = np.array(now.up)
        for k, point in enumerate(points):
            change, pose[k] = effect.change(now.gravity_m_s2, up, np.array(point.up))
            bias[k] += change
    return bias, pose


def _zeros(points: Sequence[Point], share: Floats, today: str | None) -> tuple[float, float]:
    """The share that was measured with today's zero, and one sigma of what the others add."""
    shares: dict[str | None, float] = {}
    sigmas: dict[str | None, float] = {}
    for point, part in zip(points, share, strict=True):
        shares[point.zero] = shares.get(point.zero, 0.0) + float(part)
        sigmas[point.zero] = point.zero_sigma_rad
    same = shares.pop(today, 0.0)
    return same, math.hypot(*(part * sigmas[zero] for zero, part in shares.items()), 0.0)
