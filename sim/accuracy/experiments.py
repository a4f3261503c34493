"""The experiments: many stands each, in several processes; each returns errors and sigmas against the known truth.

Each experiment is a function of a seed, so its result does not depend on the number of processes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np

from companion.errors import CalibrationRefusedError
from companion.estimation.means.windows import ImuInput, Window
from companion.estimation.noise.allan import noise_profile
from sim.accuracy.stand import (
    GRAVITY_ANOMALY_M_S2,
    NEXT_S,
    POSTURES,
    RATE_HZ,
    References,
    Stand,
    biases,
    collected,
    samples,
    sigmas_use,
    sites,
    solved,
    stand,
)
from sim.earth import STANDARD_GRAVITY_M_S2, Array
from sim.imu_model import MG, AxisNoise, ImuSpec

SPANS_S: Final = (10, 30, 60)
FLOORED: Final = ("icm42688p", "bmi088", "adis16470", "adis16405")
TILTS: Final = (
    ("at most 10 arcsec", 10.0 / 3600.0 / math.sqrt(3.0)),
    ("10 arcsec", 10.0 / 3600.0),
    ("0.01 deg", 0.01),
    ("0.05 deg", 0.05),
    ("0.1 deg", 0.1),
)
"""Tilt references, each with a sigma in degrees; the first reference's error is uniform up to its limit."""
TILT_DRAWS: Final = 8
"""Number of errors drawn for each tilt reference, per stand."""
FIELD_TILT_DEG: Final = 0.01
FIELD_HEADING_DEG: Final = 1.0
STEP_RAD_S: Final = 1e-3
NOISE_LSB: Final = (0.1, 0.2, 0.3, 0.5, 1.0, 2.0)

_Found = TypeVar("_Found")


def many(one: Callable[..., _Found], arguments: Sequence[tuple[object, ...]], jobs: int) -> list[_Found]:
    """Return the results of `one(*arguments)` for all `arguments`, in their order, from several processes."""
    if jobs == 1:
        return [one(*each) for each in arguments]
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(one, *zip(*arguments, strict=True), chunksize=max(1, len(arguments) // (8 * jobs))))


def plain_mean(rows: Array) -> tuple[Array, Array]:
    """Return bias (6) and sigma (6): mean of readings (n, 6) less that of a level aircraft on an Earth at rest."""
    level = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -STANDARD_GRAVITY_M_S2])
    return rows.mean(axis=0) - level, np.asarray(rows.std(axis=0, ddof=1) / math.sqrt(len(rows)))


def whole_seconds(times: Array, rows: Array, window: Window) -> Array:
    """Return the readings that belong to a window."""
    return np.asarray(rows[(times >= window.start_s) & (times < window.end_s)])


# ------------------------------------------------------------------------------------------------------------ white


@dataclass(frozen=True, slots=True, eq=False)
class WhiteRun:
    """One stand with white noise only and perfect references; arrays (spans, 6), as multiples of the bound."""

    error: Array
    sigma: Array
    plain: Array
    """Error of the plain mean of the same readings, which attains the bound."""


