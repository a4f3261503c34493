"""Biases at the end of a window that warmed, by the curve over temperature, and what they will be when warm.

The mean over a window is that of its mean temperature. The curve says how the bias has gone from there to the end, the
readings' own slope says so too, and each by its variance has its share. Where they contradict each other the window
alone counts: its mean, or the end of its ramp.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import Final

import numpy as np

from companion.estimation.means.warming import NEXT_S
from companion.estimation.records.record import WhenWarm
from companion.estimation.solution.prior import ExpectedImu
from companion.estimation.solution.solve import ImuSolution, Shared
from companion.estimation.temperature.along import Along
from companion.physics.frames import Array, vector
from companion.physics.units import UNITS
from companion.samples import TRIADS, Triad, rows_of

_CONTRADICTS: Final = 4.0
"""Sigmas between the slope of the readings and that of the curve."""
_WORTH_SAYING: Final = 2.0
"""Of sigma_use: by so much it will move."""
_OF_END: Final = 0.25
"""Variance of a mean over that of the end of a line through the same values (`robust.Line.end_leverage`)."""

Pair = tuple[Array | None, Array | None]


def at_end(
    imu: ImuSolution, whole: Pair, expected: ExpectedImu, shared: Shared
) -> tuple[ImuSolution, Pair, tuple[Triad, ...]]:
    """The same at the end of the window, and of which triads; `whole` are its whole biases."""
    found: list[Array | None] = [imu.gyro_rad_s, imu.accel_m_s2]
    moved, covariance = list(whole), imu.covariance.copy()
    warm_up = imu.warm_up_variance.copy()
    stat = imu.sigma_stat.copy()
    followed: list[Triad] = []
    for k, triad in enumerate(TRIADS):
        along, bias = expected.along.get(triad), found[k]
        end = None if along is None or bias is None else _end(imu, triad, along)
        if end is None or bias is None:
            continue
        shift, variance, level_variance, slope_variance, ramps = end
        at = np.arange(6)[rows_of(triad)]
        found[k] = bias + shift
        before = moved[k]
        moved[k] = None if before is None else before + shift
        covariance[at, at] = shared.covariance[at, at] + level_variance + variance
        stat[at] = np.sqrt(np.square(stat[at]) * np.where(ramps, _OF_END, 1.0) + variance)
        warm_up[at] = slope_variance * (NEXT_S / 2.0) ** 2
        followed.append(triad)
    same = dataclasses.replace(
        imu,
        gyro_rad_s=found[0],
        accel_m_s2=found[1],
        covariance=covariance,
        sigma_stat=stat,
        warm_up_variance=warm_up,
    )
    return same, (moved[0], moved[1]), tuple(followed)


def _end(imu: ImuSolution, triad: Triad, along: Along) -> tuple[Array, Array, Array, Array, Array] | None:
    """What is added to the bias, its variance, that of the mean, what the slope may yet do, and what was a ramp."""
    if imu.warming is None:
        return None
    lines = imu.warming.of(triad)
    half_s, slope, ramp = imu.warming.half_s, np.array(along.slope), lines.ramp
    of_line, of_slope = lines.variance, np.array(along.slope_variance)
    more = lines.slope - slope
    if (np.abs(more) > _CONTRADICTS * np.sqrt(of_line + of_slope)).any():
        return None
    share = of_slope / (of_line + of_slope)
    shift = np.array(along.shift) + half_s * (share * more - ramp)
    bend = np.maximum(np.array(along.shift_variance) - half_s**2 * of_slope, 0.0)
    # It may go on, or end now.
    goes_on = np.square(slope + share * more) / 3.0 + share * of_line
    return shift, half_s**2 * share * of_line + bend, lines.level_variance, goes_on, ramp != 0.0


def foretold(imu: ImuSolution, whole: Pair, expected: ExpectedImu | None, followed: Collection[Triad]) -> ImuSolution:
    """With what its biases, now `whole`, will be when it is warm, where that is known."""
    figures: dict[Triad, tuple[Array, Array]] = {}
    words, degc = [], 0.0
    for triad, now in zip(TRIADS, whole, strict=True):
        along = None if expected is None or triad not in followed else expected.along.get(triad)
        warm = None if along is None else along.warm
        if warm is None or now is None:
            continue
        change, degc = np.array(warm.change), warm.degc
        sigma = np.sqrt(np.diag(imu.covariance)[rows_of(triad)] + np.array(warm.variance))
        figures[triad] = now + change, sigma
        worst = int(np.abs(change).argmax())
        if abs(change[worst]) > _WORTH_SAYING * np.sqrt(np.diag(imu.covariance)[rows_of(triad)])[worst]:
            unit, name, digits = UNITS[triad]
            then, of_then = (now + change)[worst] / unit, sigma[worst] / unit
            words.append(
                f"{triad} {imu.name} {'xyz'[worst]} now {now[worst] / unit:.{digits}f} {name},"
                f" at {degc:.0f} degC {then:.{digits}f} +- {of_then:.{digits}f}"
            )
    if "gyro" not in figures:
        return imu
    when = WhenWarm(
        degc=round(degc, 1),
        gyro_bias_rad_s=vector(figures["gyro"][0]),
        gyro_sigma_rad_s=vector(figures["gyro"][1]),
        accel_bias_m_s2=vector(figures["accel"][0]) if "accel" in figures else None,
        accel_sigma_m_s2=vector(figures["accel"][1]) if "accel" in figures else None,
        words=tuple(words),
    )
    return dataclasses.replace(imu, when_warm=when, drifting=tuple(words))
