"""The experiments as tables and claims."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product
from typing import Final

import numpy as np

from sim.accuracy import by_hand, compasses, deck, temperature, turning, until_ready, warmup
from sim.accuracy.experiments import (
    FIELD_HEADING_DEG,
    FIELD_TILT_DEG,
    FLOORED,
    NOISE_LSB,
    SPANS_S,
    STEP_RAD_S,
    TILTS,
    FloorRun,
    IntegerRun,
    WhiteRun,
    floors,
    integers,
    many,
    predicted,
    white,
)
from sim.accuracy.figures import Claim, Figure, Section, beside, covered, rms, stack
from sim.accuracy.stand import NEXT_S, POSTURES
from sim.earth import STANDARD_GRAVITY_M_S2
from sim.imu_model import DEG_H, PARTS, UG

UPRIGHT: Final = ("level", "by eye", "5/-3")
"""Postures in which the horizontal accelerometers are the x and y of the body."""
PAPER_LEFT_UG: Final = (56.80, 36.24)
"""Mean absolute errors E and N from the paper's table 1, in micro-g, recomputed (method 1.3)."""
_TRIADS: Final = (("gyro", "deg/h", DEG_H, slice(0, 3)), ("accel", "ug", UG, slice(3, 6)))
_LSB_DEG_H: Final = STEP_RAD_S / DEG_H
_REFERENCES: Final = f"gradienter {FIELD_TILT_DEG:g} deg, compass {FIELD_HEADING_DEG:g} deg"
_HALF_A_STEP: Final = 0.45
"""Value of sigma_stat, in steps of the output, from which on a mean counts as undetermined."""


