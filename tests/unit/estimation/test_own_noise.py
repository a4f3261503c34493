"""A still sensor's own noise of any spectrum is rest without a profile; rocking, walking and handling never are."""

from __future__ import annotations

import datetime
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.errors import CalibrationRefusedError
from companion.estimation.collector.rolling import RollingCollector
from companion.estimation.machine import What
from companion.estimation.noise.allan import noise_profile
from companion.estimation.solution.site import Whereabouts, local_earth
from companion.estimation.solution.solve import solve
from companion.estimation.stillness.gates import ImuGate
from companion.estimation.stillness.own_noise import OwnNoise
from companion.lab.profile import fit_profile, rests, seconds_at_rest, seconds_of
from tests.support.extent import extent
from tests.support.made_noise import DEG, DEG_H, MG, filtered
from tests.support.recordings import shared
from tests.support.still_aircraft import RATE_HZ, Feeder, imu, settings

Floats = NDArray[np.float64]
UNKNOWN = noise_profile(None)
ADIS16405 = (147.0 * DEG_H, 0.34 * MG)
MPU6050 = (12.7 * DEG_H, 0.28 * MG)
ICM42688P = (7.1 * DEG_H, 0.05 * MG)
EARTH_RAD_S = 7.292e-5
STEPS = np.repeat([0.05 * DEG, 1.0 * MG], 3)


def verdicts(t_s: Floats, readings: Floats) -> list[bool]:
    """Verdicts of a gate without a profile, second by second."""
    gate = ImuGate("own", UNKNOWN)
    found = []
    for batch in seconds_of(t_s, readings):
        verdict = gate.judge(batch)
        if verdict.still:
            gate.accept(batch)
        found.append(verdict.still)
    return found


