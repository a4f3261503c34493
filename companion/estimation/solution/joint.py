"""Combination of predictions from earlier calibrations with today's readings of all IMUs (method.md section 3.3).

If an IMU warmed during the window, its estimate is first moved to the window's end. The curve over temperature predicts
the bias change from the mean to the end, and the slope of the readings measures it. Both are weighted by their
variances; if they contradict each other, only the readings count.

Then measurements and predictions are combined. With b the true biases, d those by today's readings, p the predictions,

    d = b + e_d     p = b + e_p     b_MAP = d + K (p - d)     K = cov(e_d, e_d - e_p) cov(e_d - e_p)^-1

The error of the gradienter's zero is the same in all IMUs. If earlier calibrations used today's zero, the error is also
in p and does not average out. If they used other zeros, several IMUs together determine today's tilt.

A sigma_use (stated sigma) that is too cautious would give the prior too much weight. For K, e_d therefore includes only
*known* noise. Known are the noise after averaging (sigma_stat), the gradienter's scatter, the platform's turn, and the
sigma of a zero that was measured or configured. With this smaller K, or any up to twice the optimum, the estimate is no
worse than without a prior. The result's covariance is for the K used, with the whole S_d = cov(e_d).
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Collection, Sequence
from typing import Final

import numpy as np

from companion.estimation.means.warming import NEXT_S
from companion.estimation.records.record import Prior, WhenWarm
from companion.estimation.solution.doubt import Witness, contradictions
from companion.estimation.solution.prior import Expectation, ExpectedImu
from companion.estimation.solution.solve import ImuSolution, Shared, Solution
from companion.estimation.turning.turn import CHANCE_SIGMAS, Turn
from companion.messages import message
from companion.physics.frames import vector
from companion.physics.units import DEG, UNITS
from companion.samples import TRIADS, Triad, Vector, rows_of

BOUNDS_RAD_S: Final = 0.1 * DEG
"""Largest sigma of a predicted gyro bias, rad/s, at which the prediction can bound the platform's turn."""
_CONTRADICTS: Final = 4.0  # Threshold in sigmas between the slope of the readings and that of the curve
_WORTH_SAYING: Final = 2.0  # Least bias change until warm that is reported, in sigma_use
_END_OF_RAMP: Final = 0.25
"""Ratio of variances: mean of some values, over the end of a line fitted to them (`RobustLine.end_leverage`)."""


def weigh(solution: Solution, expectation: Expectation) -> Solution:
    """Check a solution against predictions from earlier calibrations, and combine it with those that agree."""
    shared, by_name = solution.shared, {each.name: each for each in expectation.imus}
    expected = [by_name.get(imu.name) or ExpectedImu(name=imu.name) for imu in solution.imus]
    ends = [at_end(imu, known, shared) for imu, known in zip(solution.imus, expected, strict=True)]
    imus = tuple(_with_effect(imu, known, shared) for (imu, _), known in zip(ends, expected, strict=True))
    earlier, today = (_witnesses(imus, shared, expected, today=today) for today in (False, True))
    doubts = tuple(contradictions(earlier, today, len(imus), shared.up, shared.by_reading))
    solution = dataclasses.replace(solution, imus=imus, doubts=doubts)
    used = [one for one in earlier if one.may_weigh and (one.name, one.triad) not in solution.doubted]
    combined = _grounded(_combined(solution, used, zero_is_known=expectation.zero_is_known), earlier, today)
    final = []
    for k, (imu, (_, followed)) in enumerate(zip(combined.imus, ends, strict=True)):
        own = [doubt.words for doubt in doubts if not doubt.of_all and imu.name in doubt.names]
        prior = _prior([one for one in earlier if one.imu == k], used)
        imu = with_warm(imu, expected[k], followed)
        final.append(dataclasses.replace(imu, prior=prior, warnings=(*imu.warnings, *own)))
    common = [doubt.words for doubt in doubts if doubt.of_all]
    return dataclasses.replace(combined, imus=tuple(final), warnings=(*solution.warnings, *common))


# --- a window that warmed


