"""Calibrations in the middle of a warm-up, by aircraft that have warmed up on twenty days before."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from companion.estimation.means.windows import ImuInput
from companion.estimation.noise.allan import noise_profile
from companion.estimation.records.history import by_power_up, kept
from companion.estimation.solution.joint import at_end, with_warm
from companion.estimation.solution.prior import ExpectedImu, curve_of
from companion.estimation.temperature.curve import settling
from sim.accuracy.figures import Claim, Section, covered, rms
from sim.accuracy.stand import POSTURES, References, collected, samples, sites, solved, stand
from sim.accuracy.temperature import AMBIENT_DEGC, COVERS, DAYS, TRIED, Aircraft
from sim.earth import Array
from sim.imu_model import DEG_H, PARTS
from sim.thermal import Curve

RATES_K_MIN: Final = (0.5, 2.0, 5.0)
SPANS_S: Final = (15, 60)
_FLAT: Final = 5.0
"""Time constants after which it is warm."""


@dataclass(frozen=True, slots=True, eq=False)
class MidRun:
    """Of every span, (spans, 3): errors and sigmas at the end of the window, and when warm; rad/s; NaN: not told."""

    error: Array
    sigma: Array
    warm_error: Array
    warm_sigma: Array
    plain_error: Array
    """Without the curve."""
    plain_sigma: Array
    plain_warm_error: Array


def mid_warm_up(part: str, rate_k_min: float, seed: int, number: int) -> MidRun:
    """One aircraft, its earlier days, and a stand in whose middle its temperature rises so fast."""
    random = np.random.default_rng([seed, 77, number, round(10.0 * rate_k_min)])
    rate_k_s = rate_k_min / 60.0
    on_s = -1.0
    while on_s < 0.0:  # where it stands before the power came, it does not warm
        aircraft = Aircraft(PARTS[part].gyro, random)
        board, bends = aircraft.board, aircraft.piece.curve
        steepest = board.rise_k / board.time_constant_s
        on_s = board.time_constant_s * math.log(steepest / rate_k_s) - SPANS_S[-1] / 2.0
    points = kept([point for day in range(DAYS) for point in aircraft.seen(aircraft.day(), day)])
    profile = noise_profile(part)
    curve = curve_of(points, "gyro", profile.gyro)
    settles = settling([[(point.temperature_degc or 0.0, point.k_s) for point in one] for one in by_power_up(points)])
    switched_on = board.switched_on(random.uniform(*AMBIENT_DEGC))
    standing = stand(
        part,
        POSTURES[0],
        sites()[1],
        (seed, number),
        temperature_degc=lambda t_s: switched_on(t_s + on_s),
        curve=Curve(tuple(np.append(power, np.zeros(3)) for power in bends.powers), bends.lag_s),
    )
    times, rows = samples(standing, SPANS_S[-1])
    taken = ImuInput(name="imu", rotation=standing.imu.mounting, profile=profile)
    found: list[list[Array]] = []
    for window in collected(standing, taken, times, rows, SPANS_S):
        solution = solved(standing, window, References.drawn(0.05, 0.5, random))
        plain = solution.imus[0]
        assert plain.gyro_rad_s is not None
        end = plain.gyro_rad_s
        path = None if plain.warming is None else plain.warming.path
        said, known = plain, ExpectedImu(name="imu")
        if curve is not None and path is not None:
            known = ExpectedImu(name="imu", along={"gyro": curve.along(path, settles, profile.gyro)})
            said, shift, followed = at_end(plain, known, solution.shared)
            end = end + shift[:3]
            said = with_warm(said, (end, None), known, followed)
        truth = standing.bias(window.end_s - 0.5, window.end_s + 0.5)[:3]
        late_s = window.end_s + _FLAT * board.time_constant_s
        warm = standing.bias(late_s - 0.5, late_s + 0.5)[:3]
        told = said.when_warm
        unknown = np.full(3, np.nan)
        found.append([
            end - truth,
            np.sqrt(np.diag(said.covariance)[:3]),
            unknown if told is None else np.array(told.gyro_bias_rad_s) - warm,
            unknown if told is None else np.array(told.gyro_sigma_rad_s),
            plain.gyro_rad_s - truth,
            np.sqrt(np.diag(plain.use_covariance)[:3]),
            plain.gyro_rad_s - warm,
        ])  # fmt: skip
    return MidRun(*(np.array(each) for each in zip(*found, strict=True)))


def section(runs: list[MidRun], each: int) -> Section:
    """So many aircraft of every part and rate."""
    lines = [
        "gyros, rms error in deg/h, sigma, 2 sigma cover:",
        "at the end of the window without and with the curve; when warm, as foretold;",
        "what the calibration is off by then",
        "",
        f"{'':27}{'without':>16}{'with':>23}{'when warm':>23}{'off by':>8}",
    ]
    claims = []
    flat = iter(runs)
    for part in TRIED:
        ends: list[tuple[Array, Array]] = []
        warms: list[tuple[Array, Array]] = []
        for rate in RATES_K_MIN:
            own = [next(flat) for _ in range(each)]
            for k, span in enumerate(SPANS_S):
                error, sigma, warm, of_warm, plain, of_plain, later = (
                    np.array([getattr(run, name)[k] for run in own]) for name in MidRun.__dataclass_fields__
                )
                told = np.isfinite(of_warm).all(axis=1)
                ends.append((error, sigma))
                warms.append((warm[told], of_warm[told]))
                size, before = rms(error).times(1.0 / DEG_H), rms(plain).times(1.0 / DEG_H)
                share, foreseen = covered(error, sigma, 2.0).times(100.0), covered(*warms[-1], 2.0).times(100.0)
                then, left = rms(warm[told]).times(1.0 / DEG_H), rms(later).times(1.0 / DEG_H)
                lines.append(
                    f"{part if rate == RATES_K_MIN[0] and not k else '':11}{rate:4g} K/min{span:5d} s"
                    f"{before.value:9.1f}{_size(of_plain):7.1f}"
                    f"{size.value:9.1f}{_size(sigma):7.1f}{share.value:6.1f}%"
                    f"{then.value:9.1f}{_size(of_warm[told]):7.1f}{foreseen.value:6.1f}%{left.value:8.0f}"
                )
        for words, pairs in (("at the end", ends), ("when warm", warms)):
            errors, sigmas = (np.concatenate(one) for one in zip(*pairs, strict=True))
            claims.append(
                Claim(
                    f"in mid-warm-up, {part}, {words}: 2 sigma cover",
                    "%",
                    covered(errors, sigmas, 2.0).times(100.0),
                    COVERS[1],
                    COVERS[0],
                )
            )
    lines += ["", f"{DAYS} days before as above; the rate is that of the middle of the minute."]
    return Section(f"In mid-warm-up ({each} aircraft of each part and rate)", lines, claims)


def _size(sigma: Array) -> float:
    return float(np.sqrt(np.square(sigma).mean())) / DEG_H