@pytest.mark.parametrize(
    ("rate_hz", "every", "corner_hz", "poles"),
    extent(
        whole=[
            (rate_hz, every, corner_hz, poles)
            for rate_hz, every in ((50, 20), (100, 1), (200, 5), (500, 1), (1000, 1))
            for corner_hz in (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
            for poles in (1, 2)
        ],
        a_slice=[(100, 1, 1.0, 2), (50, 20, 5.0, 1), (100, 1, 20.0, 2), (200, 5, 10.0, 1), (1000, 1, 50.0, 2)],
    ),
)
@pytest.mark.parametrize("rounded", [False, True])
def test_a_still_sensor_behind_a_filter_is_still(
    rate_hz: int, every: int, corner_hz: float, poles: int, rounded: bool
) -> None:
    for white in (ADIS16405, MPU6050):
        t_s, readings = filtered(180, rate_hz, white, corner_hz, poles, 3, every)
        if rounded and white is ADIS16405:
            readings = np.rint(readings / STEPS) * STEPS
        # Half a minute to learn, and more where chance had it look again: one of a thousand times a minute.
        later = verdicts(t_s, readings)[80:]
        assert np.mean(later) >= 0.95
        # A profile's recordings are looked at as a whole: nothing is lost at their beginning.
        assert seconds_at_rest(rests(t_s, readings, "own", UNKNOWN)[0]) >= 165


def test_what_is_learned_is_the_density_of_the_noise() -> None:
    t_s, readings = filtered(200, 200, ADIS16405, 5.0, 1, 4)
    own = OwnNoise()
    for batch in seconds_of(t_s, readings):
        own.add(batch)
    for known, white in zip(own.known, ADIS16405, strict=True):
        assert known is not None
        np.testing.assert_allclose(np.sqrt(known.density), white, rtol=0.3)
        # One pole: the variance is pi f N^2, of which that of the second's mean, N^2, is not within the second.
        np.testing.assert_allclose(known.variance, (math.pi * 5.0 - 1.0) * white**2, rtol=0.15)


def rocking(t_s: Floats, rms_deg_s: float, hz: float) -> Floats:
    """Rolling to and fro under gravity: rates in x, specific force in y."""
    rate = math.sqrt(2.0) * rms_deg_s * np.sin(2.0 * math.pi * hz * t_s + 0.3)
    angle = -math.sqrt(2.0) * rms_deg_s * np.cos(2.0 * math.pi * hz * t_s + 0.3) / (2.0 * math.pi * hz)
    motion = np.zeros((len(t_s), 6))
    motion[:, 0] = rate * DEG
    motion[:, 4] = 9.8 * np.sin(angle * DEG)
    return motion


@pytest.mark.parametrize("hz", [0.05, 0.1, 0.2, 0.5, 1.0])
@pytest.mark.parametrize(
    ("white", "corner_hz", "rms_deg_s"),
    [(ICM42688P, 1e6, 0.2), (ADIS16405, 5.0, 0.2), (ADIS16405, 20.0, 0.3)],
)
def test_rocking_is_never_learned_as_noise(
    white: tuple[float, float], corner_hz: float, rms_deg_s: float, hz: float
) -> None:
    t_s, readings = filtered(150, 100, white, corner_hz, 2, 6)
    readings += rocking(t_s, rms_deg_s, hz)
    own = OwnNoise()
    for batch in seconds_of(t_s, readings):
        own.add(batch)
    assert own.known[0] is None
    found = verdicts(t_s, readings)
    longest = max((len(run) for run in "".join("x."[each] for each in found).split("x")), default=0)
    assert longest < 10  # no stretch begins


@pytest.mark.parametrize(
    ("white", "rms_deg_s", "hz"),
    extent(
        whole=[
            (white, rms_deg_s, hz)
            for white in (ADIS16405, MPU6050, ICM42688P)
            for rms_deg_s in (0.02, 0.05, 0.1, 0.15, 0.25)
            for hz in (0.01, 0.03, 0.07, 0.1, 0.2, 0.4)
        ],
        a_slice=[(ADIS16405, 0.1, 0.01), (ADIS16405, 0.05, 0.03), (ADIS16405, 0.1, 0.2), (ICM42688P, 0.02, 0.01)],
    ),
)
def test_rocking_that_is_taken_for_still_is_in_sigma(white: tuple[float, float], rms_deg_s: float, hz: float) -> None:
    """Rocking that looks like noise within a second may move the mean; then gravity shows it, or sigma covers it."""
    t_s, readings = filtered(150, RATE_HZ, white, 5.0, 1, 21)
    readings += rocking(t_s, rms_deg_s, hz)
    readings[:, 0] += EARTH_RAD_S  # on the equator, heading north
    profile = noise_profile("icm42688p") if white is ICM42688P else UNKNOWN
    feeder = Feeder(RollingCollector(settings(), [imu(profile=profile)]))
    feeder.change = lambda _name, _t, rows: readings[: len(rows)]
    earth = local_earth(Whereabouts(0.0, 0.0, 0.0, "test", datetime.date(2026, 1, 1)))
    bias = np.array([0.3, -0.2, 0.1]) * DEG
    for _ in range(150):
        feeder.run(1.0)
        readings = readings[RATE_HZ:]
        try:
            solution = solve(feeder.collector.window(feeder.now_s), earth, None, None, What.GYROS)
        except CalibrationRefusedError:
            continue
        (found,) = solution.imus
        assert found.gyro_rad_s is not None
        assert (np.abs(found.gyro_rad_s - bias) < 3.0 * found.gyro_sigma_use_rad_s).all()


def gusts(t_s: Floats, seed: int, low_hz: float, high_hz: float, rms_deg_s: float, axes: int) -> Floats:
    """Swaying in the wind at all frequencies between two: rates about so many axes, and gravity with them."""
    rng = np.random.default_rng(seed)
    many, step_s = 2 * len(t_s), 0.01
    frequency = np.fft.rfftfreq(many, step_s)
    with np.errstate(divide="ignore"):
        gain = 1.0 / np.sqrt((1.0 + (low_hz / frequency) ** 4) * (1.0 + (frequency / high_hz) ** 4))
    motion = np.zeros((len(t_s), 6))
    for axis in range(axes):
        rate = np.fft.irfft(np.fft.rfft(rng.normal(size=many)) * gain, many)[: len(t_s)]
        motion[:, axis] = rms_deg_s * DEG * rate / rate.std()
    angle = np.cumsum(motion[:, :2], axis=0) * step_s
    motion[:, 3:5] = 9.8 * np.sin(angle - angle.mean(axis=0))[:, ::-1] * [1.0, -1.0]
    return motion


@pytest.mark.parametrize("rms_deg_s", [0.05, 0.1, 0.2])
@pytest.mark.parametrize(("low_hz", "high_hz"), [(0.02, 0.5), (0.05, 1.0), (0.1, 2.0), (0.05, 3.0)])
def test_gusts_about_one_axis_are_never_learned(low_hz: float, high_hz: float, rms_deg_s: float) -> None:
    """Gusts as flat and steady as noise; but noise has no favourite axis."""
    t_s, readings = filtered(150, 100, ICM42688P, 1e6, 1, 22)
    readings += gusts(t_s, 23, low_hz, high_hz, rms_deg_s, 1)
    own = OwnNoise()
    for batch in seconds_of(t_s, readings):
        own.add(batch)
        known = own.known[0]
        assert known is None or math.sqrt(known.variance.mean()) < 0.1 * rms_deg_s * DEG


@pytest.mark.parametrize("rms_deg_s", [0.1, 0.2])
def test_bursts_in_all_axes_are_never_learned(rms_deg_s: float) -> None:
    """White and round as noise is, one second in ten: a hand at the wing, a motor that starts. Noise is steady."""
    t_s, readings = filtered(150, 100, ICM42688P, 1e6, 1, 22)
    burst = np.floor(t_s) % 10 == 3
    readings[burst, :3] += np.random.default_rng(24).normal(0.0, rms_deg_s * DEG, (int(burst.sum()), 3))
    own = OwnNoise()
    for batch in seconds_of(t_s, readings):
        own.add(batch)
        assert own.known[0] is None or math.sqrt(own.known[0].variance.mean()) < 0.1 * rms_deg_s * DEG


def test_a_noisy_part_behind_a_filter_is_still_from_its_first_second_and_a_sway_is_not() -> None:
    """ADIS16405 behind 25 Hz, correlated from sample to sample; nobody names the part."""
    t_s, readings = filtered(60, 100, (152.0 * DEG_H, 0.669 * MG), 25.0, 1, 31)
    still = [ImuGate("imu", UNKNOWN).judge(batch).still for batch in seconds_of(t_s, readings)]
    assert np.mean(still) >= 0.98
    readings[:, :2] += 0.3 * DEG * math.sqrt(2.0) * np.sin(2.0 * math.pi * np.array([1.0, 2.0]) * t_s[:, None])
    swaying = [ImuGate("imu", UNKNOWN).judge(batch).still for batch in seconds_of(t_s, readings)]
    assert np.mean(swaying) <= 0.05


def test_more_than_any_part_has_is_never_learned_but_by_whoever_says_that_it_is_at_rest() -> None:
    noisy = (1.6 * 0.07 * DEG, 1.6 * MG)
    t_s, readings = filtered(120, 100, noisy, 10.0, 1, 9)
    gate = ImuGate("own", UNKNOWN)
    words = [gate.judge(batch).words for batch in seconds_of(t_s, readings)]
    assert words[9].endswith(" (motion or noise: known in 20 s)")
    assert words[-1].startswith("gyro own moves 0.5")
    assert words[-1].endswith(" (steady as noise: name its part, or companion log profile)")
    assert "" not in words
    # Its recording tells a profile, and with it, it is still.
    stretches, _, _ = rests(t_s, readings, "own", UNKNOWN)
    assert seconds_at_rest(stretches) >= 110
    profile, _, _ = fit_profile("own", stretches, UNKNOWN)
    assert profile.gyro.white == pytest.approx(noisy[0], rel=0.15)
    gate = ImuGate("own", profile)
    later = [gate.judge(batch).still for batch in seconds_of(*filtered(120, 100, noisy, 10.0, 1, 10))][40:]
    assert np.mean(later) >= 0.95


def test_broad_s_handling_stays_refused() -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(shared("broad/02_undisturbed_slow_rotation_B.hdf5")) as file:
        rate, force, moves = (np.asarray(file[name]) for name in ("imu_gyr", "imu_acc", "movement"))
    t_s = np.arange(len(rate)) / (2000.0 / 7.0)
    found = verdicts(t_s, np.hstack([rate, force]))
    moving = [bool(moves[np.floor(t_s) == second].all()) for second in range(1, len(found) + 1)]
    assert sum(moving) > 80
    assert not any(still and moved for still, moved in zip(found, moving, strict=True))


def test_a_coarse_stream_may_hold_one_value_for_a_while() -> None:
    """Accelerometers whose noise is a tenth of their step: many seconds are all one value, which is not stuck."""
    t_s, readings = filtered(200, 100, (20.0 * DEG_H, 0.1 * MG), 1.0, 1, 11)
    step = 3.33 * MG
    # Axis x lies a little off the middle between two steps, so that it toggles now and then; y and z do not.
    readings[:, 3:] -= readings[:, 3:].mean(axis=0)
    readings[:, 3:] = np.rint(readings[:, 3:] / step + [0.43, 0.1, -294.0]) * step
    constant = [batch.slot for batch in seconds_of(t_s, readings) if (batch.distinct[3:] == 1).all()]
    assert 40 < len(constant) < 180
    found = verdicts(t_s, readings)
    assert np.mean(found[30:]) >= 0.95
    # One that freezes for good is stuck.
    readings[100 * 100 :, 3:] = readings[100 * 100, 3:]
    assert not any(verdicts(t_s, readings)[165:])
