"""Allan models of IMU noise, and the variance V(T, H) with which a mean over T seconds predicts the next H seconds.

One axis has white noise N (unit * sqrt(s)), flicker B (unit; the floor of the Allan deviation is 0.664 B) and rate
random walk K (unit / sqrt(s)). Sources: method.md section 2.2; IEEE Std 952.

A recording of a sensor at rest determines N, B and K, each with its error. The method is maximum likelihood of the
overlapping Allan variances at averaging times t of 1, 2, 4, ... 256 s. A calibration needs no longer times: a drift or
bounded wander affects it through these times only. The Allan variance at t is N^2 / t + (2 ln 2 / pi) B^2 + K^2 t / 3.
Each t counts as length / (2 t) independent squares: those of Haar's wavelets, which hold all information.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.config.sections import AllanModel, NoiseProfile
from companion.errors import ConfigError
from companion.physics.frames import Floats, vector
from companion.physics.statistics import student_quantile
from companion.physics.units import DEG_H, MG

FLOOR_OF_FLICKER: Final = AllanModel(0.0, 1.0, 0.0).floor  # Allan deviation of pure flicker noise over B: 0.664

_FLOOR_REACHED_S: Final = 1000.0
"""Averaging time, s, at which an assumed K equals the flicker floor: catalogues state no K (method.md section 2.2)."""
WARM_UP_K: Final = 20.0  # Temperature rise of a board with processor and radio; two sigma
WARM_UP: Final = (WARM_UP_K * 54.0 * DEG_H, WARM_UP_K * 0.4 * MG)
"""Warm-up bias change of an unknown part, from a BMI088's gyro and a BMI160's accelerometer (method.md section 2.1)."""


def allan_model(white: float, floor: float, walk: float | None = None) -> AllanModel:
    """Make a model of white noise N, Allan floor A (0.664 B) and random walk K; None: assumed, data sheets lack it."""
    walk = floor * math.sqrt(3.0 / _FLOOR_REACHED_S) if walk is None else walk
    return AllanModel(white, floor / FLOOR_OF_FLICKER, walk)


def _profile(
    name: str,
    gyro_deg_h: tuple[float, float],
    accel_ug: tuple[float, float] | tuple[float, float, float],
    per_kelvin: tuple[float, float] | None = None,
) -> NoiseProfile:
    """Make a profile from noise N, A and, if measured, K; `per_kelvin`: bias change in deg/h and mg per kelvin."""
    accel = [figure * 1e-3 * MG for figure in accel_ug]
    return NoiseProfile(
        name,
        allan_model(gyro_deg_h[0] * DEG_H, gyro_deg_h[1] * DEG_H),
        allan_model(*accel),
        warm_up=None if per_kelvin is None else (WARM_UP_K * per_kelvin[0] * DEG_H, WARM_UP_K * per_kelvin[1] * MG),
    )


# N in deg/h*sqrt(s) and ug*sqrt(s), A in deg/h and ug, K in ug/sqrt(s): method.md section 2.2. The ADIS16405 has the
# figures measured at rest over sessions of 2.8 h: the gyro's six (upper ends), the accelerometer's three (tilt and
# temperature of the bench included), not those of its data sheet.
# "unknown" is for a part that is not configured. On the ground a window shows its noise, and its floors are estimated
# (`learned_floor`); on a deck they are those of the worst common parts. Its white noise is that of the best: white
# noise is measured in every window, and the larger figure counts. Temperature coefficients: method.md section
# 2.1, which has none of the two ADIS.
PROFILES: Final[dict[str, NoiseProfile]] = {
    profile.name: profile
    for profile in (
        _profile("icm42688p", (7.1, 3.0), (49.5, 10.0), (18.0, 0.15)),
        _profile("bmi088", (35.6, 2.0), (124.0, 20.0), (54.0, 0.2)),
        _profile("adis16470", (20.4, 8.0), (63.0, 13.0)),
        _profile("adis16405", (152.0, 29.0), (669.0, 269.0, 58.0)),
        _profile("unknown", (7.1, 30.0), (49.5, 200.0)),
    )
}


def noise_profile(profile: str | NoiseProfile | None) -> NoiseProfile:
    """Return the given profile, or the catalogue's profile of a sensor type by its name; None: the profile "unknown".

    Raises:
        ConfigError: the catalogue has no sensor type of this name.
    """
    if isinstance(profile, NoiseProfile):
        return profile
    if profile is not None and profile not in PROFILES:
        raise ConfigError(f"no noise profile {profile!r} (known: {', '.join(PROFILES)})")
    return PROFILES[profile or "unknown"]


def columns(profile: NoiseProfile) -> Floats:
    """Return white noise N, flicker B and random walk K (rows) of three gyro, three accelerometer axes: (3, 6)."""
    return np.repeat([[m.white, m.flicker, m.walk] for m in (profile.gyro, profile.accel)], 3, axis=0).T


def phi(ratio: Floats | float) -> Floats:
    """Return PHI(H/T), the flicker's part of V(T, H) times pi / B^2; PHI(1) = 4 ln 2 (method.md section 2.2).

    The function log1p avoids cancellation for H much longer or much shorter than T.
    """
    r = np.asarray(ratio, dtype=np.float64)
    return np.asarray(r * np.log1p(1.0 / r) + (2.0 + 1.0 / r) * np.log1p(r) - np.log(r))


def floor_variance(
    flicker: Floats | float, walk: Floats | float, mean_s: Floats | float, horizon_s: Floats | float
) -> Floats:
    """Return the prediction variance V(T, H) without its white-noise term (the only one that averaging reduces)."""
    mean_s = np.asarray(mean_s, dtype=np.float64)
    return np.asarray(
        np.square(flicker) / math.pi * phi(horizon_s / mean_s) + np.square(walk) * (mean_s + horizon_s) / 3.0
    )


def predicted_sigma(model: AllanModel, mean_s: float, horizon_s: float) -> float:
    """Return one sigma, sqrt(V(T, H)), with which a mean over `mean_s` predicts the bias over `horizon_s` seconds."""
    floor = float(floor_variance(model.flicker, model.walk, mean_s, horizon_s))
    return math.sqrt(model.white**2 / mean_s + floor)


def slope_variance(flicker: Floats | float, walk: Floats | float, mean_s: float) -> Floats:
    """Return the variance of a line's slope over `mean_s` seconds that flicker B and random walk K cause.

    Derivation: apply the line's weights to the generalised covariance -(B^2 / pi) ln|t| - (K^2 / 2)|t| (method.md
    section 2.2). The double integrals are T^4 / 16 and T^5 / 60, times 144 / T^6.
    """
    return np.asarray(9.0 / math.pi * np.square(flicker / mean_s) + 1.2 * np.square(walk) / mean_s)


def allan_variance(slots: NDArray[np.int64], values: Floats, span: int) -> tuple[Floats, float]:
    """Compute the overlapping Allan variance of values (m, c) at ascending seconds (m,) of a 1 s grid with holes.

    An average over `span` seconds needs at least half of them.

    Returns:
        (c,) variance, and its equivalent degrees of freedom for white noise (NIST SP 1065, equation for white FM).
        Both are zero if no pair of averages exists.
    """
    length = int(slots[-1] - slots[0]) + 1
    if length < 2 * span:
        return np.zeros(values.shape[1]), 0.0
    place = slots - slots[0] + 1
    sums, counts = np.zeros((length + 1, values.shape[1])), np.zeros(length + 1)
    sums[place] = values - np.add.reduce(values) / len(values)
    counts[place] = 1.0
    sums, counts = np.cumsum(sums, axis=0), np.cumsum(counts)
    count = counts[span:] - counts[:-span]
    mean = (sums[span:] - sums[:-span]) / np.maximum(count, 1.0)[:, None]
    usable = count >= 0.5 * span
    apart = (mean[span:] - mean[:-span])[usable[span:] & usable[:-span]]
    pairs = len(apart)
    if pairs == 0:
        return np.zeros(values.shape[1]), 0.0
    variance = 0.5 * (np.add.reduce(apart * apart) / pairs)
    points = pairs + 2 * span
    freedom = (1.5 * (points - 1) / span - 2.0 * (points - 2) / points) * 4.0 * span**2 / (4.0 * span**2 + 5.0)
    return variance, max(freedom, 1.0)


def student_ratio(freedom: float) -> float:
    """Return the ratio of Student's 95 % interval to the normal one; at most 3, also below one degree of freedom."""
    return min(student_quantile(1.96, freedom) / 1.96, 3.0) if freedom >= 1.0 else 3.0


