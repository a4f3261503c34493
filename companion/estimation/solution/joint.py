"""What is known from before, and today's readings of all IMUs, as one estimate (method 3.3).

With d the biases by today's readings and p those expected, all IMUs together,

    d = b + e_d     p = b + e_p     b_MAP = d + K (p - d)     K = cov(e_d, e_d - e_p) cov(e_d - e_p)^-1

which for independent errors is (S_d^-1 + S_0^-1)^-1 (S_d^-1 d + S_0^-1 p). They are not independent: the error of the
gradienter's zero is the same in all IMUs, and where the earlier calibrations were made with today's zero, in p as
well, so that nothing averages it away. Where they were made with other zeros, several IMUs together tell today's tilt.

A sigma_use that is too cautious would hand the estimate to the prior. So K counts as e_d only what is *known* to be
noise: what averaging has left (sigma_stat), the gradienter's scatter, what is not known of the platform's turn, and
the sigma of the zero if somebody vouches for it. K is then smaller than the best one, and with any K between zero and
twice that the estimate is no worse than without a prior. The covariance is that of the K used, with the whole S_d.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from companion.estimation.records.history import Measured, Point, PowerUp
from companion.estimation.records.record import AccelPrior, GyroPrior, Prior
from companion.estimation.solution.at_end import Pair, at_end, foretold
from companion.estimation.solution.doubt import Doubt, Witness, doubts
from companion.estimation.solution.prior import Expectation, Expected, ExpectedImu
from companion.estimation.solution.solve import ImuSolution, Shared, Solution
from companion.estimation.turning.watch import CHANCE_SIGMAS, Turn
from companion.physics.frames import Array, Matrix, vector
from companion.physics.units import DEG
from companion.samples import TRIADS, Triad, Vector, rows_of

Whole = Mapping[str, Pair]
"""By IMU: whole gyro and accelerometer bias by the readings alone, (3,) each, vehicle FRD."""

AGREES: Final = 11.34
"""Chi square of three axes that is passed by chance once in a hundred: beyond it nobody is warned yet, but what may
well be of another sensor takes no part."""
BOUNDS_RAD_S: Final = 0.1 * DEG
"""One sigma; what is known worse than that (no thermometer, say) says nothing of a turn."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Weighed:
    """A solution with what was known before."""

    solution: Solution
    doubts: tuple[Doubt, ...]

    @property
    def doubted(self) -> dict[tuple[str, Triad], Doubt]:
        """By IMU and triad, what speaks against it; a tilt or a turn is in all, whether each shows it or not."""
        return {
            (name, doubt.triad): doubt
            for doubt in reversed(self.doubts)
            for name in ([imu.name for imu in self.solution.imus] if doubt.of_all else doubt.names)
        }


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class _Known:
    """One triad that something is expected of."""

    imu: int
    triad: Triad
    expected: Expected
    measured: Array
    witness: Witness

    @property
    def rows(self) -> slice:
        start = 6 * self.imu + rows_of(self.triad).start
        return slice(start, start + 3)


def weigh(solution: Solution, whole: Whole, expectation: Expectation) -> Weighed:
    """Take in what was known from before: guard against it, and let it take part where it may."""
    expected = {each.name: each for each in expectation.imus}
    solution, whole, followed = _at_end(solution, whole, expected)
    solution = dataclasses.replace(
        solution, imus=tuple(_with_effect(imu, expected.get(imu.name), solution.shared) for imu in solution.imus)
    )
    known, of_today = (_known(solution, whole, expected, today=today) for today in (False, True))
    found = Weighed(solution, tuple(_doubts(solution, known, of_today)))
    used = [
        one
        for one in known
        if one.expected.weighs and (one.witness.name, one.triad) not in found.doubted and _agrees(one.witness)
    ]
    weighed = _estimate(solution, used, zero_is_known=expectation.zero_is_known) if used else solution
    weighed = _grounded(weighed, known, of_today)
    imus = []
    for k, imu in enumerate(weighed.imus):
        own = [doubt.words for doubt in found.doubts if not doubt.of_all and imu.name in doubt.names]
        prior = _prior([one for one in known if one.imu == k], used)
        if imu.name in whole:
            imu = foretold(
                imu, _shifted_by(whole[imu.name], solution.imus[k], imu), expected.get(imu.name), followed[k]
            )
        imus.append(dataclasses.replace(imu, prior=prior, warnings=(*imu.warnings, *own)))
    common = [doubt.words for doubt in found.doubts if doubt.of_all]
    weighed = dataclasses.replace(weighed, imus=tuple(imus), warnings=(*solution.warnings, *common))
    return Weighed(weighed, found.doubts)


