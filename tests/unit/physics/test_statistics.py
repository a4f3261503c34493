"""Closed approximations of quantiles, against scipy's exact ones."""

from __future__ import annotations

import numpy as np
import pytest

from companion.physics.statistics import MAD_TO_SIGMA, chi_square_ratio, student_quantile


@pytest.mark.parametrize(
    ("sigmas", "freedom", "within"),
    [(2.0, 3.0, 0.013), (1.96, 4.0, 0.005), (4.0, 6.0, 0.026), (3.8906, 8.0, 0.011), (4.0, 30.0, 0.001)],
)
def test_students_quantile_is_as_improbable_as_so_many_sigmas(sigmas: float, freedom: float, within: float) -> None:
    from scipy import stats

    for degrees in (freedom, 1.3 * freedom, 10.0 * freedom, 1e4 * freedom):
        exact = stats.t.isf(stats.norm.sf(sigmas), degrees)
        assert exact * (1.0 - 1e-6) < student_quantile(sigmas, degrees) < exact * (1.0 + within)


@pytest.mark.parametrize(("sigmas", "within"), [(2.326, 0.003), (4.5, 0.07), (-0.6745, 0.013)])
def test_a_variance_scatters_as_chi_square(sigmas: float, within: float) -> None:
    from scipy import stats

    freedom = np.array([3.0, 4.5, 10.0, 100.0, 1e4])
    exact = stats.chi2.isf(stats.norm.sf(sigmas), freedom) / freedom
    assert chi_square_ratio(freedom, sigmas) == pytest.approx(exact, rel=within)


def test_the_median_deviation_of_a_normal_number() -> None:
    from scipy import stats

    assert pytest.approx(1.0 / stats.norm.isf(0.25), rel=1e-4) == MAD_TO_SIGMA
