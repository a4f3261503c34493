"""Windows of truncated streams against the truth they were cut from: means, sigmas, ramps, knocks, refusals."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from companion.config.sections import NoiseProfile
from companion.estimation.collector.outlook import is_enough
from companion.estimation.means.windows import ImuEstimate, ImuInput, imu_estimates, integer_steps
from companion.estimation.seconds.batch import MAX_LEVELS, Batch, BatchSource
from companion.physics.units import DEG_H, MG
from companion.recording.messages import encode
from tests.support.still_aircraft import QUIET, imu, settings

Floats = NDArray[np.float64]

MRAD = 1e-3
STEPS = np.repeat([MRAD, MG], 3)
LSB_DEG_H = MRAD / DEG_H
GRAVITY_LSB = np.array([0.0, 0.0, 0.0, 87.3, 52.4, -995.2])


def stream(profile: NoiseProfile = QUIET) -> ImuInput:
    return imu("fc2", profile, gyro_step_rad_s=MRAD, accel_step_m_s2=MG, truncates=True)


def batches_of(exact_lsb: Floats, rate_hz: int = 100, *, split: int | None = None) -> list[Batch]:
    """(n, 6) exact readings in LSB, cut and collected second by second; the first second is not whole and is lost."""
    source = BatchSource((1e3,) * 3 + (1e4,) * 3, 4000)
    source.steps = integer_steps(stream())
    cut = np.where(exact_lsb < 0.0, -np.floor(-exact_lsb), np.floor(exact_lsb)) * STEPS
    times = 99.5 + (np.arange(len(cut)) + 0.5) / rate_hz
    for index, (t_s, row) in enumerate(zip(times.tolist(), cut.tolist(), strict=True)):
        source.add(t_s, tuple(row))
        if split is not None and index % split == 0:
            source.close_before(t_s - 0.25)
    source.close_before(1e9)
    return list(source.batches.values())


def white(rng: np.random.Generator, mean: Floats, sigma: float, seconds: int, rate_hz: int = 100) -> Floats:
    return rng.normal(mean, sigma, ((seconds + 1) * rate_hz, 6))


def filtered(
    rng: np.random.Generator, mean: Floats, sigma: float, seconds: int, rate_hz: int, cutoff_hz: float
) -> Floats:
    """As behind an autopilot's low-pass: neighbouring readings are alike."""
    keep = math.exp(-2.0 * math.pi * cutoff_hz / rate_hz)
    noise = rng.normal(size=((seconds + 1) * rate_hz, 6))
    state = np.zeros(6)
    rows = np.empty_like(noise)
    for index, kick in enumerate(noise):
        state = keep * state + math.sqrt(1.0 - keep**2) * kick
        rows[index] = state
    return mean + sigma * rows


def estimate(batches: list[Batch], profile: NoiseProfile = QUIET) -> ImuEstimate:
    return imu_estimates([stream(profile)], [batches], end_s=batches[-1].slot + 1.0, horizon_s=180.0, rejected=0)[0]


def errors(found: ImuEstimate, mean_lsb: Floats) -> Floats:
    """(6,) in LSB."""
    window = found.window
    found_lsb: Floats = np.concatenate([window.gyro_rad_s, window.accel_m_s2]) / STEPS
    return found_lsb - mean_lsb


def sigmas(found: ImuEstimate) -> Floats:
    window = found.window
    found_lsb: Floats = np.concatenate([window.gyro_sigma_stat_rad_s, window.accel_sigma_stat_m_s2]) / STEPS
    return found_lsb


def unknown(found: ImuEstimate) -> NDArray[np.bool_]:
    return found.own.undecided


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
        whites = np.sqrt(found.own.white_variance) / STEPS
        pulls += (errors(found, mean) / whites)[~unknown(found)].tolist()
    assert len(pulls) > 50
    assert 0.75 < math.sqrt(np.mean(np.square(pulls))) < 1.2


def test_chunking_does_not_matter() -> None:
    rng = np.random.default_rng(3)
    exact = white(rng, 0.7 + GRAVITY_LSB, 0.45, 30)
    one, other = estimate(batches_of(exact)), estimate(batches_of(exact, split=7))
    assert encode(one.window) == encode(other.window)


def test_a_ramp_is_followed_to_its_end() -> None:
    """3 (deg/h)/s, more than was ever seen, through a second edge of the integers."""
    rng = np.random.default_rng(4)
    slope = 2.0 / LSB_DEG_H
    exact = white(rng, 0.8 + GRAVITY_LSB, 0.5, 60)
    exact[:, 0] += slope * (np.arange(len(exact)) / 100.0 - 60.5)
    found = estimate(batches_of(exact))
    off = errors(found, 0.8 + GRAVITY_LSB)
    assert abs(off[0]) * LSB_DEG_H < 15.0
    assert any("drifts" in line for line in found.window.drifting)
    assert not found.own.lines.ramp[1:3].any()


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