def white_noise(slots: NDArray[np.int64], values: Floats) -> Floats:
    """Return white noise N (c,) from the Allan deviation between neighbouring seconds; if these are few, N is enlarged.

    Without neighbouring seconds (a gradienter slower than 1 Hz), the scatter of the means is used.
    """
    variance, freedom = allan_variance(slots, values, 1)
    if freedom == 0.0:
        freedom = float(len(values) - 1)
        variance = values.var(axis=0, ddof=1) if len(values) > 1 else np.zeros(values.shape[1])
    return np.asarray(np.sqrt(variance) * student_ratio(freedom))


# --- of an unknown part

_FLOOR_MEDIAN: Final = 0.25
"""Allan floor A over white noise N, 1 / sqrt(s): 0.06 to 0.42 in the catalogue, 0.05 to 0.5 in recordings of others."""
_FLOOR_SPREAD: Final = math.log(2.5)
_FLOOR_RATIOS: Final = np.geomspace(0.03, 3.0, 21)
_TINY: Final = 1e-30  # (rad/s)^2 or (m/s^2)^2: less than any noise, for readings that never change
_WALKS_S: Final = np.array([100.0, 300.0, 1000.0])  # Averaging times at which the walk reaches the floor


def learned_floor(slots: NDArray[np.int64], values: Floats, white: Floats) -> tuple[Floats, Floats]:
    """Estimate flicker B and random walk K, (3,) each, of a triad of unknown type from one window.

    One ratio of Allan floor A to white noise N holds for all three axes. Its prior comes from common sensors, and its
    likelihood from the window's Allan variances. V(T, H) is linear in B^2 and K^2, so their posterior means suffice.
    `slots` (m,): ascending seconds. `values` (m, 3): means of these seconds. `white` (3,): N.
    """
    ratio2, walk_s = (each.ravel() for each in np.meshgrid(np.square(_FLOOR_RATIOS), _WALKS_S))
    log_weight = -0.5 * np.square((np.log(ratio2) / 2.0 - math.log(_FLOOR_MEDIAN)) / _FLOOR_SPREAD)
    length, span = int(slots[-1] - slots[0]) + 1, 2
    while 2 * span <= length:
        variance, freedom = allan_variance(slots, values, span)
        if freedom > 0.0:
            model = 1.0 / span + ratio2 * (1.0 + span / walk_s)
            found = float((variance / np.maximum(np.square(white), _TINY)).sum())
            freedom = len(slots) / (2.0 * span)
            log_weight = log_weight - freedom / 2.0 * (3.0 * np.log(model) + found / model)
        span *= 2
    weight = np.exp(log_weight - log_weight.max())
    weight = weight / weight.sum()
    flicker2, walk2 = float(weight @ ratio2) / FLOOR_OF_FLICKER**2, float(weight @ (3.0 * ratio2 / walk_s))
    return white * math.sqrt(flicker2), white * math.sqrt(walk2)


