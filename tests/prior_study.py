"""Gain and loss from earlier calibrations, over many simulated histories: python -m tests.prior_study.

Each trial draws a sensor with its run-to-run law, some earlier power-ups, and today; and compares the error of
today's bias with and without what was known from before. The draws and the truth are this module's own.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.config.sections import AllanModel
from companion.estimation.records.history import MeasuredBias, Point, PowerUp
from companion.estimation.records.record import Pose, PoseSigma, SiteRecord
from companion.estimation.solution.joint import weigh
from companion.estimation.solution.prior import Expectation, ExpectedImu, PoseEffect, expect, pose_effect
from companion.estimation.solution.solve import ImuSolution, Shared, Solution
from companion.samples import TRIADS

Array = NDArray[np.float64]
DEG = np.pi / 180.0
DEG_H = DEG / 3600.0
MG = 9.80665e-3
G = 9.8
LEVEL = np.array([0.0, 0.0, -1.0])
STEADY = AllanModel(0.0, 1e-9, 0.0)
"""Biases that do not wander within a power-up."""
# Right side down lowers the right side's share of gravity, nose up raises the front's; FRD, level, method 2.1.
BY_READING = -G * np.array([[0.0, 1.0], [-1.0, 0.0], [0.0, 0.0]])
_POSE = Pose(theta_deg=0.0, gamma_deg=0.0, psi_deg=0.0, sigma_deg=PoseSigma(theta=None, gamma=None, psi=None))
_SITE = SiteRecord(latitude_deg=40.0, height_m=0.0, gravity_m_s2=G, declination_deg=None, source="study")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Case:
    """One law of nature, and what the companion believes of it. Gyro figures in deg/h, accelerometers in mg."""

    name: str
    scatter: float
    """Run to run, one sigma an axis."""
    stat: float
    use: float
    """True sigma of a calibration as an estimate of the next minutes; `stat` is part of it."""
    claimed_use: float | None = None
    """Wander that the companion assumes, where its profile is too cautious."""
    power_ups: int = 10
    triad: str = "gyro"
    slope_per_k: float = 0.0
    temperatures: tuple[float, float] = (25.0, 25.0)
    today_degc: float | None = None
    jump: float = 0.0
    """Another sensor is there today: its mean differs by this, one sigma an axis."""
    ageing: float = 0.0
    """The mean walks by this from one power-up to the next."""
    uniform_stat: bool = False
    """`stat` is half a step of integers that tell nothing: the error lies anywhere within."""
    imus: int = 1
    zero_deg: float = 0.0
    """Sigma of the gradienter's zero in force today."""
    earlier_zero_deg: float | None = None
    """Zero of another gradienter used for all earlier calibrations; None: today's."""

    @property
    def unit(self) -> float:
        return DEG_H if self.triad == "gyro" else MG


@dataclasses.dataclass(frozen=True)
class StudyOutcome:
    rms_without: float
    rms_with: float
    coverage: float
    """Coverage of 2 sigma with earlier calibrations."""
    used: float
    """Share of the trials in which it took part in the estimate."""
    doubted: float
    """Share of the trials in which something contradicted."""
    foretold_rms: float
    """Rms error of the prediction before any measurement."""
    foretold_coverage: float
    """Coverage of 2 sigma of the prediction."""
    foretold_sigma: float = np.nan
    """Claimed sigma, root mean square."""

    @property
    def ratio(self) -> float:
        return self.rms_with / self.rms_without


def imu_solution(name: str, gyro: Array, accel: Array, stat: Array, covariance: Array) -> ImuSolution:
    """Solution from the readings alone; `stat` (6,), `covariance` (6, 6)."""
    return ImuSolution(
        name=name,
        samples=1000,
        temperature_degc=None,
        gyro_rad_s=gyro,
        accel_m_s2=accel,
        sigma_stat=stat,
        covariance=covariance,
        warnings=(),
    )


def solution(imus: Sequence[ImuSolution], shared: Shared) -> Solution:
    return Solution(pose=_POSE, site=_SITE, imus=tuple(imus), warnings=(), unknown=(), magnetic=None, shared=shared)


def shared_errors(zero_sigma_rad: float, noise_rad: float = 0.0, gravity_sigma: float = 0.0) -> Shared:
    """A level aircraft with this gradienter."""
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = BY_READING @ BY_READING.T * (zero_sigma_rad**2 + noise_rad**2)
    covariance[5, 5] += gravity_sigma**2
    return Shared(
        up=LEVEL,
        gravity_m_s2=G,
        covariance=covariance,
        by_reading=BY_READING,
        reading_sigma_rad=(noise_rad, noise_rad),
        zero_sigma_rad=zero_sigma_rad,
    )


def axes(values: Array) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z