def white(seed: int, number: int) -> WhiteRun:
    """Return errors and sigma_stat of one stand, in units of the Cramer-Rao bound N / sqrt(T)."""
    posture = POSTURES[number % len(POSTURES)]
    site = sites()[number // len(POSTURES) % len(sites())]
    standing = stand("white_only", posture, site, (seed, 1, number))
    taken = ImuInput(name="imu", rotation=standing.imu.mounting, profile=noise_profile("icm42688p"))
    times, rows = samples(standing, SPANS_S[-1])
    found: list[tuple[Array, Array, Array]] = []
    for window in collected(standing, taken, times, rows, SPANS_S):
        truth = standing.bias(window.start_s, window.end_s)
        bound = standing.imu.white / np.sqrt(window.end_s - window.start_s)
        imu = solved(standing, window).imus[0]
        inside = standing.in_vehicle(whole_seconds(times, rows, window))
        still = inside.mean(axis=0) - standing.in_vehicle(standing.imu.expected(window.start_s))
        found.append(((biases(imu) - truth) / bound, imu.sigma_stat / bound, still / bound))
    return WhiteRun(*np.array(found).transpose(1, 0, 2))


# ------------------------------------------------------------------------------------------------------------ floors


@dataclass(frozen=True, slots=True, eq=False)
class FloorRun:
    """Errors of one stand with a part's flicker and walk, against the bias in the next three minutes (spans, 6), SI."""

    posture: str
    ideal: Array
    """Error with perfect references, caused by the IMU alone."""
    error: Array
    """Error with a gradienter of 0.01 deg and a compass of 1 deg."""
    sigma: Array
    """Stated sigma_use for `error`."""
    plain: Array
    plain_sigma: Array
    tilted: Array
    """Errors of the two horizontal accelerometers in the longest span (references, draws, 2)."""


def floors(part: str, seed: int, number: int) -> FloorRun | None:
    """Simulate one stand; None: noise looked like motion, so that a pilot would have to wait longer."""
    posture = POSTURES[number % len(POSTURES)]
    site = sites()[number // len(POSTURES) % len(sites())]
    standing = stand(
        part, posture, site, (seed, 2, FLOORED.index(part), number), anomaly_m_s2=GRAVITY_ANOMALY_M_S2
    )  # fmt: skip
    taken = ImuInput(name="imu", rotation=standing.imu.mounting, profile=noise_profile(part))
    times, rows = samples(standing, SPANS_S[-1])
    try:
        windows = collected(standing, taken, times, rows, SPANS_S)
    except CalibrationRefusedError:
        return None
    references = References.drawn(FIELD_TILT_DEG, FIELD_HEADING_DEG, standing.random)
    ideal, error, sigma, plain, plain_sigma = [], [], [], [], []
    truth = np.zeros(6)
    for window in windows:
        truth = standing.bias(window.end_s, window.end_s + NEXT_S)
        inside = standing.in_vehicle(whole_seconds(times, rows, window))
        ideal.append(biases(solved(standing, window).imus[0]) - truth)
        imu = solved(standing, window, references).imus[0]
        error.append(biases(imu) - truth)
        sigma.append(sigmas_use(imu))
        naive, naive_sigma = plain_mean(inside)
        plain.append(naive - truth)
        plain_sigma.append(naive_sigma)
    return FloorRun(
        posture=posture.name,
        ideal=np.array(ideal),
        error=np.array(error),
        sigma=np.array(sigma),
        plain=np.array(plain),
        plain_sigma=np.array(plain_sigma),
        tilted=_tilted(standing, windows[-1], truth),
    )


def _tilted(standing: Stand, window: Window, truth: Array) -> Array:
    rows = []
    for name, sigma in TILTS:
        if name.startswith("at most"):
            drawn = standing.random.uniform(-1.0, 1.0, (TILT_DRAWS, 2)) * (sigma * math.sqrt(3.0))
        else:
            drawn = standing.random.normal(size=(TILT_DRAWS, 2)) * sigma
        for x, y in drawn.tolist():
            references = References(tilt_sigma_deg=sigma, tilt_error_deg=(x, y))
            rows.append((biases(solved(standing, window, references).imus[0]) - truth)[3:5])
    return np.array(rows).reshape(len(TILTS), TILT_DRAWS, 2)


# ---------------------------------------------------------------------------------------------------------- integers


@dataclass(frozen=True, slots=True, eq=False)
class IntegerRun:
    """Errors of one stand whose readings are truncated to whole mrad/s and mg; arrays (6), in these steps."""

    error: Array
    """Errors of the estimated biases; NaN: the calibration was refused."""
    sigma: Array
    """Stated sigma_stat; at least 0.5 if the readings do not determine the mean."""
    plain: Array
    """Error of the plain mean, less the effect of Earth and pose."""


def integers(noise_lsb: float, seed: int, number: int) -> IntegerRun:
    """Simulate one stand with noise of `noise_lsb` steps per reading; biases are uniform within 2.5 steps of zero."""
    steps = np.repeat([STEP_RAD_S, MG], 3)
    density = noise_lsb / np.sqrt(float(RATE_HZ))
    spec = ImuSpec(name="cut", gyro=AxisNoise(white=density * STEP_RAD_S), accel=AxisNoise(white=density * MG))
    random = np.random.default_rng([seed, 22, number])
    bias = random.uniform(-2.5, 2.5, 6) * steps
    posture = replace(POSTURES[2], pitch_deg=float(random.uniform(-8, 8)), roll_deg=float(random.uniform(-8, 8)))
    standing = stand(
        spec,
        posture,
        sites()[number % len(sites())],
        (seed, 3, round(1000 * noise_lsb), number),
        gyro_bias_rad_s=bias[:3],
        accel_bias_m_s2=bias[3:],
    )
    taken = ImuInput(
        name="imu",
        rotation=np.eye(3),
        profile=noise_profile("icm42688p"),
        gyro_step_rad_s=STEP_RAD_S,
        accel_step_m_s2=MG,
    )
    times, exact = samples(standing, SPANS_S[-1])
    rows = np.trunc(exact / steps) * steps
    window = collected(standing, taken, times, rows, (SPANS_S[0], SPANS_S[-1]))[-1]
    inside = whole_seconds(times, rows, window)
    plain = inside.mean(axis=0) - standing.imu.expected(window.start_s)
    try:
        imu = solved(standing, window).imus[0]
    except CalibrationRefusedError:  # gyros and accelerometers
        return IntegerRun(np.full(6, np.nan), np.full(6, np.nan), plain / steps)
    return IntegerRun((biases(imu) - bias) / steps, imu.sigma_stat / steps, plain / steps)


def predicted(noise: AxisNoise, mean_s: float, horizon_s: float) -> float:
    """Return sqrt(V(T, H)) of method 2.2, from the simulator's own noise figures."""
    r = horizon_s / mean_s
    phi = ((1.0 + r) ** 2 * np.log(1.0 + r) - r**2 * np.log(r)) / r - np.log(r)
    variance = noise.white**2 / mean_s + noise.flicker**2 / np.pi * phi + noise.walk**2 * (mean_s + horizon_s) / 3.0
    return float(np.sqrt(variance))