def _at_end(
    solution: Solution, whole: Whole, expected: Mapping[str, ExpectedImu]
) -> tuple[Solution, Whole, list[tuple[Triad, ...]]]:
    """Where the temperature changed: the same at the end of the window; and of which triads of each."""
    imus, moved, followed = [], dict(whole), []
    for imu in solution.imus:
        of: tuple[Triad, ...] = ()
        if imu.name in whole and imu.name in expected:
            imu, moved[imu.name], of = at_end(imu, whole[imu.name], expected[imu.name], solution.shared)
        imus.append(imu)
        followed.append(of)
    return dataclasses.replace(solution, imus=tuple(imus)), moved, followed


def _shifted_by(whole: Pair, before: ImuSolution, after: ImuSolution) -> Pair:
    """Whole biases with what an estimate has become."""
    pairs = (before.gyro_rad_s, after.gyro_rad_s), (before.accel_m_s2, after.accel_m_s2)
    gyro, accel = (
        None if bias is None or one is None or other is None else bias + other - one
        for bias, (one, other) in zip(whole, pairs, strict=True)
    )
    return gyro, accel


def _doubts(solution: Solution, earlier: Sequence[_Known], of_today: Sequence[_Known]) -> list[Doubt]:
    """What contradicts what was known."""
    found: list[Doubt] = []
    for triad in TRIADS:
        # What was measured in this power-up says most; where it is content, nothing older has to be asked.
        for known, today in ((of_today, True), (earlier, False)):
            witnesses = [one.witness for one in known if one.triad == triad]
            said = doubts(triad, witnesses, solution.shared.up, solution.shared.by_reading, today=today)
            if said or (today and len(witnesses) == len(solution.imus)):
                found += said
                break
    return found


def _grounded(solution: Solution, earlier: Sequence[_Known], today: Sequence[_Known]) -> Solution:
    """Where neither a compass nor a rest has told how fast the platform turns, what is known of the gyros bounds it.

    What they read more about the vertical is taken for chance up to `CHANCE_SIGMAS`, and else belongs to sigma. Only
    earlier power-ups tell that nothing turns: what was measured today may have turned already.
    """
    if solution.turn.is_told or solution.platform == "deck":
        return solution
    up, more_rad_s = solution.shared.up, 0.0
    for known in (earlier, today):
        found = [_about(up, one.witness) for one in known if one.triad == "gyro"]
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
        cross={pair: matrix + by_turn for pair, matrix in solution.cross.items()},
    )


def _about(up: Array, witness: Witness) -> tuple[float, float]:
    """By how much it reads more about the vertical than expected, and one sigma of that."""
    variance = np.square(up) @ witness.own_variance + up @ witness.common @ up
    return float(up @ witness.difference), math.sqrt(variance)