def one_trial(
    case: Case, random: np.random.Generator, effect: PoseEffect
) -> tuple[Array, Array, Array, Array, Solution]:
    """Errors without and with what was known, the sigmas claimed with it, and errors of what was expected by its sigma.

    Each (imus, 3), the errors in the case's unit.
    """
    unit = case.unit
    floor = np.sqrt(case.use**2 - case.stat**2)
    claimed = case.claimed_use or case.use
    zero = random.normal(0.0, case.zero_deg * DEG, 2)
    earlier_sigma = case.zero_deg if case.earlier_zero_deg is None else case.earlier_zero_deg
    earlier = zero if case.earlier_zero_deg is None else random.normal(0.0, earlier_sigma * DEG, 2)
    today_degc = case.today_degc if case.today_degc is not None else float(random.uniform(*case.temperatures))
    temperatures = random.uniform(*case.temperatures, case.power_ups)
    stat = np.full(6, case.stat * unit)
    shared = shared_errors(case.zero_deg * DEG)
    found, expected, truths = [], [], []
    for k in range(case.imus):
        mean = random.normal(0.0, 300.0, 3) if case.triad == "gyro" else random.normal(0.0, 10.0, 3)
        slope = random.normal(0.0, case.slope_per_k, 3)

        def measured(truth: Array, of_zero: Array) -> Array:
            draw = random.uniform(-1.0, 1.0, 3) if case.uniform_stat else random.normal(0.0, 1.0, 3)
            tilt = BY_READING @ of_zero / MG if case.triad == "accel" else np.zeros(3)
            return np.asarray(truth + case.stat * draw + random.normal(0.0, floor, 3) + tilt)

        points = []
        for r in range(case.power_ups):
            mean = mean + random.normal(0.0, case.ageing, 3)
            bias = mean + random.normal(0.0, case.scatter, 3) + slope * (temperatures[r] - 25.0)
            one = MeasuredBias(
                bias=axes(measured(bias, earlier) * unit),
                sigma_stat=axes(stat[:3]),
                sigma_use=axes(np.full(3, claimed * unit)),
                sigma_shared=(0.0, 0.0, 0.0),
            )
            points.append(
                Point(
                    started_at=str(r),
                    unix_s=86400.0 * r,
                    power_up=PowerUp(host=str(r), since_unix_s=None),
                    temperature_degc=float(temperatures[r]),
                    up=axes(LEVEL),
                    zero="today's" if case.earlier_zero_deg is None else "another",
                    zero_sigma_rad=earlier_sigma * DEG,
                    gyro=one if case.triad == "gyro" else None,
                    accel=one if case.triad == "accel" else None,
                )
            )
        mean = mean + random.normal(0.0, case.ageing, 3) + random.normal(0.0, 1.0, 3) * case.jump
        truth = mean + random.normal(0.0, case.scatter, 3) + slope * (today_degc - 25.0)
        truths.append(truth)
        reading = measured(truth, zero) * unit
        covariance = shared.covariance + np.diag(np.full(6, (claimed * unit) ** 2))
        gyro, accel = (reading, np.zeros(3)) if case.triad == "gyro" else (np.zeros(3), reading)
        found.append(imu_solution(f"imu{k}", gyro, accel, stat, covariance))
        now = Point(
            started_at="",
            unix_s=86400.0 * case.power_ups,
            power_up=PowerUp(host="today", since_unix_s=None),
            temperature_degc=today_degc,
            up=axes(LEVEL),
            zero="today's",
        )
        expected.append(
            ExpectedImu(
                name=f"imu{k}",
                earlier={triad: expect(points, triad, now, effect, STEADY) for triad in TRIADS},
                effect=effect,
            )
        )
    expectation = Expectation(imus=tuple(expected), zero_is_known=True)
    weighed = weigh(solution(found, shared), expectation)
    part = slice(0, 3) if case.triad == "gyro" else slice(3, 6)

    def of(imus: Sequence[ImuSolution]) -> Array:
        return np.array([imu.gyro_rad_s if case.triad == "gyro" else imu.accel_m_s2 for imu in imus]) / unit

    sigma = np.array([np.sqrt(np.diag(imu.covariance)[part]) for imu in weighed.imus]) / unit
    truth = np.array(truths)
    known = [each.earlier["gyro" if case.triad == "gyro" else "accel"] for each in expected]
    nothing = np.full(3, np.nan)
    foretold = np.array([nothing if one is None else np.array(one.value) / unit for one in known]) - truth
    said_by = np.array([nothing if one is None else np.sqrt(one.variance) / unit for one in known])
    return of(found) - truth, of(weighed.imus) - truth, sigma, np.array([foretold, said_by]), weighed


