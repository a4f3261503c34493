"""Truncated streams against the truth that they were cut from: windows, then the fit against sums by hand."""

from __future__ import annotations

import math

import hypothesis
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from companion.config.sections import NoiseProfile
from companion.estimation.collector.measurement import is_enough
from companion.estimation.means.integers import MIN_BEYOND_TWO, fit, shape_variance, truncation_edges
from companion.estimation.means.windows import Estimate, ImuInput, ImuWindow, imu_window
from companion.estimation.seconds.batch import Batch, BatchSource
from companion.physics.units import DEG_H, MG
from tests.support.still_aircraft import QUIET, imu, settings

Floats = NDArray[np.float64]

MRAD = 1e-3
STEPS = np.repeat([MRAD, MG], 3)
LSB_DEG_H = MRAD / DEG_H
GRAVITY_LSB = np.array([0.0, 0.0, 0.0, 87.3, 52.4, -995.2])


def stream(profile: NoiseProfile = QUIET) -> ImuInput:
    return imu("fc2", profile, gyro_step_rad_s=MRAD, accel_step_m_s2=MG)


def batches_of(exact_lsb: Floats, rate_hz: int = 100) -> list[Batch]:
    """(n, 6) exact readings in LSB, cut and collected second by second; the first second is not whole and is lost."""
    source = BatchSource((1e3,) * 3 + (1e4,) * 3, 4000)
    source.steps = stream().steps
    cut = np.where(exact_lsb < 0.0, -np.floor(-exact_lsb), np.floor(exact_lsb)) * STEPS
    times = 99.5 + (np.arange(len(cut)) + 0.5) / rate_hz
    for t_s, row in zip(times.tolist(), cut.tolist(), strict=True):
        source.add(t_s, tuple(row))
    source.close_before(1e9)
    return list(source.batches.values())


def white(rng: np.random.Generator, mean: Floats, sigma: float, seconds: int, rate_hz: int = 100) -> Floats:
    return rng.normal(mean, sigma, ((seconds + 1) * rate_hz, 6))


def filtered(
    rng: np.random.Generator, mean: Floats, sigma: float, seconds: int, rate_hz: int, cutoff_hz: float
) -> Floats:
    """Noise behind an autopilot's low-pass: neighbouring readings are alike."""
    keep = math.exp(-2.0 * math.pi * cutoff_hz / rate_hz)
    noise = rng.normal(size=((seconds + 1) * rate_hz, 6))
    state = np.zeros(6)
    rows = np.empty_like(noise)
    for index, kick in enumerate(noise):
        state = keep * state + math.sqrt(1.0 - keep**2) * kick
        rows[index] = state
    return mean + sigma * rows


Found = tuple[Estimate, ImuWindow]


def estimate(batches: list[Batch], profile: NoiseProfile = QUIET) -> Found:
    return imu_window(stream(profile), batches, end_s=batches[-1].slot + 1.0, horizon_s=180.0, rejected=0)


def errors(found: Found, mean_lsb: Floats) -> Floats:
    """(6,) in LSB."""
    window = found[1]
    found_lsb: Floats = np.concatenate([window.gyro_rad_s, window.accel_m_s2]) / STEPS
    return found_lsb - mean_lsb


def sigmas(found: Found) -> Floats:
    window = found[1]
    found_lsb: Floats = np.concatenate([window.gyro_sigma_stat_rad_s, window.accel_sigma_stat_m_s2]) / STEPS
    return found_lsb


def unknown(found: Found) -> NDArray[np.bool_]:
    return found[0].undecided


@pytest.mark.parametrize("sigma", [0.3, 0.386, 0.5, 1.0])
def test_a_minute_of_truncated_noise_is_within_15_deg_h_and_150_ug_where_it_tells_at_all(sigma: float) -> None:
    rng = np.random.default_rng(int(1000 * sigma))
    naive, ours, scaled = [], [], []
    for _ in range(15):
        mean = rng.uniform(-3.0, 3.0, 6) + GRAVITY_LSB
        batches = batches_of(white(rng, mean, sigma, 60))
        found = estimate(batches)
        known = ~unknown(found)
        off = errors(found, mean)
        ours += off[known].tolist()
        scaled += (off / sigmas(found))[known].tolist()
        naive += (np.mean([batch.mean for batch in batches], axis=0) / STEPS - mean)[known].tolist()
        # What is not known by its own readings says so in its sigma.
        assert (np.abs(off) < 3.0 * sigmas(found))[~known].all()
        assert (sigmas(found)[~known] > sigmas(found)[known].min(initial=1.0)).all()
    assert len(ours) > 30
    assert max(map(abs, ours)) * LSB_DEG_H < 15.0
    assert max(map(abs, ours)) < 0.15
    assert max(map(abs, naive)) * LSB_DEG_H > 60.0
    assert math.sqrt(np.mean(np.square(scaled))) < 1.0


