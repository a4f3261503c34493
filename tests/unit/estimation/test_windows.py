"""Are the sigmas honest? Coverage by Monte Carlo against noise of known N, B, K; ramps, steps, pose sensors."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from companion.config import parse
from companion.config.sections import AllanModel, NoiseProfile
from companion.configured.models import gyro_sigmas_deg_h
from companion.estimation.means.pose import heading_window, tilt_window
from companion.estimation.means.windows import SPOT_WALK, ImuInput, estimate, imu_window
from companion.estimation.noise.allan import PROFILES, noise_profile, predicted_sigma
from companion.estimation.seconds.batch import Batch
from companion.physics.frames import rotation_matrix
from companion.physics.units import DEG_H
from companion.samples import TRIADS, Triad, rows_of
from tests.support.made_noise import slow
from tests.support.still_aircraft import QUIET, imu

Floats = NDArray[np.float64]


def batches_of(means: Floats, *, spread: float = 1.0, n: int = 100) -> list[Batch]:
    """Batches with these (m, c) means; the inside of each second is plain."""
    width = means.shape[1]
    return [
        Batch(
            slot=100 + index,
            n=n,
            mean=row,
            variance=np.full(width, spread**2),
            white=np.full(width, spread**2),
            low=row - spread,
            high=row + spread,
            distinct=np.full(width, 50),
            clipped=False,
            largest_gap_s=0.01,
            missing=None,
            temperature_degc=None,
        )
        for index, row in enumerate(means)
    ]


def window_of(source: ImuInput, batches: list[Batch], horizon_s: float = 180.0):  # type: ignore[no-untyped-def]
    return imu_window(source, batches, end_s=batches[-1].slot + 1.0, horizon_s=horizon_s, rejected=0)[1]


@pytest.mark.parametrize("seconds", [10, 30, 60])
def test_sigma_stat_covers_the_truth_in_white_noise(seconds: int) -> None:
    rng = np.random.default_rng(seconds)
    inside = total = 0
    for _ in range(150):
        window = window_of(imu("fc", QUIET), batches_of(rng.normal(0.0, 2.0, (seconds, 6))))
        miss = np.abs(np.array(window.gyro_rad_s + window.accel_m_s2))
        sigma = np.array(window.gyro_sigma_stat_rad_s + window.accel_sigma_stat_m_s2)
        inside += int((miss < 1.96 * sigma).sum())
        total += 6
    assert 0.93 < inside / total < 0.975


@pytest.mark.parametrize(
    "model", [AllanModel(10.0, 4.0, 0.05), AllanModel(3.0, 6.0, 0.0), AllanModel(5.0, 0.01, 0.5)], ids=str
)
def test_sigma_use_covers_the_next_minutes(model: AllanModel) -> None:
    """The bias of the next H seconds, without the white noise of those readings: truth made apart from the readings."""
    rng = np.random.default_rng(2)
    seconds, horizon = 30, 90
    source = imu("fc", NoiseProfile("made", model, model))
    scaled = []
    for _ in range(120):
        bias = np.stack([slow(rng, 4096, model.flicker, model.walk) for _ in range(6)], axis=1)[
            2000 : 2000 + seconds + horizon
        ]
        readings = bias[:seconds] + rng.normal(0.0, model.white, (seconds, 6))
        window = window_of(source, batches_of(readings), float(horizon))
        found = np.array(window.gyro_rad_s + window.accel_m_s2)
        sigma = np.array(window.gyro_sigma_use_rad_s + window.accel_sigma_use_m_s2)
        scaled.append((found - bias[seconds:].mean(axis=0)) / sigma)
    errors = np.concatenate(scaled)
    assert 0.92 < float(np.mean(np.abs(errors) < 1.96)) < 0.99
    assert 0.75 < float(np.sqrt(np.mean(np.square(errors)))) < 1.1


def test_sigma_use_is_v_of_t_and_h_when_the_profile_rules() -> None:
    model = AllanModel(5.0, 4.0, 0.05)
    rng = np.random.default_rng(3)
    window = window_of(imu("fc", NoiseProfile("made", model, model)), batches_of(rng.normal(0.0, 0.5, (40, 6))))
    expected = predicted_sigma(model, 40.0, 180.0)
    assert window.gyro_sigma_use_rad_s == pytest.approx([expected] * 3)


def test_a_measured_floor_wins_where_it_is_more_than_the_profile() -> None:
    """A slow wander that the profile does not know shows in the Allan deviation at T/5."""
    rng = np.random.default_rng(5)
    wander = 10.0 * np.sin(2.0 * math.pi * np.arange(60) / 30.0)[:, None]
    model = AllanModel(1.0, 0.1, 1e-9)
    source = imu("fc", NoiseProfile("made", model, model))
    calm = window_of(source, batches_of(rng.normal(0.0, 1.0, (60, 6))))
    uneasy = window_of(source, batches_of(wander + rng.normal(0.0, 1.0, (60, 6))))
    assert min(uneasy.gyro_sigma_use_rad_s) > 10.0 * max(calm.gyro_sigma_use_rad_s)


def test_a_ramp_is_taken_at_the_end_of_the_window_and_flagged() -> None:
    rng = np.random.default_rng(6)
    slope = 0.8 * DEG_H
    means = rng.normal(0.0, 4.0 * DEG_H, (60, 6))
    means[:, 0] += slope * np.arange(0.5, 60.0)
    window = window_of(imu("fc"), batches_of(means))
    assert window.gyro_rad_s[0] == pytest.approx(60.0 * slope, abs=3.0 * DEG_H)
    assert any("warm-up: gyro fc drifts 0.8 deg/h per second" in line for line in window.drifting)
    # Twice the sigma of a mean, and a horizon that may drift on: slope * H / 2 / sqrt(3).
    assert window.gyro_sigma_stat_rad_s[0] == pytest.approx(2.0 * window.gyro_sigma_stat_rad_s[1], rel=0.35)
    assert window.gyro_sigma_use_rad_s[0] > slope * 90.0 / math.sqrt(3.0)
    assert window.gyro_rad_s[1] == pytest.approx(0.0, abs=3.0 * DEG_H)


def test_rounding_with_enough_noise_costs_nothing_and_seconds_without_counts_cost_half_a_step() -> None:
    rng = np.random.default_rng(8)
    batches = batches_of(rng.normal(30.0, 0.01, (30, 6)), spread=2.0)
    exact = window_of(imu("fc", QUIET), batches)
    rounded = estimate(imu("fc", QUIET), batches, end_s=30.0, horizon_s=180.0, rounding=1.0)
    truncated = window_of(imu("fc", QUIET, gyro_step_rad_s=1.0, accel_step_m_s2=1.0), batches)
    assert np.sqrt(rounded.stat_variance[:3]) == pytest.approx(exact.gyro_sigma_stat_rad_s)
    assert min(truncated.gyro_sigma_stat_rad_s) > 0.5
    assert np.subtract(truncated.gyro_rad_s, exact.gyro_rad_s) == pytest.approx([0.5] * 3, abs=0.01)
    assert "half a step" in truncated.hidden["gyro"]


def test_the_bound_for_rounding_covers_its_bias() -> None:
    """Independently: the mean of rounded Gaussian readings, worst case over the true value, from the error function."""

    def mean_of_rounded(true: float, sigma: float) -> float:
        edges = [0.5 * (1.0 + math.erf((k - 0.5 - true) / (sigma * math.sqrt(2.0)))) for k in range(-8, 11)]
        return sum(k * (above - below) for k, below, above in zip(range(-8, 10), edges, edges[1:], strict=False))

    for sigma in (0.25, 0.35, 0.5):
        worst = max(abs(mean_of_rounded(true, sigma) - true) for true in np.linspace(0.0, 1.0, 41).tolist())
        batches = batches_of(np.zeros((30, 6)), spread=sigma)
        batches = [msgspec.structs.replace(batch, low=np.full(6, -1.0), high=np.full(6, 1.0)) for batch in batches]
        found = estimate(imu("fc", QUIET), batches, end_s=30.0, horizon_s=180.0, rounding=1.0)
        sigma_stat = math.sqrt(found.stat_variance[0])
        assert worst <= 1.02 * sigma_stat
        assert sigma_stat < 1.1 * worst


@pytest.mark.parametrize("mounting", ["ROTATION_YAW_90", "ROTATION_ROLL_180", "ROTATION_PITCH_270"])
def test_a_mounting_that_swaps_axes_swaps_means_and_sigmas(mounting: str) -> None:
    rng = np.random.default_rng(9)
    batches = batches_of(rng.normal([1, 2, 3, 4, 5, 6], [1, 2, 3, 1, 2, 3], (30, 6)))
    rotation = np.rint(rotation_matrix(mounting))
    plain = window_of(imu("fc", QUIET), batches)
    turned = window_of(imu("fc", QUIET, rotation=rotation), batches)
    assert turned.gyro_rad_s == pytest.approx((rotation @ plain.gyro_rad_s).tolist())
    assert turned.accel_m_s2 == pytest.approx((rotation @ plain.accel_m_s2).tolist())
    assert turned.gyro_sigma_use_rad_s == pytest.approx((np.abs(rotation) @ plain.gyro_sigma_use_rad_s).tolist())


def test_gradienter_mean_and_sigma() -> None:
    rng = np.random.default_rng(11)
    scaled = []
    for _ in range(300):
        window = tilt_window(batches_of(rng.normal([1.0, -2.0], 0.01, (30, 2)), n=10))
        scaled += [(window.x_deg - 1.0) / window.x_sigma_deg, (window.y_deg + 2.0) / window.y_sigma_deg]
    assert 0.93 < float(np.mean(np.abs(scaled) < 1.96)) < 0.975


def test_a_gradienter_that_shows_one_value_has_the_sigma_of_its_last_decimal() -> None:
    still = batches_of(np.tile([1.25, -0.5], (20, 1)), spread=0.0)
    batches = [msgspec.structs.replace(batch, distinct=np.array([1, 1])) for batch in still]
    window = tilt_window(batches)
    assert window.x_sigma_deg == pytest.approx(0.01 / math.sqrt(12.0))
    assert window.y_sigma_deg == pytest.approx(0.1 / math.sqrt(12.0))


def test_heading_is_averaged_across_north() -> None:
    rng = np.random.default_rng(12)
    readings = np.mod(359.9 + rng.normal(0.0, 0.5, (40, 1)), 360.0)
    window = heading_window(batches_of(readings, n=8), from_field=False, wander_deg=None)
    assert abs((window.heading_deg - 359.9 + 180.0) % 360.0 - 180.0) < 0.3
    assert 0.0 <= window.heading_deg < 360.0
    assert window.sigma_deg == pytest.approx(0.5 / math.sqrt(40.0), rel=0.4)


def test_a_slope_of_the_parts_own_flicker_is_no_warm_up_and_a_real_one_is() -> None:
    rng = np.random.default_rng(9)
    model = AllanModel(0.1, 5.0, 0.05)
    source, nobody = imu("fc", NoiseProfile("made", model, model)), imu("fc", noise_profile("unknown"))
    flagged = learned = 0
    for _ in range(60):
        bias = np.stack([slow(rng, 4096, model.flicker, model.walk) for _ in range(6)], axis=1)[2000:2060]
        readings = bias + rng.normal(0.0, model.white, (60, 6))
        flagged += any("warm-up" in line for line in window_of(source, batches_of(readings)).drifting)
        # The wander of an unknown part is learned from the window itself.
        learned += any("warm-up" in line for line in window_of(nobody, batches_of(readings * DEG_H)).drifting)
    assert flagged <= 4
    assert learned <= 4
    slope = 1.5
    warm = batches_of(slope * np.arange(0.5, 60.0)[:, None] + rng.normal(0.0, model.white, (60, 6)))
    assert window_of(source, warm).gyro_rad_s == pytest.approx([60.0 * slope] * 3, abs=0.5)


@pytest.mark.parametrize("seed", range(5))
def test_an_unknown_part_is_extrapolated_along_a_warm_up_and_not_across_a_step(seed: int) -> None:
    """A gyro of a Movella DOT steps by 110 deg/h within a minute, and back."""
    rng, time = np.random.default_rng(seed), np.arange(0.5, 30.0)
    noise, nobody = rng.normal(0.0, 20.0, (30, 6)), imu("fc", noise_profile(None))
    step, ramp = 110.0 * (time > 15.0)[:, None], 8.0 * time[:, None]
    for change, is_ramp in ((step, False), (ramp, True)):
        batches = batches_of((noise + change) * DEG_H)
        found = estimate(nobody, batches, end_s=batches[-1].slot + 1.0, horizon_s=180.0)
        assert (found.warming.ramp[:3] != 0.0).tolist() == [is_ramp] * 3


@pytest.mark.parametrize("seconds", [10, 60])
@pytest.mark.parametrize(("part", "triad"), [(p, t) for p in PROFILES if p != "unknown" for t in ("gyro", "accel")])
def test_sigma_of_an_unknown_part_is_learned_from_its_noise(part: str, triad: Triad, seconds: int) -> None:
    """For every part: sigma covers the next three minutes, and is not much wider than the errors.

    Accelerometers stand on ground that tilts as it does under real ones.
    """
    rng, model, next_s, rows = np.random.default_rng(3), PROFILES[part].of(triad), 180, rows_of(triad)
    walk = math.hypot(model.walk, SPOT_WALK[rows][0])
    misses = []
    for _ in range(30):
        whole = [slow(rng, 512, model.flicker, walk)[-seconds - next_s :] for _ in range(3)]
        bias = np.stack(whole, axis=1)
        triads = [bias[:seconds] + rng.normal(0.0, model.white, (seconds, 3)) for _ in TRIADS]
        batches = batches_of(np.hstack(triads))
        nobody, end_s = imu("fc", noise_profile(None)), batches[-1].slot + 1.0
        found = estimate(nobody, batches, end_s=end_s, horizon_s=float(next_s))
        misses.append((found.mean[rows] - bias[seconds:].mean(axis=0)) / np.sqrt(found.use_variance[rows]))
    assert np.mean(np.abs(misses) < 2.0) >= 0.85
    assert 0.4 < math.sqrt(np.mean(np.square(misses))) < 1.6


@pytest.mark.parametrize("part", ["icm42688p", "bmi088", "adis16470"])
def test_the_price_of_a_part_is_the_sigma_that_the_estimator_gives(part: str) -> None:
    """The figures that setup and check show beside the parts, against windows of 60 s of the part's white noise."""
    config = parse('[mavlink]\nurl = "udpin:127.0.0.1:9"\n[[imu]]\nname = "fc"\nsource = "autopilot"\n', "x.toml")
    profile, rng = noise_profile(part), np.random.default_rng(5)
    white = np.repeat([profile.gyro.white, profile.accel.white], 3)
    found = [
        window_of(imu("fc", profile), batches_of(rng.normal(0.0, white, (60, 6)), spread=1e-3)).gyro_sigma_use_rad_s
        for _ in range(20)
    ]
    assert float(np.median(found)) / DEG_H == pytest.approx(gyro_sigmas_deg_h(config)[part], rel=0.1)