# --- from recordings

KNOWN_SIGMAS: Final = 2.0
"""Threshold for N^2, B^2 or K^2 over its standard error; above it, N, B or K counts as known, within 25 %."""
UPPER_SIGMAS: Final = 1.645  # One-sided 95 %: upper limit of an unknown figure
LEAST_SLOTS: Final = 8  # Least seconds of a stretch: a shorter one shows white noise only
LONGEST_S: Final = 256
_LONGEST_SHARE: Final = 3  # The longest average is a third of the stretch: a longer one has a single difference
_ROUNDS: Final = 1000
_UPPER_ROUNDS: Final = 40
_UNBOUNDED: Final = 1e6


class AllanCurve(NamedTuple):
    """Allan variances of a recording at rest; k rows, one for each averaging time of each uninterrupted part.

    `spans` (k,): averaging times, s. `counts` (k,): seconds in an average, fewer if some are missing. `freedom` (k,):
    number of independent squares. `variance` (k, c): Allan variances of c axes.
    """

    spans: Floats
    counts: Floats
    freedom: Floats
    variance: Floats


class AxisFit(msgspec.Struct, frozen=True):
    """Noise of one axis, fitted to recordings: N in unit * sqrt(s), B in unit, K in unit / sqrt(s).

    `sigmas`: standard errors of the squares N^2, B^2, K^2. `upper`: one-sided 95 % limits of N, B, K, infinite if the
    recordings are too short. `known`: true for each of N, B, K that the recordings determine.
    """

    figures: tuple[float, float, float]  # N, B, K; none is negative
    sigmas: tuple[float, float, float]
    upper: tuple[float, float, float]
    known: tuple[bool, bool, bool]


