"""Allan models against the published table and made noise; N, B and K of recordings against allantools too."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.config.sections import AllanModel
from companion.estimation.noise.allan import (
    PROFILES,
    AllanCurve,
    AxisFit,
    allan_model,
    allan_variance,
    curve,
    fit_axis,
    noise_profile,
    phi,
    predicted_sigma,
    student_ratio,
)
from companion.physics.units import DEG_H, MG
from tests.support.made_noise import FLICKER_OF_FLOOR, slow

Floats = NDArray[np.float64]


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
        assert predicted_sigma(model, seconds, 180.0) == pytest.approx(sigma, rel=0.012)
    times = np.arange(5.0, 1000.0)
    found = [predicted_sigma(model, float(seconds), 180.0) for seconds in times]
    assert times[int(np.argmin(found))] == pytest.approx(best_s, rel=0.03)
    assert min(found) == pytest.approx(best_sigma, rel=0.012)


@pytest.mark.parametrize("parts", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.1), (2.0, 0.5, 0.03)])
def test_v_of_t_and_h_predicts_made_noise(parts: tuple[float, float, float]) -> None:
    model = AllanModel(*parts)
    rng = np.random.default_rng(11)
    mean_s, horizon_s = 20, 60
    misses: list[float] = []
    for _ in range(12):
        series = slow(rng, 1 << 15, model.flicker, model.walk, model.white)
        total = np.concatenate([[0.0], np.cumsum(series)])
        start = np.arange(0, len(series) - mean_s - horizon_s, 40)
        past = (total[start + mean_s] - total[start]) / mean_s
        coming = (total[start + mean_s + horizon_s] - total[start + mean_s]) / horizon_s
        misses.append(float(np.mean(np.square(past - coming))))
    # V leaves out the white noise of the future mean: it is about the bias, not about the next reading.
    expected = predicted_sigma(model, float(mean_s), float(horizon_s)) ** 2 + model.white**2 / horizon_s
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
        assert predicted_sigma(noise_profile(None).gyro, 1e9, 180.0) >= 0.995 * predicted_sigma(
            profile.gyro, 1e9, 180.0
        )


# --- from recordings


def curve_of(*stretches: Floats) -> AllanCurve:
    return curve((np.arange(len(values)), values[:, None]) for values in stretches)


def test_the_deviations_are_those_of_allantools() -> None:
    import allantools  # most of a second, as scipy.stats: not at every collection

    values = slow(np.random.default_rng(1), 3000, 2.0, 0.05, 9.0)
    found = curve_of(values)
    taus, deviations, _, _ = allantools.oadev(values, rate=1.0, data_type="freq", taus=list(found.spans))
    assert list(taus) == list(found.spans)
    assert found.spans[-1] == 256
    np.testing.assert_allclose(np.sqrt(found.variance[:, 0]), deviations, rtol=1e-9)


def fits(seed: int, runs: int, seconds: int, white: float, floor: float, walk: float) -> list[AxisFit]:
    rng = np.random.default_rng(seed)
    made = [slow(rng, seconds, floor * FLICKER_OF_FLOOR, walk, white) for _ in range(runs)]
    return [fit_axis(curve_of(values), 0) for values in made]


@pytest.mark.parametrize(
    ("white", "floor", "walk"),
    [(147.0, 27.0, 1.5), (7.1, 3.0, 0.16), (35.6, 2.0, 0.5), (1.0, 0.0, 0.0)],
    ids=["ADIS16405", "ICM-42688-P", "little flicker", "white only"],
)  # fmt: skip
def test_the_figures_come_back_and_their_errors_are_as_said(white: float, floor: float, walk: float) -> None:
    truth = np.square([white, floor * FLICKER_OF_FLOOR, walk])
    found = fits(3, 40, 4000, white, floor, walk)
    off = np.array([np.square(fit.figures) - truth for fit in found])
    said = np.array([fit.sigmas for fit in found])
    pulls = off / said
    # Those that cannot become negative: on average right, and by so much as is said. Of 40, rms is good to 11 %.
    free = truth > 3.0 * said.mean(axis=0)
    assert free[0]
    assert np.abs(pulls[:, free].mean(axis=0)).max() < 0.55
    assert np.sqrt(np.square(pulls[:, free]).mean(axis=0)) == pytest.approx(1.0, abs=0.35)
    upper = np.array([fit.upper for fit in found])
    # One-sided 95 %: of 40, at least 34 (1 % of the draws have fewer).
    assert ((np.square(upper) >= truth * (1.0 - 1e-9)).sum(axis=0) > 33).all()
    known = np.array([fit.known for fit in found])
    assert known[:, 0].all()
    # What is not there is not told, and what is there by three standard errors is.
    assert (known[:, truth == 0.0].mean(axis=0) < 0.13).all()
    assert (known[:, truth > 5.0 * said.mean(axis=0)].mean(axis=0) > 0.9).all()


def test_more_sessions_tell_more_and_each_has_its_own_level() -> None:
    rng = np.random.default_rng(5)
    parts = [slow(rng, 1800, 3.0 * FLICKER_OF_FLOOR, 0.16, 7.1) + 1000.0 * number for number in range(8)]
    one, all_of_them = fit_axis(curve_of(parts[0]), 0), fit_axis(curve_of(*parts), 0)
    assert all_of_them.sigmas[1] < one.sigmas[1] / 2.0
    assert all_of_them.figures[1] / FLICKER_OF_FLOOR == pytest.approx(3.0, rel=0.15)


def test_what_never_changes_cannot_be_fitted() -> None:
    with pytest.raises(ValueError, match="never change"):
        fit_axis(curve_of(np.ones(100)), 0)
    with pytest.raises(ValueError, match="long enough"):
        curve_of(np.zeros(5))