def points(
    solution: Solution,
    whole: Whole,
    found: Iterable[Doubt],
    *,
    started_at: str,
    unix_s: float,
    power_ups: Mapping[str, PowerUp],
    zero: str | None,
) -> dict[str, Point]:
    """By IMU, what later calibrations may know of this one."""
    shared = solution.shared
    doubted = {(doubt.triad, name) for doubt in found for name in doubt.names}
    by_zero = _by_reading(shared) * shared.zero_sigma_rad
    common = np.diag(shared.covariance).copy()
    common[3:] = np.maximum(common[3:] - np.diag(by_zero @ by_zero.T), 0.0)

    def measured(imu: ImuSolution, triad: Triad) -> Measured | None:
        bias = whole[imu.name][TRIADS.index(triad)]
        if bias is None:
            return None
        part = rows_of(triad)
        return Measured(
            bias=_short(bias if imu.warming is None else bias - imu.warming.ahead(triad)),
            sigma_stat=_short(imu.sigma_stat[part]),
            sigma_use=_short(np.sqrt(_own_variance(imu, shared)[part])),
            sigma_shared=_short(np.sqrt(common[part])),
            suspect=(triad, imu.name) in doubted,
        )

    return {
        imu.name: Point(
            started_at=started_at,
            unix_s=unix_s,
            power_up=power_ups[imu.name],
            temperature_degc=imu.mean_degc,
            k_s=imu.k_s,
            up=_short(shared.up),
            zero=zero if whole[imu.name][1] is not None else None,
            zero_sigma_rad=shared.zero_sigma_rad,
            gyro=measured(imu, "gyro"),
            accel=measured(imu, "accel"),
        )
        for imu in solution.imus
        if imu.name in whole
    }


def _short(values: Array) -> Vector:
    """In as many digits as are worth keeping: 9 decimals are 2e-4 deg/h."""
    return vector(np.round(values, 9))


def _with_effect(imu: ImuSolution, expected: ExpectedImu | None, shared: Shared) -> ImuSolution:
    """What the accelerometers' bias is worth at another attitude."""
    effect = expected.effect if expected is not None else None
    if imu.accel_m_s2 is None or effect is None:
        return imu
    warning = effect.warning(imu.name, shared.gravity_m_s2, shared.up, imu.accel_sigma_use_m_s2)
    return dataclasses.replace(
        imu,
        effective=effect.effective(shared.gravity_m_s2, shared.up, imu.accel_sigma_use_m_s2),
        warnings=imu.warnings if warning is None else (*imu.warnings, warning),
    )


def _known(solution: Solution, whole: Whole, expected: Mapping[str, ExpectedImu], *, today: bool) -> list[_Known]:
    found: list[_Known] = []
    for triad, (k, imu) in itertools.product(TRIADS, enumerate(solution.imus)):
        said, measured = expected.get(imu.name), whole[imu.name][TRIADS.index(triad)] if imu.name in whole else None
        known = None if said is None else (said.today if today else said.earlier).get(triad)
        if measured is not None and known is not None:
            witness = _witness(imu, solution.shared, triad, known, measured)
            found.append(_Known(k, triad, known, measured, witness))
    return found


def _agrees(witness: Witness) -> bool:
    covariance = np.diag(witness.own_variance) + witness.common
    return float(witness.difference @ np.linalg.solve(covariance, witness.difference)) < AGREES


def _own_variance(imu: ImuSolution, shared: Shared) -> Array:
    """Of the sensor alone, (6,)."""
    return np.maximum(np.diag(imu.covariance) - np.diag(shared.covariance), 0.0)


def _by_reading(shared: Shared) -> Matrix:
    return np.zeros((3, 2)) if shared.by_reading is None else shared.by_reading


def _witness(imu: ImuSolution, shared: Shared, triad: Triad, expected: Expected, measured: Array) -> Witness:
    part = rows_of(triad)
    common = shared.covariance[part, part]
    if triad == "accel":
        by_reading = _by_reading(shared)
        zero, other = by_reading * shared.zero_sigma_rad, by_reading * expected.other_zero_rad
        common = common + (np.square(1.0 - expected.same_zero) - 1.0) * (zero @ zero.T) + other @ other.T
    return Witness(
        name=imu.name,
        difference=measured - np.array(expected.value),
        own_variance=_own_variance(imu, shared)[part] + np.array(expected.variance),
        common=common,
        limit=expected.limit,
        power_ups=expected.power_ups,
        same_zero=expected.same_zero > 0.5,
    )