def curve(stretches: Iterable[tuple[NDArray[np.int64], Floats]]) -> AllanCurve:
    """Compute the Allan variances of several recordings, each with ascending seconds (m,) and their means (m, c).

    Raises:
        ValueError: every recording is too short.
    """
    rows = []
    for slots, values in stretches:
        length = int(slots[-1] - slots[0]) + 1
        filled = len(slots) / length
        span = 1
        while span <= min(length // _LONGEST_SHARE, LONGEST_S) and len(slots) >= LEAST_SLOTS:
            variance, freedom = allan_variance(slots, values, span)
            if freedom > 0.0:
                # An average of one second has no hole; in a longer one, only the seconds present reduce noise.
                rows.append((span, max(filled * span, 1.0), len(slots) / (2.0 * span), variance))
            span *= 2
    if not rows:
        raise ValueError("nothing to fit: no stretch is long enough")
    return AllanCurve(*(np.array(column, dtype=np.float64) for column in zip(*rows, strict=True)))


def fit_axis(found: AllanCurve, column: int) -> AxisFit:
    """Estimate white noise N, flicker B and random walk K of one axis, `column`.

    Raises:
        ValueError: the readings of this axis never change.
    """
    spans, counts, freedom, every = found
    variance = every[:, column]
    # Scale by the scatter from second to second, so that no square is small.
    unit2 = float(variance[spans == 1.0].mean())
    if not unit2 > 0.0:
        raise ValueError("nothing to fit: readings that never change")
    variance = variance / unit2
    design = np.stack([1.0 / counts, np.full(len(spans), FLOOR_OF_FLICKER**2), spans / 3.0], axis=1)

    def errors(theta: Floats) -> Floats:
        information = design.T @ (design * (freedom / (2.0 * np.square(design @ theta)))[:, None])
        # Two averaging times cannot determine three figures: the error of the third becomes large.
        return np.asarray(np.sqrt(np.diag(np.linalg.inv(information + np.diag(1e-12 * np.diag(information))))))

    def upper(which: int) -> float:
        """Find the upper 95 % limit of N^2, B^2 or K^2: a true value that gives so low an estimate in 5 % of cases."""
        limit = theta.copy()
        for _ in range(_UPPER_ROUNDS):
            before = limit[which]
            limit[which] = theta[which] + UPPER_SIGMAS * errors(limit)[which]
            if limit[which] <= before * 1.001:
                return float(limit[which])
            if limit[which] > _UNBOUNDED:
                break
        return math.inf

    theta = np.array([1.0, 0.05, 1e-3])
    for _ in range(_ROUNDS):
        # Each step increases the chi-square likelihood and keeps all figures non-negative.
        model = design @ theta
        theta = theta * (design.T @ (freedom * variance / np.square(model))) / (design.T @ (freedom / model))
    sigmas = errors(theta)
    n, b, k = (theta > KNOWN_SIGMAS * sigmas).tolist()
    return AxisFit(
        figures=vector(np.sqrt(theta * unit2)),
        sigmas=vector(sigmas * unit2),
        upper=vector(np.sqrt(np.array([upper(which) for which in range(3)]) * unit2)),
        known=(n, b, k),
    )