def report(
    runs: int, seed: int, only: tuple[str, ...], jobs: int, progress: Callable[[str], None]
) -> dict[str, Section]:
    """Return all sections asked for, by name.

    Args:
        runs: number of stands with white noise. Other experiments use a share of this number. A fifth for every part,
            a hundredth for every warm-up case, a twentieth for each noise of integer readings. A thirty-second for each
            turn rate of the ground, a tenth for aircraft turned by hand, a twentieth for aircraft over many days.
        seed: seed of everything.
        only: some of `cli.SECTIONS`.
        jobs: number of processes.
        progress: receives the name of each section at its start.
    """
    found: dict[str, Section] = {}
    if "white" in only:
        progress(f"white noise: {runs} stands")
        found["white"] = _white(many(white, [(seed, number) for number in range(runs)], jobs))
    if {"floors", "tilt"} & set(only):
        each = max(runs // 5, len(POSTURES))
        progress(f"flicker and walk: {each} stands of each of {len(FLOORED)} parts")
        work = [*product(FLOORED, [seed], range(each))]
        parts: dict[str, list[FloorRun]] = {part: [] for part in FLOORED}
        for (part, *_), run in zip(work, many(floors, work, jobs), strict=True):
            parts[part] += [] if run is None else [run]
        found |= {"floors": _floors(parts, len(work))} if "floors" in only else {}
        found |= {"tilt": _tilt(parts)} if "tilt" in only else {}
    if "warm-up" in only:
        each = max(runs // 100, 1)
        progress(f"warm-up: {each} stands of each of {len(warmup.WARMING)} parts in {len(warmup.cases())} cases")
        heated = product(warmup.WARMING, warmup.cases(), [seed], range(each))
        found["warm-up"] = warmup.section(many(warmup.warm, [*heated], jobs), each)
    if "integers" in only:
        each = max(runs // 20, 4)
        progress(f"integers: {each} stands of each of {len(NOISE_LSB)} noises")
        cut = many(integers, [*product(NOISE_LSB, [seed], range(each))], jobs)
        found["integers"] = _integers(
            {noise: cut[each * index : each * (index + 1)] for index, noise in enumerate(NOISE_LSB)}
        )
    if "deck" in only:
        voyages, stands = max(runs // 10, 2), max(runs // 40, 2)
        progress(f"deck: {voyages} voyages, {stands} stands")
        found["deck"] = deck.section(voyages, stands, seed, jobs)
    if "turning" in only:
        each = max(runs // 32, 2)
        progress(f"turning: {each} stands of each of {len(turning.RATES_DEG_S)} rates")
        found["turning"] = turning.section(each, seed, jobs)
    if "by-hand" in only:
        each = max(runs // 10, 1)
        progress(f"by hand: {each} aircraft of each of {len(by_hand.BY_HAND)} parts")
        boards = product(by_hand.BY_HAND, [seed], range(each))
        found["by-hand"] = by_hand.section(many(by_hand.by_hand, [*boards], jobs), each)
    if "compasses" in only:
        each = max(runs // 10, 1)
        progress(f"compasses: {each} boards in {len(compasses.CASES)} cases")
        found["compasses"] = compasses.section(many(compasses.board, [*product([seed], range(each))], jobs))
    found |= _by_temperature(runs, seed, only, jobs, progress)
    return found


def _by_temperature(
    runs: int, seed: int, only: tuple[str, ...], jobs: int, progress: Callable[[str], None]
) -> dict[str, Section]:
    found = {}
    if "power-up" in only:
        each = max(runs // 20, 1)
        progress(f"power-up: {each} aircraft of each of {len(temperature.TRIED)} parts")
        days = product(temperature.TRIED, [seed], range(each))
        found["power-up"] = temperature.power_up_section(many(temperature.power_up, [*days], jobs), each)
    if "mid-warm-up" in only:
        each = max(runs // 20, 1)
        progress(f"mid-warm-up: {each} aircraft of each of {len(temperature.TRIED)} parts and rates")
        wanted = product(temperature.TRIED, temperature.RATES_K_MIN, [seed], range(each))
        found["mid-warm-up"] = temperature.mid_warm_up_section(many(temperature.mid_warm_up, [*wanted], jobs), each)
    if "until-ready" in only:
        each = max(runs // 50, 1)
        progress(
            f"until ready: {each} warm-ups of each of {len(temperature.TRIED)} parts in {len(until_ready.KNOWN)} cases"
        )
        boards = product(until_ready.KNOWN, temperature.TRIED, [seed], range(each))
        found["until-ready"] = until_ready.section(many(until_ready.until_ready, [*boards], jobs), each)
    return found


def _percent(figure: Figure) -> str:
    return f"{100.0 * figure.value:.1f} %"


def _white(runs: list[WhiteRun]) -> Section:
    error, sigma = stack(runs, "error"), stack(runs, "sigma")
    plain = stack(runs, "plain")
    lines = ["window  rms over bound  over the plain mean  2 sigma of sigma_stat cover"]
    claims = []
    for index, span in enumerate(SPANS_S):
        whole, efficient = rms(error[:, index]), beside(error[:, index], plain[:, index])
        worst = max(beside(error[:, index, axis], plain[:, index, axis]) for axis in range(6))
        twice = covered(error[:, index], sigma[:, index], 2.0)
        lines.append(f"{span:3d} s{whole.value:17.3f}{efficient.value:21.3f}{_percent(twice):>29}")
        claims.append(Claim(f"white noise, {span} s: worst axis over the bound", "", worst, 1.05))
        claims.append(Claim(f"white noise, {span} s: 2 sigma of sigma_stat cover", "%", twice.times(100.0), 97.0, 94.0))
    lines += [
        "",
        f"Standard errors: rms {whole.error:.3f}, beside the mean {efficient.error:.4f},",
        f"coverage {100.0 * twice.error:.2f} %. The bound is N / sqrt(T), which the plain mean attains;",
        "beside it the luck of the readings falls out.",
    ]
    return Section(f"White noise only, perfect references ({len(runs)} stands)", lines, claims)


def _upright(runs: list[FloorRun]) -> list[FloorRun]:
    return [run for run in runs if run.posture in UPRIGHT]


def _floors(parts: dict[str, list[FloorRun]], stands: int) -> Section:
    lines = [
        f"rms error against the mean bias of the next {NEXT_S:.0f} s, and over sqrt V(T, {NEXT_S:.0f} s)",
        "",
        f"{'':34}rms    /V  2 sigma cover  plain mean, covers",
    ]
    claims = []
    for part, runs in parts.items():
        level = _upright(runs)
        for triad, unit, scale, columns in _TRIADS:
            gyro = triad == "gyro"
            noise = PARTS[part].gyro if gyro else PARTS[part].accel
            for index, span in enumerate(SPANS_S):
                ideal = stack(runs, "ideal")[:, index, :3] if gyro else stack(level, "ideal")[:, index, 3:5]
                found = rms(ideal).times(1.0 / scale)
                use = predicted(noise, span, NEXT_S) / scale
                error, sigma = stack(runs, "error")[:, index, columns], stack(runs, "sigma")[:, index, columns]
                words = f"{part if gyro and not index else '':10}{f'{triad}, {unit}' if not index else '':13}"
                line = f"{words}{span:3d} s{found.value:9.1f}{found.value / use:6.2f}"
                line += f"{_percent(covered(error, sigma, 2.0)):>15}"
                if gyro:
                    plain, plain_sigma = stack(runs, "plain")[:, index, :3], stack(runs, "plain_sigma")[:, index, :3]
                    line += f"{rms(plain).value / scale:12.1f}{_percent(covered(plain, plain_sigma, 2.0)):>8}"
                lines.append(line)
                if part == "icm42688p" and gyro and span == SPANS_S[-1]:
                    claims.append(Claim("ICM-42688-P gyro, 60 s, next 180 s: rms", "deg/h", found, 5.5))
                    # An axis that errs in one direction, such as by the Earth's vertical rate, hides in the rms.
                    sided = Figure(float(np.abs((error / sigma).mean(axis=0)).max()), 1.0 / math.sqrt(len(runs)))
                    claims.append(Claim("ICM-42688-P gyro, 60 s: mean error, worst axis", "sigma", sided, 0.1))
    lines += [
        "",
        "rms: perfect references; of accelerometers the two horizontal ones, upright stands.",
        f"Coverage: all axes, {_REFERENCES}, gravity 30 mGal off.",
        "The plain mean takes the Earth for at rest and its sigma for s / sqrt(n).",
    ]
    refused = stands - sum(map(len, parts.values()))
    rate = Figure(refused / stands, math.sqrt(max(refused, 1)) / stands)
    claims.append(Claim("stands refused as moving", "of 1,000", rate.times(1000.0), 2.0))
    return Section(f"Parts with flicker and walk ({stands // len(parts)} stands each)", lines, claims)


def _tilt(parts: dict[str, list[FloorRun]]) -> Section:
    runs = _upright(parts["icm42688p"])
    lines = [
        "horizontal accelerometers of an ICM-42688-P after 60 s, against the bias of the next 180 s; ug",
        "",
        "tilt reference       its own error     rms   over it   mean of |error|",
    ]
    claims = []
    tilted = stack(runs, "tilted")
    for index, (name, sigma) in enumerate(TILTS):
        own = float(np.radians(sigma)) * STANDARD_GRAVITY_M_S2 / UG
        found = rms(tilted[:, index]).times(1.0 / UG)
        apart = np.abs(tilted[:, index]).mean(axis=(1, 2)) / UG
        size = Figure(float(apart.mean()), float(apart.std(ddof=1)) / float(np.sqrt(len(apart))))
        over = found.times(1.0 / own)
        lines.append(f"{name:20}{own:14.1f}{found.value:8.1f}{over.value:10.3f}{size.value:18.1f}")
        if name.startswith("at most"):
            claims.append(Claim("tilt at most 10 arcsec off: mean of |error|", "ug", size, min(PAPER_LEFT_UG)))
        else:
            claims.append(Claim(f"tilt of {name}: rms over the reference's own", "", over, 1.10))
    east, north = PAPER_LEFT_UG
    lines += [
        "",
        f"The paper, five stands, turntable of 10 arcsec: mean of |error| {east:.1f} ug east, {north:.1f} ug north.",
    ]
    return Section(f"The tilt reference rules ({len(runs)} upright stands)", lines, claims)


def _integers(noises: dict[float, list[IntegerRun]]) -> Section:
    lines = [
        "steps of 1 mrad/s = 206 deg/h and 1 mg; noise in steps a reading; 60 s at 100 Hz",
        "",
        "                by share               gyro, deg/h      accel, mg   2 sigma  plain mean",
        "noise  refused  1/2 step  measured      rms    max     rms    max    cover  rms, deg/h",
    ]
    claims = []
    for noise, runs in noises.items():
        error, sigma = stack(runs, "error"), stack(runs, "sigma")
        refused = np.isnan(error)
        coarse = ~refused & (sigma >= _HALF_A_STEP)
        measured = np.where(refused | coarse, np.nan, error)
        shares = [float(one.mean()) for one in (refused, coarse, ~refused & ~coarse)]
        words = f"{noise:5.1f}" + "".join(f"{100.0 * share:8.1f} %" for share in shares)
        if shares[2] > 0.0:
            gyro, accel = measured[:, :3], measured[:, 3:]
            largest = (float(np.nanmax(np.abs(gyro))) * _LSB_DEG_H, float(np.nanmax(np.abs(accel))))
            words += f"{rms(gyro).value * _LSB_DEG_H:9.1f}{largest[0]:7.1f}{rms(accel).value:8.3f}{largest[1]:7.3f}"
            words += f"{_percent(covered(measured, sigma, 2.0)):>9}"
            if 0.3 <= noise <= 1.0:
                for what, size, unit, limit in (("gyro", largest[0], "deg/h", 15.0), ("accel", largest[1], "mg", 0.15)):
                    claims.append(
                        Claim(f"integers, noise {noise:g}: largest {what} error", unit, Figure(size, 0.0), limit)
                    )
        else:
            words += f"{'-':>9}{'-':>7}{'-':>8}{'-':>7}{'-':>9}"
        if coarse.any():
            kept = covered(np.where(coarse, error, np.nan), sigma, 1.0).times(100.0)
            claims.append(Claim(f"integers, noise {noise:g}: half a step covers", "%", kept, 100.0, 99.9))
        lines.append(words + f"{rms(stack(runs, 'plain')).value * _LSB_DEG_H:11.0f}")
    lines += [
        "",
        "Refused: around zero, where nothing is known but that the bias is small. Half a step: sigma says so,",
        "and every error lies within one sigma. The plain mean has the Earth and the pose taken off.",
    ]
    count = len(next(iter(noises.values())))
    return Section(f"Integers cut toward zero ({count} stands of six axes each)", lines, claims)
