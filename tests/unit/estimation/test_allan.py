"""Allan models against the published table, and against noise that was made without them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.config.sections import AllanModel
from companion.estimation.noise.allan import (
    PROFILES,
    allan_model,
    allan_variance,
    noise_profile,
    phi,
    student_ratio,
)
from companion.physics.units import DEG_H, MG
from tests.support.allan import use_variance

Floats = NDArray[np.float64]


def coloured(rng: np.random.Generator, size: int, model: AllanModel) -> Floats:
    """One value a second: white, 1/f by shaping a spectrum, random walk by summing."""
    white = rng.normal(0.0, model.white, size)
    walk = np.cumsum(rng.normal(0.0, model.walk, size))
    frequency = np.fft.rfftfreq(size, 1.0)
    # Two-sided PSD B^2 / (2 pi f): the DFT of a unit-rate series has E|X|^2 = size * S(f).
    density = np.zeros_like(frequency)
    density[1:] = model.flicker**2 / (2.0 * math.pi * frequency[1:])
    spectrum = np.sqrt(size * density / 2.0) * (rng.normal(size=len(frequency)) + 1j * rng.normal(size=len(frequency)))
    return np.asarray(white + walk + np.fft.irfft(spectrum, size))


def test_phi_has_its_documented_value_and_is_stable_at_both_ends() -> None:
    assert math.isclose(float(phi(1.0)), 4.0 * math.log(2.0), rel_tol=1e-12)
    # The printed form, in extended precision, where it does not cancel.
    for ratio in (0.01, 0.5, 3.0, 18.0):
        r = np.longdouble(ratio)
        printed = ((1 + r) ** 2 * np.log(1 + r) - r**2 * np.log(r)) / r - np.log(r)
        assert math.isclose(float(phi(ratio)), float(printed), rel_tol=1e-12)
    # Expanded by hand: 1 - ln r for small r, 1 + ln r for large r, with relative errors of order r ln r and 1 / r.
    assert math.isclose(float(phi(1e-9)), 1.0 - math.log(1e-9), rel_tol=1e-6)
    assert math.isclose(float(phi(1e9)), 1.0 + math.log(1e9), rel_tol=1e-6)


# Method 2.2: N, A, then sigma of the mean for the next 180 s after 10, 30, 60 s, then best T and its sigma.
TABLE = [
    (7.1, 3.0, (5.8, 5.0, 4.7), 131.0, 4.6),
    (35.6, 2.0, (11.8, 7.3, 5.6), 455.0, 3.7),
    (20.4, 8.0, (15.6, 13.5, 12.7), 134.0, 12.3),
    (120.0, 25.0, (58.5, 46.0, 42.0), 163.0, 39.0),
    (49.5, 10.0, (23.7, 18.6, 16.8), 167.0, 15.8),
    (124.0, 20.0, (53.0, 40.0, 35.0), 188.0, 32.0),
    (63.0, 13.0, (30.5, 24.0, 21.7), 167.0, 20.5),
]


@pytest.mark.parametrize(("white", "floor", "sigmas", "best_s", "best_sigma"), TABLE)
def test_v_of_t_and_h_is_the_published_table(
    white: float, floor: float, sigmas: tuple[float, ...], best_s: float, best_sigma: float
) -> None:
    model = allan_model(white, floor)
    for seconds, sigma in zip((10.0, 30.0, 60.0), sigmas, strict=True):
        assert math.sqrt(use_variance(model, seconds, 180.0)) == pytest.approx(sigma, rel=0.012)
    times = np.arange(5.0, 1000.0)
    found = [use_variance(model, float(seconds), 180.0) for seconds in times]
    assert times[int(np.argmin(found))] == pytest.approx(best_s, rel=0.03)
    assert math.sqrt(min(found)) == pytest.approx(best_sigma, rel=0.012)


@pytest.mark.parametrize("parts", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.1), (2.0, 0.5, 0.03)])
def test_v_of_t_and_h_predicts_made_noise(parts: tuple[float, float, float]) -> None:
    model = AllanModel(*parts)
    rng = np.random.default_rng(11)
    mean_s, horizon_s = 20, 60
    misses: list[float] = []
    for _ in range(12):
        series = coloured(rng, 1 << 15, model)
        total = np.concatenate([[0.0], np.cumsum(series)])
        start = np.arange(0, len(series) - mean_s - horizon_s, 40)
        past = (total[start + mean_s] - total[start]) / mean_s
        coming = (total[start + mean_s + horizon_s] - total[start + mean_s]) / horizon_s
        misses.append(float(np.mean(np.square(past - coming))))
    # V leaves out the white noise of the future mean: it is about the bias, not about the next reading.
    expected = use_variance(model, float(mean_s), float(horizon_s)) + model.white**2 / horizon_s
    assert float(np.mean(misses)) == pytest.approx(expected, rel=0.08)


def test_allan_variance_does_not_pair_over_holes() -> None:
    slots = np.array([0, 1, 2, 10, 11, 12])
    values = np.array([0.0, 1.0, 0.0, 100.0, 101.0, 100.0])[:, None]
    variance, freedom = allan_variance(slots, values, 1)
    assert float(variance[0]) == pytest.approx(0.5)
    assert freedom > 0.0
    alone, none = allan_variance(np.array([0, 2, 4]), values[:3], 1)
    assert none == 0.0
    assert not alone.any()


@pytest.mark.parametrize(("freedom", "quantile"), [(4, 2.7764), (6, 2.4469), (10, 2.2281), (30, 2.0423), (60, 2.0003)])
def test_student_ratio_is_the_tabled_one(freedom: float, quantile: float) -> None:
    assert student_ratio(freedom) == pytest.approx(quantile / 1.95996, rel=0.03)
    assert student_ratio(0.0) == 3.0


def test_profiles_carry_the_catalogue() -> None:
    icm = noise_profile("icm42688p")
    assert icm.gyro.white == pytest.approx(7.1 * DEG_H)
    assert icm.gyro.floor == pytest.approx(3.0 * DEG_H)
    assert icm.accel.white == pytest.approx(49.5e-3 * MG)
    # K reaches the floor at 1000 s: K^2 t / 3.
    assert icm.gyro.walk**2 * 1000.0 / 3.0 == pytest.approx((3.0 * DEG_H) ** 2)
    assert noise_profile(None) is PROFILES["unknown"]
    for profile in PROFILES.values():
        assert use_variance(noise_profile(None).gyro, 1e9, 180.0) >= 0.99 * use_variance(profile.gyro, 1e9, 180.0)