def at_end(imu: ImuSolution, expected: ExpectedImu, shared: Shared) -> tuple[ImuSolution, tuple[Triad, ...]]:
    """Move one IMU's estimate to the end of its window; also return the triads for which a curve was used."""
    shift, stat, warm_up = np.zeros(6), imu.sigma_stat.copy(), imu.warm_up_variance.copy()
    covariance, followed = imu.covariance.copy(), list[Triad]()
    for triad, bias in zip(TRIADS, imu.biases, strict=True):
        along = expected.along.get(triad)
        if along is None or bias is None or imu.warming is None:
            continue
        rows, half_s, slope = rows_of(triad), imu.warming.half_s, np.array(along.slope)
        ramp, of_line = imu.warming.ramp[rows], imu.warming.variance[rows]
        of_slope = np.array(along.slope_variance)
        more = imu.warming.slope[rows] - slope
        if (np.abs(more) > _CONTRADICTS * np.sqrt(of_line + of_slope)).any():
            continue
        followed.append(triad)
        share = of_slope / (of_line + of_slope)
        bend = np.maximum(np.array(along.shift_variance) - half_s**2 * of_slope, 0.0)
        variance = half_s**2 * share * of_line + bend
        at = np.arange(6)[rows]
        shift[rows] = np.array(along.shift) + half_s * (share * more - ramp)
        covariance[at, at] = shared.covariance[at, at] + imu.warming.level_variance[rows] + variance
        stat[rows] = np.sqrt(np.square(stat[rows]) * np.where(ramp != 0.0, _END_OF_RAMP, 1.0) + variance)
        # The slope may continue after the window, or end now.
        warm_up[rows] = (np.square(slope + share * more) / 3.0 + share * of_line) * (NEXT_S / 2.0) ** 2
    moved = imu.shifted(shift)
    at_its_end = dataclasses.replace(moved, covariance=covariance, sigma_stat=stat, warm_up_variance=warm_up)
    return at_its_end, tuple(followed)


def with_warm(imu: ImuSolution, expected: ExpectedImu, followed: Collection[Triad]) -> ImuSolution:
    figures: dict[Triad, tuple[Vector, Vector]] = {}
    words, degc = [], 0.0
    for triad, now in zip(TRIADS, imu.whole, strict=True):
        along = expected.along.get(triad) if triad in followed else None
        if along is None or along.warm is None or now is None:
            continue
        degc, change, variance = along.warm.degc, np.array(along.warm.change), np.array(along.warm.variance)
        present = np.diag(imu.covariance)[rows_of(triad)]
        sigma = np.sqrt(present + variance)
        figures[triad] = vector(now + change), vector(sigma)
        worst = int(np.abs(change).argmax())
        if abs(change[worst]) > _WORTH_SAYING * np.sqrt(present[worst]):
            unit, name, digits = UNITS[triad]
            then, of_then = (now + change)[worst] / unit, sigma[worst] / unit
            cold = f"{triad} {imu.name} {'xyz'[worst]} now {now[worst] / unit:.{digits}f} {name}"
            warm = f"{then:.{digits}f} +- {of_then:.{digits}f}"
            words.append(message("bias_when_warm", now=cold, degc=f"{degc:.0f}", warm=warm))
    if "gyro" not in figures:
        return imu
    accel, of_accel = figures.get("accel", (None, None))
    when = WhenWarm(round(degc, 1), *figures["gyro"], accel, of_accel, tuple(words))
    return dataclasses.replace(imu, when_warm=when, drifting=tuple(words))


# --- predictions and measurements


def _with_effect(imu: ImuSolution, expected: ExpectedImu, shared: Shared) -> ImuSolution:
    effect = expected.effect
    if imu.accel_m_s2 is None or effect is None:
        return imu
    figures = shared.gravity_m_s2, shared.up, imu.accel_sigma_use_m_s2
    warning = effect.warning(imu.name, *figures)
    warnings = imu.warnings if warning is None else (*imu.warnings, warning)
    return dataclasses.replace(imu, effective=effect.effective(*figures), warnings=warnings)


def _witnesses(
    imus: Sequence[ImuSolution], shared: Shared, expected: Sequence[ExpectedImu], *, today: bool
) -> list[Witness]:
    found = []
    for triad, (k, imu) in itertools.product(TRIADS, enumerate(imus)):
        known = (expected[k].today if today else expected[k].earlier).get(triad)
        measured = imu.whole[TRIADS.index(triad)]
        if measured is None or known is None:
            continue
        part = rows_of(triad)
        common = shared.covariance[part, part]
        if triad == "accel":
            zero, other = shared.by_zero, shared.tilted(known.other_zero_rad)
            common = common + (np.square(1.0 - known.same_zero) - 1.0) * (zero @ zero.T) + other @ other.T
        own_variance = imu.own_variance(shared)[part] + np.array(known.variance)
        found.append(Witness(k, imu.name, triad, known, measured, own_variance, common))
    return found


