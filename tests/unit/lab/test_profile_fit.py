"""Profiles from recordings at rest: seconds, stretches, drifts, and the next minute."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.config.sections import AllanModel, NoiseProfile
from companion.errors import CalibrationRefusedError
from companion.estimation.means.windows import ImuInput, estimate
from companion.estimation.noise.allan import noise_profile
from companion.estimation.seconds.batch import Batch, BatchSource
from companion.lab.profile import Rest, fit_profile, rests, seconds_at_rest, seconds_of
from tests.support.extent import extent
from tests.support.made_noise import DEG, DEG_H, FLICKER_OF_FLOOR, MG, adis16405, slow
from tests.support.recordings import Recording, px4, shared, xio, xsens_counts

Floats = NDArray[np.float64]
UNKNOWN = noise_profile(None)


def at_rest(seconds: int, rate_hz: int = 50, seed: int = 1) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(seed)
    readings = rng.normal(0.0, [0.05 * DEG] * 3 + [3.0 * MG] * 3, (seconds * rate_hz, 6))
    return np.arange(seconds * rate_hz) / rate_hz + 0.004, readings + np.array([0.01, 0.0, 0.0, 0.0, 0.0, -9.8])


# --- seconds


def test_seconds_are_those_of_the_daemon() -> None:
    t_s, readings = at_rest(20, rate_hz=47)
    readings[:, 1] = np.rint(readings[:, 1] / (0.1 * DEG)) * (0.1 * DEG)
    kept = np.random.default_rng(2).random(len(t_s)) < 0.8
    t_s, readings = t_s[kept], readings[kept]
    source = BatchSource((1e9,) * 6, keep=100)
    for t, row in zip(t_s.tolist(), readings.tolist(), strict=True):
        source.add(t, tuple(row))
    ours = {batch.slot: batch for batch in seconds_of(t_s, readings)}
    assert sorted(ours) == sorted(source.batches) == list(range(1, 19))
    for slot, batch in source.batches.items():
        found = ours[slot]
        assert found.n == batch.n
        assert found.largest_gap_s == pytest.approx(batch.largest_gap_s)
        for name in ("mean", "variance", "white", "low", "high"):
            np.testing.assert_allclose(getattr(found, name), getattr(batch, name), rtol=1e-6, atol=1e-15)
        np.testing.assert_array_equal(found.distinct, batch.distinct)


# --- stretches


def test_movement_ends_a_stretch_and_a_new_pose_is_another_one() -> None:
    t_s, readings = at_rest(200)
    readings[100 * 50 : 110 * 50, :3] += np.random.default_rng(3).normal(0.0, 0.2, (500, 3))
    readings[110 * 50 :, 3] += 0.5  # it lies tilted now
    stretches, seconds, obstacle = rests(t_s, readings, "own", UNKNOWN)
    assert [(slots[0], slots[-1]) for slots, _ in stretches] == [(1, 99), (110, 198)]
    assert seconds == 198
    assert obstacle.startswith("gyro own")


def test_a_knock_and_a_lost_second_are_holes() -> None:
    t_s, readings = at_rest(100)
    readings[50 * 50 : 50 * 50 + 20, 0] += 0.2
    there = (t_s < 70.0) | (t_s >= 71.0)
    stretches, _, _ = rests(t_s[there], readings[there], "own", UNKNOWN)
    ((slots, _),) = stretches
    assert sorted(set(range(1, 99)) - set(slots.tolist())) == [50, 70]
    assert seconds_at_rest(stretches) == 96


# --- the profile


def rest_of(seconds: int, models: tuple[AllanModel, AllanModel], seed: int) -> Rest:
    """Made second by second, without samples."""
    rng = np.random.default_rng(seed)
    columns = [slow(rng, seconds, m.flicker, m.walk, m.white) for m in (models[0],) * 3 + (models[1],) * 3]
    return np.arange(seconds), np.stack(columns, axis=1)


GYRO = AllanModel(7.1 * DEG_H, 3.0 * FLICKER_OF_FLOOR * DEG_H, 0.16 * DEG_H)
ACCEL = AllanModel(0.05 * MG, 0.01 * FLICKER_OF_FLOOR * MG, 0.0005 * MG)


def fitted(rest: Rest, fallback: NoiseProfile = UNKNOWN) -> tuple[NoiseProfile, list[str]]:
    profile, _, kept = fit_profile("made", [rest], fallback)
    return profile, kept


def test_what_is_not_told_is_borrowed_and_named() -> None:
    profile, kept = fitted(rest_of(70, (GYRO, ACCEL), 6))
    assert {"gyro B", "gyro K", "accel B", "accel K"} <= set(kept)
    # As large as the cautious profile's, save what a minute rules out.
    assert profile.gyro.floor > 2.0 * GYRO.floor
    assert profile.gyro.walk >= 0.5 * UNKNOWN.gyro.walk
    better, _ = fitted(rest_of(70, (GYRO, ACCEL), 6), noise_profile("icm42688p"))
    assert better.gyro.floor < profile.gyro.floor
    # An hour rules the cautious floor out, and tells its own.
    hour, kept = fitted(rest_of(3600, (GYRO, ACCEL), 7))
    assert "gyro B" not in kept
    assert hour.gyro.floor == pytest.approx(GYRO.floor, rel=0.25)


def test_a_drift_costs_what_it_does_over_a_calibration_and_the_minutes_after_it() -> None:
    """200 deg/h in an hour: over the longest averages of the hour K would be several deg/h over sqrt(s)."""
    slots, means = rest_of(3600, (GYRO, ACCEL), 8)
    ramp = 200.0 * DEG_H / 3600.0
    profile, _ = fitted((slots, means + ramp * slots[:, None]))
    assert profile.gyro.floor == pytest.approx(GYRO.floor, rel=0.3)
    assert profile.gyro.walk < 1.2 * DEG_H
    # A minute and the three after it: d (T + H) / 2.
    more = (profile.gyro.walk**2) * 240.0 / 3.0
    assert more >= (ramp * 120.0) ** 2


def test_what_tells_nothing_is_refused() -> None:
    with pytest.raises(CalibrationRefusedError, match="only 30 s at rest; a profile needs 60 s"):
        fitted(rest_of(30, (GYRO, ACCEL), 10))
    stuck = rest_of(100, (GYRO, ACCEL), 11)
    stuck[1][:, 4] = 1.0
    with pytest.raises(CalibrationRefusedError, match="accel y never changes"):
        fitted(stuck)


# --- the next minutes


class Misses:
    """Errors (w, 6) of windows that predict the seconds after them, and the variances that were promised."""

    def __init__(self) -> None:
        self.miss, self.use, self.seen = (np.zeros((0, 6)) for _ in range(3))

    def add(
        self,
        batches: list[Batch],
        profile: NoiseProfile,
        mean_s: int,
        next_s: int,
        every_s: int = 0,
        *,
        cold: bool = False,
    ) -> None:
        """Predict by windows without a hole through the estimator: one after another, or one every `every_s`.

        `cold`: sigma allows for a warm-up since the start of the recording, as in a record of a calibration.
        """
        length = mean_s + next_s
        starts = range(0, len(batches) - length + 1, every_s or mean_s)
        whole = [k for k in starts if batches[k + length - 1].slot - batches[k].slot == length - 1]
        past, coming = ([batches[k + a : k + b] for k in whole] for a, b in ((0, mean_s), (mean_s, length)))
        if not whole:
            return
        imu = ImuInput(name="", rotation=np.eye(3), profile=profile)
        found = [estimate(imu, each, end_s=each[-1].slot + 1.0, horizon_s=float(next_s)) for each in past]
        means = np.array([[batch.mean for batch in each] for each in coming])
        self.miss = np.vstack([self.miss, np.array([each.mean for each in found]) - means.mean(axis=1)])
        unseen = [
            one.warming.unseen(each[-1].slot + 1.0) if cold else np.zeros(6)
            for one, each in zip(found, past, strict=True)
        ]
        self.use = np.vstack([self.use, np.array([each.use_variance for each in found]) + unseen])
        # The mean of the next seconds has white noise of its own.
        self.seen = np.vstack([self.seen, np.square(np.diff(means, axis=1)).mean(axis=1) / 2.0 / next_s])

    def share(self, part: slice = slice(None)) -> float:
        """Share of the misses within 2 sigma; it should be 95 %."""
        return float((np.square(self.miss) <= 4.0 * (self.use + self.seen))[:, part].mean())

    def ratio(self) -> float:
        """Root mean square of the misses over the median sigma of each triad."""
        return float(
            np.sqrt(np.mean([np.square(self.miss[:, k]).mean() / np.median(self.use[:, k]) for k in range(6)]))
        )


def test_a_night_s_profile_keeps_its_word_in_the_other_half() -> None:
    """2.8 h, as the recordings of the ADIS16405 were, at a tenth of their rate: noise does not care."""
    t_s, readings = adis16405(10080, 10, seed=12)
    stretches, _, _ = rests(t_s, readings, "adis", UNKNOWN)
    # An accelerometer that walks leaves the gate of 5 mg now and then.
    assert seconds_at_rest(stretches) > 9900
    profile, _, _ = fit_profile("adis", stretches, UNKNOWN)
    assert profile.gyro.white / DEG_H == pytest.approx(152.0, rel=0.04)
    assert 23.0 < profile.gyro.floor / DEG_H < 34.0
    assert 0.22 < profile.accel.floor / MG < 0.34
    half, _, _ = rests(t_s[: len(t_s) // 2], readings[: len(t_s) // 2], "adis", UNKNOWN)
    learned, _, _ = fit_profile("adis", half, UNKNOWN)
    later = seconds_of(t_s[len(t_s) // 2 :], readings[len(t_s) // 2 :])
    for mean_s in (10, 30, 60):
        misses = Misses()
        misses.add(later, learned, mean_s, 60)
        assert misses.share() >= 0.90
        # Not by promising little: the misses are as large as sigma_use.
        assert misses.ratio() > 0.75


def made_session(
    figures: tuple[float, float, float], bounded: tuple[float, float], seconds: int, seed: int
) -> tuple[Rest, list[Batch]]:
    """Six channels of white noise, flicker floor and walk, and of a wander (rms, time constant) that is bounded; mg."""
    rng = np.random.default_rng(seed)
    white, floor, walk = (figure * MG for figure in figures)
    rms, constant_s = bounded
    means = np.empty((seconds, 6))
    for column in range(6):
        wander = np.empty(seconds)
        state, keep = rng.normal() * rms * MG, np.exp(-1.0 / constant_s)
        kicks = rng.normal(0.0, rms * MG * np.sqrt(1.0 - keep**2), seconds)
        for second in range(seconds):
            wander[second] = state = keep * state + kicks[second]
        means[:, column] = slow(rng, seconds, floor * FLICKER_OF_FLOOR, walk, white) + wander
    spread, many = np.full(6, (white * 10.0) ** 2), np.full(6, 100)
    batches = [
        Batch(
            slot=slot, n=100, mean=mean, variance=spread, white=spread, low=mean - 30.0 * white,
            high=mean + 30.0 * white, distinct=many, clipped=False, largest_gap_s=0.01,
            missing=None, temperature_degc=None,
        )
        for slot, mean in enumerate(means)
    ]  # fmt: skip
    return (np.arange(seconds), means), batches


WANDERS = {
    "bounded in 30 s": ((0.34, 0.03, 0.0), (0.3, 30.0), 0),  # near the limit: it takes every window to tell
    "bounded in 100 s": ((0.34, 0.03, 0.0), (0.5, 100.0), 120),
    "little white noise": ((0.05, 0.01, 0.0), (0.5, 100.0), 120),
    "flicker and 300 s": ((0.34, 0.1, 0.0), (0.5, 300.0), 120),
    "a walk": ((0.34, 0.1, 0.02), (0.0, 1.0), 120),
    "flicker": ((0.34, 0.2, 0.0), (0.0, 1.0), 120),
}
A_SLICE = ["bounded in 100 s", "little white noise", "a walk"]


@pytest.mark.parametrize(
    ("figures", "bounded", "every_s"),
    extent(whole=list(WANDERS.values()), a_slice=[WANDERS[name] for name in A_SLICE]),
    ids=extent(whole=list(WANDERS), a_slice=A_SLICE),
)
def test_a_wander_costs_what_it_does_in_the_next_minutes(
    figures: tuple[float, float, float], bounded: tuple[float, float], every_s: int
) -> None:
    """Learned from three nights, tested on the fourth. Never too little; of a wander that is bounded at most 1.4 times.

    N, B and K cannot follow a bound within the longest average.
    """
    nights = [made_session(figures, bounded, 7200, seed) for seed in range(40, 44)]
    rests_of = [rest for rest, _ in nights]
    profiles = [fit_profile("made", [each for each in rests_of if each is not rest], UNKNOWN)[0] for rest in rests_of]
    for mean_s, next_s in itertools.product((10, 30, 60), (60, 180)):
        misses = Misses()
        for (_, batches), profile in zip(nights, profiles, strict=True):
            # Nearer to one another they would predict nearly the same seconds again.
            misses.add(batches, profile, mean_s, next_s, every_s)
        # 240 windows in six axes of the same noise: the share is good to a percent.
        assert misses.share() >= 0.93
        assert 0.70 <= misses.ratio() <= 1.08
        assert bounded[0] != 0.0 or (misses.share() <= 0.985 and misses.ratio() >= 0.82)


# --- real recordings: short ones, so that they tell white noise, and test the cautious profile


def imu_tk() -> Recording:
    """The first 50 s; its z is up, and the counts' scale is such that it reads gravity then."""
    counts = xsens_counts()
    first = counts.t_s < 50.0
    force = counts.accel[first] - 32768.0
    scale = 9.81744 / float(np.linalg.norm(force.mean(axis=0)))
    return Recording(counts.t_s[first], counts.gyro[first], force * scale)


def broad() -> Recording:
    h5py = pytest.importorskip("h5py")
    with h5py.File(shared("broad/02_undisturbed_slow_rotation_B.hdf5")) as file:
        rate, force = np.asarray(file["imu_gyr"]), np.asarray(file["imu_acc"])
    return Recording(np.arange(len(rate)) / (2000.0 / 7.0), rate, force)


def test_of_real_recordings_the_next_seconds_are_where_they_were_promised_to_be() -> None:
    """Windows of 10 s and the 5 or 10 s after them, which is what there is room for; all four recordings together."""
    misses = Misses()
    for played, next_s in ((imu_tk(), 10), (px4(), 10), (xio("fusion_sensor_data.csv.gz"), 5), (broad(), 10)):
        readings = np.hstack([played.gyro, played.accel])
        slots = {slot for within, _ in rests(played.t_s, readings, "own", UNKNOWN)[0] for slot in within}
        still = [batch for batch in seconds_of(played.t_s, readings) if batch.slot in slots]
        misses.add(still, UNKNOWN, 10, next_s, cold=True)
    assert len(misses.miss) >= 12
    assert misses.share(slice(0, 3)) >= 0.90
    assert misses.share(slice(3, 6)) >= 0.90
