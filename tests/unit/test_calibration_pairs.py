"""The estimator's bias from pairs of floats and integers, against the bias that the simulated readings have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from companion.calibration.means.pairs import BiasTrack, Grid

DEG_H = 1.0 / 206.265
"""LSB: of a milliradian a second."""


@dataclass
class Sent:
    """What one IMU sent, (n, 6) of blocks of half a second each, in LSB."""

    floats: list[np.ndarray]
    integers: list[np.ndarray]
    bias: list[np.ndarray]
    mean: np.ndarray


def sent(
    *, seconds: int, sigma: float = 0.4, pairs: int = 20, seed: int = 0, step: float = 0.0, wander: float = 0.4 * DEG_H
) -> Sent:
    """Readings about any mean, rounded to the sensor's own steps; the bias stands still for a second, then wanders."""
    random = np.random.default_rng(seed)
    mean, b = random.uniform(-4.0, 4.0, 6), random.uniform(-5.0, 5.0, 6)
    result = Sent([], [], [], mean)
    for _ in range(seconds):
        for _ in range(2):
            true = mean + sigma * random.standard_normal((pairs, 6))
            if step:
                true = np.round(true / step) * step
            result.floats.append((true - b).astype(np.float32).astype(np.float64))
            result.integers.append(np.fix(true).astype(np.int64))
            result.bias.append(b)
        b = b + wander * random.standard_normal(6)
    return result


def followed(what: Sent, grid: Grid | None = None) -> tuple[BiasTrack, np.ndarray, np.ndarray]:
    """The track, and errors and sigmas (m, 6) since it was known."""
    track = BiasTrack()
    track.grid = grid
    errors, sigmas = [], []
    for floats, integers, bias in zip(what.floats, what.integers, what.bias, strict=True):
        track.add(floats, integers, np.roll(floats, 1, axis=0), 0.5)
        if track.known:
            errors.append(track.bias - bias)
            sigmas.append(np.sqrt(track.variance))
    return track, np.array(errors).reshape(-1, 6), np.array(sigmas).reshape(-1, 6)


def test_the_bias_is_known_to_a_few_deg_h_soon_and_its_sigma_covers() -> None:
    last, means, shares = [], [], []
    for seed in range(15):
        _, errors, sigmas = followed(sent(seconds=30, seed=seed))
        assert len(errors) > 50  # of 60 blocks
        last.append(errors[-1])
        means.append(errors.mean(axis=0))
        shares.append(np.abs(errors) <= 2.0 * sigmas)
    assert np.sqrt(np.mean(np.square(last))) < 3.0 * DEG_H
    assert np.sqrt(np.mean(np.square(means))) < 1.0 * DEG_H
    assert np.concatenate(shares).mean() > 0.95


def test_as_fast_as_the_imu_gives_it_is_one_deg_h() -> None:
    errors = [followed(sent(seconds=10, pairs=125, seed=seed))[1][-1] for seed in range(10)]
    assert np.sqrt(np.mean(np.square(errors))) < 1.0 * DEG_H


def test_what_a_quiet_sensor_leaves_open_no_averaging_takes_away() -> None:
    errors, sigmas = [], []
    for seed in range(40):
        track, _, _ = followed(sent(seconds=20, sigma=0.1, seed=100 + seed))
        what = sent(seconds=20, sigma=0.1, seed=100 + seed)
        errors.append(track.bias - what.bias[-1])
        sigmas.append(np.sqrt(track.variance))
    ratio = np.sqrt(np.mean(np.square(errors))) / np.sqrt(np.mean(np.square(sigmas)))
    assert 0.75 < ratio < 1.15
    assert np.mean(np.abs(errors) <= 2.0 * np.array(sigmas)) > 0.94
    assert np.sqrt(np.mean(np.square(errors))) < 0.29  # of any mean within a step


def test_coarse_steps_of_the_sensor_are_in_the_sigma() -> None:
    errors, sigmas = [], []
    for seed in range(40):
        what = sent(seconds=20, step=0.266, seed=seed)
        track, _, _ = followed(what)
        errors.append(track.bias - what.bias[-1])
        sigmas.append(np.sqrt(track.variance))
    assert 0.03 < np.sqrt(np.mean(np.square(errors))) < 0.08
    assert np.mean(np.abs(errors) <= 2.0 * np.array(sigmas)) > 0.94


def test_where_these_steps_are_known_they_tell_the_bias() -> None:
    for seed in range(10):
        what = sent(seconds=6, step=0.266, seed=seed)
        _, errors, _ = followed(what, Grid(np.full(6, 1.064), np.zeros(6)))
        assert np.abs(errors).max() < 1.5 * DEG_H


@pytest.mark.parametrize("sigma", [0.1, 0.4])
def test_floats_of_another_imu_are_no_pairs(sigma: float) -> None:
    one, other = sent(seconds=20, sigma=sigma, seed=1), sent(seconds=20, sigma=sigma, seed=2)
    track = BiasTrack()
    for floats, integers in zip(one.floats, other.integers, strict=True):
        track.add(floats, integers, np.roll(floats, 1, axis=0), 0.5)
        assert not track.known


def test_a_step_of_the_bias_is_seen_at_once_and_followed() -> None:
    before, after = sent(seconds=10, seed=1), sent(seconds=10, seed=1)
    track, _, _ = followed(before)
    known = []
    for floats, integers in zip(after.floats, after.integers, strict=True):
        track.add(floats - 0.8, integers, np.roll(floats, 1, axis=0), 0.5)
        known.append(track.known)
    assert known[:2] == [False, False]
    assert track.restarts >= 1
    assert known[-1]
    assert np.abs(track.bias - after.bias[-1] - 0.8).max() < 10.0 * DEG_H


def test_one_wrong_pair_in_a_hundred_does_no_harm() -> None:
    what = sent(seconds=20, pairs=100, seed=3)
    for floats in what.floats:
        floats[7] = np.roll(floats, 3, axis=0)[7]
    track, errors, _ = followed(what)
    assert track.restarts == 0
    assert np.abs(errors.mean(axis=0)).max() < 1.0 * DEG_H