def test_one_wild_reading_does_no_harm() -> None:
    rng = np.random.default_rng(6)
    exact = white(rng, 0.6 + GRAVITY_LSB, 0.6, 30)
    exact[1500, 1] = 700.0
    exact[1600, 4] = -30000.0
    found = estimate(batches_of(exact))
    assert np.abs(errors(found, 0.6 + GRAVITY_LSB)).max() < 0.08
    assert max(len(batch.counts.table) for batch in batches_of(exact) if batch.counts is not None) <= MAX_LEVELS


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
        assert found.window.refused("gyro") is None
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
    assert "half a step" in found.window.hidden["gyro"].words
    assert found.window.refused("gyro") is None
    # More seconds may bring the third value: never enough before the time is up.
    assert not is_enough(settings(), [found])


@pytest.mark.parametrize("mean", [0.5, -0.4, 0.97, -1.02, 0.0])
def test_two_values_or_one_around_zero_are_refused_with_what_to_do(mean: float) -> None:
    rng = np.random.default_rng(9)
    lsb = np.array([mean, 5.3, -4.1, *GRAVITY_LSB[3:]])
    found = estimate(batches_of(white(rng, lsb, 0.05, 20)))
    window = found.window
    refused = window.refused("gyro")
    assert refused is not None
    assert "fc2 x" in refused
    assert "push.dither" in refused
    assert window.refused("accel") is None
    assert abs(errors(found, lsb)[0]) <= sigmas(found)[0] + 1e-9


def test_the_seconds_of_an_integer_stream_keep_their_counts_and_those_of_floats_do_not() -> None:
    exact = white(np.random.default_rng(10), 0.5 + GRAVITY_LSB, 0.4, 3)
    for batch in batches_of(exact):
        assert batch.counts is not None
        assert batch.counts.table.sum(axis=0).tolist() == [batch.n] * 6
    assert integer_steps(imu()) is None
    assert integer_steps(imu(gyro_step_rad_s=MRAD)) is None


GRID_LSB = np.repeat([math.radians(2000.0 / 32768.0) / MRAD, 1000.0 / 2048.0], 3)
"""A sensor of 16 bits, 2000 deg/s and 16 g."""


def pulls_with_steps_inside(grid: bool) -> Floats:
    """Errors over stated sigmas, (n, 6), NaN where unknown: three rounded readings, meaned 1 2 1, cut."""
    rng = np.random.default_rng(21)
    gyro, accel = (GRID_LSB[[0, 3]] / 4.0 * STEPS[[0, 3]]).tolist() if grid else (0.0, 0.0)
    input_ = msgspec.structs.replace(stream(), gyro_grid_rad_s=gyro, accel_grid_m_s2=accel)
    found = []
    for _ in range(12):
        mean = rng.uniform(-6.0, 6.0, 6) + GRAVITY_LSB
        noise = np.repeat([0.546, 0.78], 3)
        raw = np.rint((mean + rng.normal(0.0, noise, (6102, 6))) / GRID_LSB) * GRID_LSB
        batches = batches_of((raw[2:] + 2.0 * raw[1:-1] + raw[:-2]) / 4.0 + 1e-9 * np.sign(mean))
        result = imu_estimates([input_], [batches], end_s=batches[-1].slot + 1.0, horizon_s=180.0, rejected=0)[0]
        assert grid or "coarse steps of its own" not in str(result.window.hidden)
        assert not grid or unknown(result)[:3].any() or "coarse steps of its own" in str(result.window.hidden)
        found.append(np.where(unknown(result), np.nan, errors(result, mean) / sigmas(result)))
    return np.array(found)


def test_steps_of_the_sensors_own_below_the_integers_are_in_sigma_where_they_are_known() -> None:
    known, not_known = pulls_with_steps_inside(grid=True), pulls_with_steps_inside(grid=False)
    assert np.isfinite(known[:, :3]).sum() > 25
    assert np.sqrt(np.nanmean(np.square(not_known[:, :3]))) > 1.2  # what it is about
    for pulls in (known[:, :3], known[:, 3:]):
        assert 0.3 < np.sqrt(np.nanmean(np.square(pulls))) < 1.0
        assert np.nanmax(np.abs(pulls)) < 2.0