def _combined(solution: Solution, used: Sequence[Witness], *, zero_is_known: bool) -> Solution:
    """Combine measured biases with the predictions `used`, by the equations at the top of this module."""
    shared, count = solution.shared, len(solution.imus)
    if not used:
        return solution
    index = np.concatenate([6 * one.imu + np.arange(6)[rows_of(one.triad)] for one in used])
    innovation = -np.concatenate([one.difference for one in used])
    parts = [slice(6 * k, 6 * k + 6) for k in range(count)]
    s_d = np.kron(np.ones((count, count)), shared.covariance)
    for imu, part in zip(solution.imus, parts, strict=True):
        s_d[part, part] = imu.covariance
    zero, none = shared.by_zero, np.zeros((3, 2))
    # Effect of the zero's error on each accelerometer: whole in d, and in p for the share measured with this zero.
    zero_in_d = np.tile(np.vstack([none, zero]), (count, 1))
    noise_in_d = np.tile(np.vstack([none, shared.tilted(np.array(shared.reading_sigma_rad))]), (count, 1))
    accels = [(one.triad == "accel", one.expected) for one in used]
    zero_in_p = np.vstack([zero * expected.same_zero if accel else none for accel, expected in accels])
    other_in_p = np.vstack([shared.tilted(expected.other_zero_rad) if accel else none for accel, expected in accels])
    s_p = np.diag(np.concatenate([one.expected.variance for one in used]))
    s_p = s_p + zero_in_p @ zero_in_p.T + other_in_p @ other_in_p.T
    both = zero_in_d @ zero_in_p.T
    of_difference = s_d[np.ix_(index, index)] + s_p - both[index] - both[index].T
    stat = np.concatenate([imu.sigma_stat for imu in solution.imus])
    known = np.diag(np.minimum(np.square(stat), np.diag(s_d))) + noise_in_d @ noise_in_d.T
    turn = np.zeros((6, 6))
    turn[:3, :3] = solution.turn.covariance(shared.up)
    sure = (known + np.kron(np.ones((count, count)), turn))[:, index]
    if zero_is_known:
        sure = sure + zero_in_d @ zero_in_d[index].T - both
    gain = np.linalg.solve(of_difference, sure.T).T
    rest = np.eye(6 * count)
    rest[:, index] -= gain
    mixed = rest @ both @ gain.T
    covariance = rest @ s_d @ rest.T + gain @ s_p @ gain.T + mixed + mixed.T
    stat = np.sqrt(np.diag(rest @ np.diag(np.square(stat)) @ rest.T + gain @ s_p @ gain.T))
    stat = np.minimum(stat, np.sqrt(np.diag(covariance)))
    shift = gain @ innovation
    imus = tuple(
        dataclasses.replace(imu.shifted(shift[part]), covariance=covariance[part, part], sigma_stat=stat[part])
        for imu, part in zip(solution.imus, parts, strict=True)
    )
    return dataclasses.replace(solution, imus=imus)


def _grounded(solution: Solution, earlier: Sequence[Witness], today: Sequence[Witness]) -> Solution:
    """Bound the platform's turn by predicted gyro biases, unless a compass or an earlier rest has measured it.

    A rate about the vertical counts as chance up to `CHANCE_SIGMAS`; a larger one is added to sigma. Only earlier
    power-ups can show that nothing turns, because today's measurements may include the turn already.
    """
    if solution.turn.is_told or solution.platform == "deck":
        return solution
    up, more_rad_s = solution.shared.up, 0.0
    for known in (earlier, today):
        found = [one.along(up) for one in known if one.triad == "gyro"]
        rate, sigma = min(found, key=lambda each: each[1], default=(0.0, math.inf))
        if abs(rate) > CHANCE_SIGMAS * sigma:
            more_rad_s = max(more_rad_s, abs(rate))
        if known is earlier and sigma < BOUNDS_RAD_S:
            turn = Turn(rate_rad_s=-rate, sigma_rad_s=sigma, by="earlier calibrations")
            solution = dataclasses.replace(solution, turn=turn)
    by_turn = np.zeros((6, 6))
    by_turn[:3, :3] = np.outer(up, up) * more_rad_s**2
    return dataclasses.replace(
        solution,
        shared=dataclasses.replace(solution.shared, covariance=solution.shared.covariance + by_turn),
        imus=tuple(dataclasses.replace(imu, covariance=imu.covariance + by_turn) for imu in solution.imus),
    )


def _prior(known: Sequence[Witness], used: Sequence[Witness]) -> Prior | None:
    found: Prior = dict.fromkeys(TRIADS)
    for one in known:
        expected, unit = one.expected, "rad_s" if one.triad == "gyro" else "m_s2"
        found[one.triad] = {
            "used": one in used,
            "power_ups": expected.power_ups,
            "temperature_model": expected.by_temperature,
            f"expected_{unit}": list(expected.value),
            f"sigma_{unit}": np.sqrt(expected.variance).tolist(),
            f"measured_{unit}": one.measured.tolist(),
            "shift_sigma": (one.difference / one.sigma).tolist(),
        }
    return found if known else None
