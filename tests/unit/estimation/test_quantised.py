"""Maximum likelihood under truncation against draws of known mean and sigma, and against sums written out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from companion.estimation.means.quantised import (
    EDGE_RMS,
    MIN_BEYOND_TWO,
    Cells,
    beyond_two,
    fit,
    shape_variance,
    truncation_edges,
)

Floats = NDArray[np.float64]


def counted(integers: Floats) -> tuple[NDArray[np.int64], Cells]:
    """(n, c) integers as cells, one a value."""
    lowest = integers.min(axis=0).astype(np.int64)
    place = integers.astype(np.int64) - lowest
    levels = int(place.max()) + 1
    counts = np.stack([np.bincount(column, minlength=levels) for column in place.T], axis=1)
    return lowest, Cells(truncation_edges(lowest, levels), counts.astype(np.float64))


def drawn(seed: int, mean: Floats | float, sigma: Floats | float, n: int, columns: int) -> Cells:
    rng = np.random.default_rng(seed)
    # int() of C and Python and trunc() of numpy all cut toward zero; this one is by hand.
    exact = rng.normal(mean, sigma, (n, columns))
    return counted(np.where(exact < 0.0, -np.floor(-exact), np.floor(exact)))[1]


def by_hand(cells: Cells, mean: float, sigma: float) -> float:
    """Log-likelihood of the first column, from the error function."""
    total = 0.0
    for low, high, count in zip(cells.edges[:-1, 0], cells.edges[1:, 0], cells.counts[:, 0], strict=True):
        if count:
            below, above = ((edge - mean) / (sigma * math.sqrt(2.0)) for edge in (low, high))
            total += count * math.log(0.5 * (math.erfc(below) - math.erfc(above)))
    return total


def test_the_edges_are_those_of_a_cut_toward_zero() -> None:
    edges = truncation_edges(np.array([-3]), 7)[:, 0]
    for value in np.linspace(-3.995, 3.995, 800).tolist():
        cell = int(np.searchsorted(edges, value)) - 1
        assert cell - 3 == int(value)


def test_cells_of_several_integers_have_the_edges_of_their_ends() -> None:
    fine = truncation_edges(np.array([-6]), 12)[:, 0]
    assert truncation_edges(np.array([-6]), 4, 3)[:, 0].tolist() == fine[::3].tolist()


@pytest.mark.parametrize(("mean", "sigma"), [(0.6, 0.6), (-1.1, 0.35), (0.05, 0.6), (2.5, 1.3), (-40.3, 0.5)])
def test_no_other_mean_and_sigma_are_likelier(mean: float, sigma: float) -> None:
    cells = drawn(1, mean, sigma, 3000, 1)
    found = fit(cells)
    best = by_hand(cells, float(found.mean[0]), float(found.sigma[0]))
    for off_mean in np.linspace(-0.2, 0.2, 21):
        for off_sigma in np.linspace(-0.15, 0.15, 21):
            other = by_hand(cells, float(found.mean[0]) + off_mean, float(found.sigma[0]) + off_sigma)
            assert other <= best + 1e-6


@pytest.mark.parametrize("sigma", [0.3, 0.386, 0.5, 0.75, 1.0, 2.0])
@pytest.mark.parametrize("n", [2000, 6000])
def test_the_standard_error_is_the_error_over_the_whole_range_of_means(sigma: float, n: int) -> None:
    """400 draws with means all over -3..3 LSB, the dead band in the middle of them."""
    means = np.random.default_rng(n).uniform(-3.0, 3.0, 400)
    found = fit(drawn(int(1000 * sigma), means, sigma, n, 400))
    pulls = ((found.mean - means) / np.sqrt(found.variance))[found.identified]
    assert len(pulls) > 100
    # The standard error of an rms of 100 is 7 %.
    assert 0.85 < math.sqrt(float(np.mean(np.square(pulls)))) < 1.15
    assert abs(float(np.mean(pulls))) < 4.0 / math.sqrt(len(pulls))
    assert float(np.abs(pulls).max()) < 4.5


def test_a_barely_occupied_third_value_has_an_honest_error_from_the_least_share_on() -> None:
    """Just above the limit, where the luck of a dozen readings decides; twice as noisy as asked for would be 2."""
    rng = np.random.default_rng(5)
    pulls: list[float] = []
    for seed in range(12):
        means = rng.uniform(-2.0, 2.0, 400)
        cells = drawn(seed, means, rng.uniform(0.25, 0.4), 6000, 400)
        found = fit(cells)
        rare = found.identified & (beyond_two(cells.counts) < 2.0 * MIN_BEYOND_TWO)
        pulls += ((found.mean - means) / np.sqrt(found.variance))[rare].tolist()
    assert len(pulls) > 150
    assert 0.85 < math.sqrt(float(np.mean(np.square(pulls)))) < 1.15


def test_the_mean_and_its_error_in_the_case_that_was_measured_on_a_real_autopilot() -> None:
    """Autopilots 9.3.1, case A with 0.23 mrad/s and sigma from HIGHRES_IMU: 3.5 deg/h; accelerometer ML: 6 ug."""
    gyro_deg_h = 1e-3 * math.degrees(1.0) * 3600.0
    means = np.tile([0.532, -0.324, 0.779], 100)
    found = fit(drawn(6, means, 0.23, 6000, 300), sigma=np.full(300, 0.23))
    known = found.identified
    assert known.mean() > 0.6
    off = (found.mean - means)[known] * gyro_deg_h
    assert math.sqrt(float(np.mean(np.square(off)))) < 5.0
    accel = np.tile([88.1, 51.4, -994.3], 100)
    found = fit(drawn(7, accel, 0.33, 6000, 300))
    off = (found.mean - accel)[found.identified] * 1000.0
    assert math.sqrt(float(np.mean(np.square(off)))) < 9.0


def test_a_wrong_sigma_is_worse_than_none() -> None:
    """Autopilots 9.3.2: 0.386 estimated 2.2 deg/h; fixed at 0.33 or 0.42 some 14 deg/h off."""
    cells = drawn(8, 0.5, 0.5, 15000, 50)
    free = fit(cells)
    assert free.identified.all()
    own = np.abs(free.mean - 0.5).mean()
    right = np.abs(fit(cells, np.full(50, 0.5)).mean - 0.5).mean()
    wrong = np.abs(fit(cells, np.full(50, 0.42)).mean - 0.5).mean()
    assert right < own < wrong


def test_two_integers_are_not_enough_without_a_sigma_and_are_with_one() -> None:
    cells = Cells(truncation_edges(np.array([5, 5]), 2), np.array([[700.0, 700.0], [300.0, 300.0]]))
    assert not fit(cells).identified.any()
    found = fit(cells, np.array([0.1, math.nan]))
    assert found.identified.tolist() == [True, False]
    # 30 % lie above 6: the mean is 0.5244 sigma below it.
    assert found.mean[0] == pytest.approx(6.0 - 0.524401 * 0.1, abs=1e-5)
    # One integer alone: no mean, whatever the sigma.
    one = Cells(truncation_edges(np.array([5]), 1), np.array([[1000.0]]))
    assert not fit(one, np.array([0.3])).identified.any()


@example(lowest=0, counts=[1, 1, *[0] * 17], sigma=1.0000000000000002e-06)
@settings(max_examples=200)
@given(
    lowest=st.integers(-40000, 40000),
    counts=st.lists(st.integers(0, 5000), min_size=1, max_size=40),
    sigma=st.none() | st.floats(1e-6, 1e6),
)
def test_nothing_is_ever_nan(lowest: int, counts: list[int], sigma: float | None) -> None:
    cells = Cells(truncation_edges(np.array([lowest]), len(counts)), np.array(counts, dtype=np.float64)[:, None])
    with np.errstate(all="raise", under="ignore"):
        found = fit(cells, None if sigma is None else np.array([sigma]))
        shape, edge = shape_variance(cells, found, np.ones(1))
    for figure in (found.mean, found.sigma, found.variance, found.influence, shape, edge):
        assert np.isfinite(figure).all()
    if found.identified[0] and sigma is None:
        values = np.flatnonzero(counts) + lowest
        assert values[0] - 1.0 <= found.mean[0] <= values[-1] + 1.0


@settings(max_examples=50)
@given(mean=st.floats(-3.0, 3.0), sigma=st.floats(0.3, 2.0), seed=st.integers(0, 10**6))
def test_the_mirror_image_has_the_mirrored_mean(mean: float, sigma: float, seed: int) -> None:
    exact = np.random.default_rng(seed).normal(mean, sigma, (4000, 1))
    one, other = fit(counted(np.trunc(exact))[1]), fit(counted(np.trunc(-exact))[1])
    assert one.identified[0] == other.identified[0]
    if one.identified[0]:
        assert other.mean[0] == pytest.approx(-one.mean[0], abs=1e-6)
        assert other.variance[0] == pytest.approx(one.variance[0], rel=1e-4)


def test_a_tail_forty_sigmas_away_is_finite() -> None:
    # A mean at 5.5 with sigma 0.3, and a hundred readings of a fault at 17: what it moves is finite and upward.
    counts = np.zeros((14, 1))
    counts[[0, 1, 2, 13], 0] = 50.0, 900.0, 50.0, 100.0
    found = fit(Cells(truncation_edges(np.array([4]), 14), counts), np.array([0.3]))
    assert math.isfinite(float(found.mean[0]))
    assert found.mean[0] > 5.5


def test_gaussian_noise_shows_no_displaced_edges() -> None:
    means = np.random.default_rng(9).uniform(-3.0, 3.0, 200)
    for sigma in (0.5, 1.0, 2.0):
        cells = drawn(10, means, sigma, 6000, 200)
        found = fit(cells)
        _, edge = shape_variance(cells, found, np.ones(200))
        assert np.mean(edge > EDGE_RMS) < 0.05


@pytest.mark.parametrize("sigma", [0.386, 0.546, 0.8])
def test_a_coarser_step_cut_inside_the_sensor_is_covered(sigma: float) -> None:
    """PX4's simulated IMU 0: 2000 deg/s in 16 bits, cut, then cut to mrad/s (autopilots 9.3.2: 15 deg/h)."""
    means = np.random.default_rng(11).uniform(-1.2, 1.2, 200)
    inner = 2000.0 / 32768.0 * math.pi / 180.0 * 1e3
    exact = np.random.default_rng(12).normal(means, sigma, (15000, 200))
    cells = counted(np.trunc(np.trunc(exact / inner) * inner * (1.0 + 1e-9)))[1]
    found = fit(cells)
    shape, _ = shape_variance(cells, found, np.ones(200))
    pulls = ((found.mean - means) / np.sqrt(found.variance + shape))[found.identified]
    assert len(pulls) > 50
    assert math.sqrt(float(np.mean(np.square(pulls)))) < 1.5


def test_an_inner_step_that_is_rounded_shows_in_the_shape() -> None:
    exact = np.random.default_rng(13).normal(0.5, 0.8, (15000, 20))
    cells = counted(np.trunc(np.rint(exact / 1.0653) * 1.0653))[1]
    found = fit(cells)
    shape, edge = shape_variance(cells, found, np.ones(20))
    assert (edge > 2.0 * EDGE_RMS).all()
    pulls = (found.mean - 0.5) / np.sqrt(found.variance + shape)
    assert math.sqrt(float(np.mean(np.square(pulls)))) < 2.0