def _whole_covariance(solution: Solution) -> Matrix:
    """Of all biases of all IMUs, (6 n, 6 n)."""
    blocks = {(imu.name, imu.name): imu.covariance for imu in solution.imus} | dict(solution.cross)
    blocks |= {(other, one): matrix.T for (one, other), matrix in solution.cross.items()}
    return np.block([[blocks[one.name, other.name] for other in solution.imus] for one in solution.imus])


def _estimate(solution: Solution, used: Sequence[_Known], *, zero_is_known: bool) -> Solution:
    """The solution with what may take part; see the equations at the top."""
    shared, count = solution.shared, len(solution.imus)
    index = np.concatenate([np.arange(one.rows.start, one.rows.stop) for one in used])
    innovation = -np.concatenate([one.witness.difference for one in used])
    s_d = _whole_covariance(solution)
    by_reading, none = _by_reading(shared), np.zeros((3, 2))
    zero = by_reading * shared.zero_sigma_rad
    # Every accelerometer's share of the zero's error: in d it is whole, in p as far as that was measured with it.
    zero_in_d = np.tile(np.vstack([none, zero]), (count, 1))
    noise_in_d = np.tile(np.vstack([none, by_reading * np.array(shared.reading_sigma_rad)]), (count, 1))
    zero_in_p = np.vstack([zero * one.expected.same_zero if one.triad == "accel" else none for one in used])
    other_in_p = np.vstack([by_reading * one.expected.other_zero_rad if one.triad == "accel" else none for one in used])
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
    stat_covariance = rest @ np.diag(np.square(stat)) @ rest.T + gain @ s_p @ gain.T
    shift = gain @ innovation
    part = {imu.name: slice(6 * k, 6 * k + 6) for k, imu in enumerate(solution.imus)}
    stat = np.sqrt(np.diag(stat_covariance))
    imus = tuple(
        _shifted(imu, shift[at], covariance[at, at], stat[at])
        for imu, at in zip(solution.imus, part.values(), strict=True)
    )
    cross = {(one, other): covariance[part[one], part[other]] for one, other in itertools.combinations(part, 2)}
    return dataclasses.replace(solution, imus=imus, cross=cross)


def _shifted(imu: ImuSolution, shift: Array, covariance: Matrix, stat: Array) -> ImuSolution:
    return dataclasses.replace(
        imu,
        gyro_rad_s=None if imu.gyro_rad_s is None else imu.gyro_rad_s + shift[:3],
        accel_m_s2=None if imu.accel_m_s2 is None else imu.accel_m_s2 + shift[3:],
        covariance=covariance,
        sigma_stat=np.minimum(stat, np.sqrt(np.diag(covariance))),
    )


def _prior(known: Sequence[_Known], used: Sequence[_Known]) -> Prior | None:
    """What the record says of what was known of one IMU."""
    found: dict[Triad, GyroPrior | AccelPrior] = {}
    for one in known:
        witness, expected = one.witness, one.expected
        kind, unit = (GyroPrior, "rad_s") if one.triad == "gyro" else (AccelPrior, "m_s2")
        figures: dict[str, Any] = {
            f"expected_{unit}": expected.value,
            f"sigma_{unit}": vector(np.sqrt(np.array(expected.variance))),
            f"measured_{unit}": vector(one.measured),
            "shift_sigma": vector(witness.difference / witness.sigma),
        }
        by_temperature = expected.by_temperature
        found[one.triad] = kind(
            used=one in used, power_ups=expected.power_ups, temperature_model=by_temperature, **figures
        )
    return Prior(**{triad: found.get(triad) for triad in TRIADS}) if found else None  # type: ignore[arg-type]