@pytest.mark.parametrize(("rate_hz", "cutoff_hz"), [(100, 20.0), (250, 20.0)])
def test_noise_behind_a_filter_widens_sigma_by_what_it_scatters_from_second_to_second(
    rate_hz: int, cutoff_hz: float
) -> None:
    rng = np.random.default_rng(rate_hz)
    pulls = []
    for _ in range(12):
        mean = rng.uniform(-3.0, 3.0, 6) + GRAVITY_LSB
        found = estimate(batches_of(filtered(rng, mean, 0.6, 30, rate_hz, cutoff_hz), rate_hz))
        whites = np.sqrt(found[0].white_variance) / STEPS
        pulls += (errors(found, mean) / whites)[~unknown(found)].tolist()
    assert len(pulls) > 50
    assert 0.75 < math.sqrt(np.mean(np.square(pulls))) < 1.2


def test_a_ramp_is_followed_to_its_end() -> None:
    """3 (deg/h)/s, more than was ever seen, through a second edge of the integers."""
    rng = np.random.default_rng(4)
    slope = 2.0 / LSB_DEG_H
    exact = white(rng, 0.8 + GRAVITY_LSB, 0.5, 60)
    exact[:, 0] += slope * (np.arange(len(exact)) / 100.0 - 60.5)
    found = estimate(batches_of(exact))
    off = errors(found, 0.8 + GRAVITY_LSB)
    assert abs(off[0]) * LSB_DEG_H < 15.0
    assert any("drifts" in line for line in found[1].drifting)
    assert not found[0].warming.ramp[1:3].any()


def test_a_knock_of_three_seconds_moves_the_mean_by_less_than_its_sigma() -> None:
    rng = np.random.default_rng(5)
    calm = white(rng, 0.6 + GRAVITY_LSB, 0.6, 60)
    knocked = calm.copy()
    knocked[2000:2300] += 1.5
    before, after = estimate(batches_of(calm)), estimate(batches_of(knocked))
    moved = errors(after, GRAVITY_LSB) - errors(before, GRAVITY_LSB)
    # A plain mean would move by 0.075.
    assert np.abs(moved).max() < 0.03
    assert (np.abs(errors(after, 0.6 + GRAVITY_LSB)) < 2.0 * sigmas(after)).all()


@pytest.mark.parametrize("sigma", [5.0, 40.0])
def test_wide_noise_around_zero_is_freed_of_the_double_width_of_zero(sigma: float) -> None:
    rng = np.random.default_rng(7)
    scaled = []
    for _ in range(10):
        mean = rng.uniform(-3.0, 3.0, 6)
        found = estimate(batches_of(white(rng, mean, sigma, 30)))
        scaled += (errors(found, mean) / sigmas(found)).tolist()
    assert 0.7 < math.sqrt(np.mean(np.square(scaled))) < 1.25


def test_an_axis_of_two_values_takes_the_noise_of_its_neighbours_with_a_tenth_of_doubt() -> None:
    """x at 0.4 shows 0 and 1 alone, its neighbours three values."""
    rng = np.random.default_rng(12)
    scaled = []
    lsb = np.array([0.4, 1.6, -2.4, *GRAVITY_LSB[3:]])
    for _ in range(20):
        ratio = 1.0 + 0.1 * rng.standard_normal()
        exact = white(rng, np.zeros(6), 0.3, 60)
        exact[:, 0] *= ratio
        found = estimate(batches_of(exact + lsb))
        assert found[1].refused("gyro") is None
        assert unknown(found)[:3].tolist() == [True, False, False]
        off = errors(found, lsb)[0]
        assert abs(off) * LSB_DEG_H < 60.0
        scaled.append(off / sigmas(found)[0])
    assert math.sqrt(np.mean(np.square(scaled))) < 1.3


def test_two_distinct_values_off_zero_cost_half_a_step_and_a_warning() -> None:
    rng = np.random.default_rng(8)
    found = estimate(batches_of(white(rng, 5.8 + GRAVITY_LSB, 0.05, 20)))
    off = errors(found, 5.8 + GRAVITY_LSB)
    assert unknown(found).all()
    assert np.abs(off).max() <= 0.5
    assert sigmas(found) == pytest.approx([0.5] * 6, rel=0.02)
    assert "half a step" in found[1].hidden["gyro"]
    assert found[1].refused("gyro") is None
    # More seconds may bring the third value: never enough before the time is up.
    assert not is_enough(settings(), [found[0]])


@pytest.mark.parametrize("mean", [0.5, -0.4, 0.97, -1.02, 0.0])
def test_two_values_or_one_around_zero_are_refused_with_what_to_do(mean: float) -> None:
    rng = np.random.default_rng(9)
    lsb = np.array([mean, 5.3, -4.1, *GRAVITY_LSB[3:]])
    found = estimate(batches_of(white(rng, lsb, 0.05, 20)))
    window = found[1]
    refused = window.refused("gyro")
    assert refused is not None
    assert "fc2 x" in refused
    assert "companion autopilot script" in refused
    assert window.refused("accel") is None
    assert abs(errors(found, lsb)[0]) <= sigmas(found)[0] + 1e-9