def study(case: Case, trials: int, seed: int = 1) -> StudyOutcome:
    random, effect = np.random.default_rng(seed), pose_effect(None)
    without, having, sigmas, ahead, used, doubted = [], [], [], [], 0, 0
    for _ in range(trials):
        before, after, sigma, foretold, weighed = one_trial(case, random, effect)
        ahead.append(foretold)
        without.append(before)
        having.append(after)
        sigmas.append(sigma)
        priors = [imu.prior for imu in weighed.imus]
        used += any(one["used"] for prior in priors if prior for one in prior.values() if one)
        doubted += bool(weighed.doubts)
    errors = np.array(having)
    foretold, said_by = np.moveaxis(np.array(ahead), 1, 0)
    told = np.isfinite(foretold)
    foretold, said_by = (each[told] if told.any() else np.array([np.nan]) for each in (foretold, said_by))
    return StudyOutcome(
        rms_without=float(np.sqrt(np.mean(np.square(without)))),
        rms_with=float(np.sqrt(np.mean(np.square(errors)))),
        coverage=float(np.mean(np.abs(errors) <= 2.0 * np.array(sigmas))),
        used=used / trials,
        doubted=doubted / trials,
        foretold_rms=float(np.sqrt(np.mean(np.square(foretold)))),
        foretold_coverage=float(np.mean(np.abs(foretold) <= 2.0 * said_by)),
        foretold_sigma=float(np.sqrt(np.mean(np.square(said_by)))),
    )


GOOD: dict[str, Any] = {"stat": 1.6, "use": 5.0}
"""A good gyro after 30 s (method 2.2: ICM-42688-P)."""
OLD: dict[str, Any] = {"stat": 47.0, "use": 63.0}
"""An ADIS16405 after 10 s (likewise)."""
CASES = (
    *(Case(name=f"good gyro, scatter {s:g}", scatter=s, **GOOD) for s in (70.0, 10.0, 2.0, 0.0)),
    *(
        Case(name=f"old gyro, scatter {s:g}, {m} power-ups", scatter=s, power_ups=m, **OLD)
        for s in (70.0, 20.0, 5.0, 0.0)
        for m in (5, 10, 30)
    ),
    *(
        Case(name=f"good gyro taken for a bad one, scatter {s:g}", scatter=s, claimed_use=50.0, power_ups=m, **GOOD)
        for s, m in ((70.0, 5), (70.0, 20), (10.0, 20))
    ),
    Case(name="integers that tell nothing, scatter 70", scatter=70.0, stat=103.0, use=103.01, uniform_stat=True),
    Case(name="integers that tell nothing, scatter 20", scatter=20.0, stat=103.0, use=103.01, uniform_stat=True),
    Case(name="18 deg/h/K, 10 to 35 degC", scatter=20.0, slope_per_k=18.0, temperatures=(10.0, 35.0), **OLD),
    Case(name="18 deg/h/K, 5 power-ups", scatter=5.0, slope_per_k=18.0, temperatures=(15.0, 25.0), power_ups=5, **OLD),
    Case(
        name="18 deg/h/K, today at -5 degC",
        scatter=20.0,
        slope_per_k=18.0,
        temperatures=(10.0, 35.0),
        today_degc=-5.0,
        **OLD,
    ),
    Case(name="another good gyro today", scatter=70.0, jump=1800.0, **GOOD),
    Case(name="another old gyro today", scatter=20.0, jump=1800.0, **OLD),
    Case(name="another old gyro, a little", scatter=20.0, jump=200.0, power_ups=20, **OLD),
    Case(name="old gyro that ages", scatter=20.0, ageing=20.0, power_ups=20, **OLD),
    Case(name="accel, scatter 2, one zero of 0.05", triad="accel", scatter=2.0, stat=0.02, use=0.05, zero_deg=0.05),
    Case(name="accel, scatter 0.2, one zero of 0.05", triad="accel", scatter=0.2, stat=0.02, use=0.05, zero_deg=0.05),
    *(
        Case(
            name=f"{n} accels, scatter {s:g}, zero 0.1 after one of 0.013",
            triad="accel",
            scatter=s,
            stat=0.02,
            use=0.05,
            zero_deg=0.1,
            earlier_zero_deg=0.0133,
            imus=n,
        )
        for s in (2.0, 0.5)
        for n in (1, 2, 3)
    ),
)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.prior_study", description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    print(
        f"{'':56} {'without':>8} {'with':>8} {'ratio':>6} {'2 sigma':>8} {'used':>6} {'doubted':>8}"
        f" {'foretold':>8} {'sigma':>8} {'2 sigma':>8}"
    )
    for case in CASES:
        found = study(case, given.trials, given.seed)
        print(
            f"{case.name:56} {found.rms_without:8.2f} {found.rms_with:8.2f} {found.ratio:6.3f}"
            f" {found.coverage:8.1%} {found.used:6.0%} {found.doubted:8.2%}"
            f" {found.foretold_rms:8.2f} {found.foretold_sigma:8.2f} {found.foretold_coverage:8.1%}"
        )


if __name__ == "__main__":
    main()
