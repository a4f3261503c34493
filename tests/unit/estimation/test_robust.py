"""Huber's mean and line against their definitions and against the figures of the method."""

from __future__ import annotations

import numpy as np
import pytest

from companion.estimation.noise.lines import HUBER_C, huber_line, huber_mean, robust_mean, slope_limit


def test_huber_mean_solves_its_own_equation() -> None:
    """Sum of psi(r / s) is zero, psi clipped at c, s the MAD about the median."""
    rng = np.random.default_rng(1)
    values = rng.standard_t(2.0, (61, 3))
    found = huber_mean(values)
    for column in range(3):
        x = values[:, column]
        scale = 1.4826 * np.median(np.abs(x - np.median(x)))
        psi = np.clip((x - found[column]) / scale, -HUBER_C, HUBER_C)
        assert abs(psi.mean()) < 2e-4


def test_line_without_noise_is_exact() -> None:
    times = np.arange(12.0) + 0.5
    line = huber_line(times, np.stack([3.0 + 0.25 * times, 7.0 - 0.0 * times], axis=1), 12.0)
    assert line.end == pytest.approx([6.0, 7.0])
    assert line.slope == pytest.approx([0.25, 0.0])
    assert abs(line.t_statistic[0]) > 1e3
    assert line.t_statistic[1] == 0.0


def test_line_survives_a_knock_and_its_end_has_the_said_variance() -> None:
    rng = np.random.default_rng(4)
    times = np.arange(40.0) + 0.5
    values = 0.5 * times[:, None] + rng.normal(0.0, 1.0, (40, 3000))
    line = huber_line(times, values, 40.0)
    # About four times the variance of a mean: twice its sigma.
    assert float(line.end_leverage.mean()) * 40.0 == pytest.approx(4.0, rel=0.15)
    assert float(np.mean(np.square(line.end - 20.0))) == pytest.approx(float(line.end_leverage.mean()), rel=0.12)
    values[37:] += 500.0
    knocked = huber_line(times, values, 40.0)
    assert float(np.abs(knocked.end - line.end).max()) < 6.0
    assert float(np.abs(knocked.end - line.end).mean()) < 1.5


@pytest.mark.parametrize(("count", "within"), [(10, 0.05), (30, 0.03), (60, 0.025)])
def test_the_robust_mean_is_within_a_few_per_cent_of_the_bound_where_nothing_knocks(count: int, within: float) -> None:
    """The bound is the plain mean's 1 / sqrt(n), attained by it in Gaussian noise (method 2.2)."""
    rng = np.random.default_rng(count)
    values = rng.normal(size=(count, 20_000))
    found = float(np.sqrt(np.mean(np.square(robust_mean(values))))) * np.sqrt(count)
    assert found < 1.0 + within
    assert found < float(np.sqrt(np.mean(np.square(huber_mean(values))))) * np.sqrt(count)


def test_the_robust_mean_is_the_plain_one_unless_a_value_stands_out() -> None:
    values = np.random.default_rng(4).uniform(-1.0, 1.0, (60, 2))
    np.testing.assert_allclose(robust_mean(values), values.mean(axis=0), rtol=1e-12)
    values[7, 0] += 10.0
    first, second = np.abs(robust_mean(values) - values.mean(axis=0)).tolist()
    assert first > 0.1
    assert second < 1e-12


def test_the_robust_mean_forgets_a_knock_that_hubers_feels() -> None:
    rng = np.random.default_rng(7)
    values = rng.normal(size=(60, 4000))
    values[20:23] += 300.0
    knocked = np.sqrt(np.mean(np.square(robust_mean(values)))) * np.sqrt(60.0)
    # What is left is a mean of 57.
    assert knocked == pytest.approx(np.sqrt(60.0 / 57.0), rel=0.05)
    assert float(np.sqrt(np.mean(np.square(huber_mean(values))))) * np.sqrt(60.0) > 1.2


@pytest.mark.parametrize("count", [8, 10, 15])
def test_the_limit_of_a_slope_in_a_short_window_is_students(count: int) -> None:
    from scipy import stats

    assert slope_limit(count) == pytest.approx(stats.t.isf(0.5e-5, count - 2), rel=0.04)
    assert slope_limit(60) == 6.0


def test_chance_seldom_makes_a_slope_of_ten_seconds() -> None:
    line = huber_line(np.arange(10.0), np.random.default_rng(9).normal(size=(10, 20_000)), 10.0)
    assert float(np.mean(np.abs(line.t_statistic) > slope_limit(10))) < 1e-3
    assert float(np.mean(np.abs(line.t_statistic) > 5.0)) > 2e-3