# --- the fit

Cells = tuple[Floats, Floats]


def counted(integers: Floats) -> Cells:
    """Edges and counts of (n, c) integers."""
    lowest = integers.min(axis=0).astype(np.int64)
    place = integers.astype(np.int64) - lowest
    levels = int(place.max()) + 1
    counts = np.stack([np.bincount(column, minlength=levels) for column in place.T], axis=1)
    return truncation_edges(lowest, levels), counts.astype(np.float64)


def drawn(seed: int, mean: Floats | float, sigma: Floats | float, n: int, columns: int) -> Cells:
    rng = np.random.default_rng(seed)
    # int() of C and Python and trunc() of numpy all cut toward zero; this one is by hand.
    exact = rng.normal(mean, sigma, (n, columns))
    return counted(np.where(exact < 0.0, -np.floor(-exact), np.floor(exact)))


def test_the_edges_are_those_of_a_cut_toward_zero() -> None:
    edges = truncation_edges(np.array([-3]), 7)[:, 0]
    for value in np.linspace(-3.995, 3.995, 800).tolist():
        cell = int(np.searchsorted(edges, value)) - 1
        assert cell - 3 == int(value)


@pytest.mark.parametrize("sigma", [0.3, 0.386, 0.5, 0.75, 1.0, 2.0])
@pytest.mark.parametrize("n", [2000, 6000])
def test_the_standard_error_is_the_error_over_the_whole_range_of_means(sigma: float, n: int) -> None:
    """400 draws with means all over -3..3 LSB, the dead band in the middle of them."""
    means = np.random.default_rng(n).uniform(-3.0, 3.0, 400)
    found = fit(*drawn(int(1000 * sigma), means, sigma, n, 400))
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
        edges, counts = drawn(seed, means, rng.uniform(0.25, 0.4), 6000, 400)
        found = fit(edges, counts)
        rare = found.identified & (np.sort(counts, axis=0)[:-2].sum(axis=0) < 2.0 * MIN_BEYOND_TWO)
        pulls += ((found.mean - means) / np.sqrt(found.variance))[rare].tolist()
    assert len(pulls) > 150
    assert 0.85 < math.sqrt(float(np.mean(np.square(pulls)))) < 1.15


def test_two_integers_are_not_enough_without_a_sigma_and_are_with_one() -> None:
    cells = truncation_edges(np.array([5, 5]), 2), np.array([[700.0, 700.0], [300.0, 300.0]])
    assert not fit(*cells).identified.any()
    found = fit(*cells, np.array([0.1, math.nan]))
    assert found.identified.tolist() == [True, False]
    # 30 % lie above 6: the mean is 0.5244 sigma below it.
    assert found.mean[0] == pytest.approx(6.0 - 0.524401 * 0.1, abs=1e-5)
    # One integer alone: no mean, whatever the sigma.
    assert not fit(truncation_edges(np.array([5]), 1), np.array([[1000.0]]), np.array([0.3])).identified.any()


@hypothesis.example(lowest=0, counts=[1, 1, *[0] * 17], sigma=1.0000000000000002e-06)
@hypothesis.settings(max_examples=200)
@given(
    lowest=st.integers(-40000, 40000),
    counts=st.lists(st.integers(0, 5000), min_size=1, max_size=40),
    sigma=st.none() | st.floats(1e-6, 1e6),
)
def test_nothing_is_ever_nan(lowest: int, counts: list[int], sigma: float | None) -> None:
    edges = truncation_edges(np.array([lowest]), len(counts))
    with np.errstate(all="raise", under="ignore"):
        found = fit(edges, np.array(counts, dtype=np.float64)[:, None], None if sigma is None else np.array([sigma]))
        shape = shape_variance(found)
    for figure in (found.mean, found.sigma, found.variance, found.influence, shape):
        assert np.isfinite(figure).all()
    if found.identified[0] and sigma is None:
        values = np.flatnonzero(counts) + lowest
        assert values[0] - 1.0 <= found.mean[0] <= values[-1] + 1.0


@pytest.mark.parametrize("gripped_s", [1, 3, 5, 10])
@pytest.mark.parametrize("noise_lsb", [0.8, 1.5, 3.0])
def test_a_hand_on_the_aircraft_makes_no_bias_known(gripped_s: int, noise_lsb: float) -> None:
    rng = np.random.default_rng(gripped_s)
    mean = np.concatenate([[-0.43, -0.48, -0.35], GRAVITY_LSB[3:]])
    readings = white(rng, mean, 0.12, 60)
    readings[2000 : 2000 + 100 * gripped_s] += rng.normal(0.0, noise_lsb, (100 * gripped_s, 6))
    assert "gyro" in estimate(batches_of(readings))[1].useless
