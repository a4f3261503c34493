"""Dithering by known shifts against sensors of known mean, from no noise at all to a lot."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from companion.errors import CalibrationRefusedError
from companion.estimation.collector.intake import LIMITS_IMU
from companion.estimation.means.dither import SECONDS, STEPS, Step, combine, shifts_lsb, why_void
from companion.estimation.seconds.batch import Batch, BatchSource
from companion.physics.units import DEG_H, MG
from tests.support.still_aircraft import QUIET, imu

Floats = NDArray[np.float64]

MRAD = 1e-3
STEPS_SI = np.repeat([MRAD, MG], 3)
MEAN = np.array([0.532, -0.324, 0.779, 88.1, 51.4, -994.3])


def seconds_of(rng: np.random.Generator, output_lsb: Floats, sigma: float) -> list[Batch]:
    """Six whole seconds at 50 Hz, cut toward zero."""
    source = BatchSource(LIMITS_IMU, 20, steps=STEPS_SI)
    exact = output_lsb + sigma * rng.standard_normal(((SECONDS + 1) * 50, 6))
    cut = np.where(exact < 0.0, -np.floor(-exact), np.floor(exact)) * STEPS_SI
    for index, row in enumerate(cut.tolist()):
        source.add(99.5 + (index + 0.5) / 50.0, tuple(row))
    source.close_before(1e6)
    return list(source.batches.values())[:SECONDS]


def steps_of(rng: np.random.Generator, mean_lsb: Floats, sigma: float, *, alternate: bool = False) -> list[Step]:
    reading = np.trunc(mean_lsb)
    return [Step(shift, seconds_of(rng, mean_lsb + shift, sigma)) for shift in shifts_lsb(reading, alternate=alternate)]


@pytest.mark.parametrize("alternate", [False, True])
def test_the_figures_of_a_real_autopilot(*, alternate: bool) -> None:
    """Autopilots 9.3: 0.23 mrad/s and 0.33 mg of noise: 1.6 deg/h and 6 ug, where the plain mean was 94 deg/h off."""
    rng = np.random.default_rng(1)
    off = []
    for _ in range(6):
        found = combine(steps_of(rng, MEAN, 0.23, alternate=alternate), STEPS_SI, QUIET, 180.0)
        off.append(found.mean - MEAN * STEPS_SI)
    rms = np.sqrt(np.mean(np.square(off), axis=0))
    assert rms[:3].max() < 2.5 * DEG_H
    assert rms[3:].max() < 0.012 * MG


@pytest.mark.parametrize("sigma", [0.0, 0.01, 0.03, 0.1, 0.23, 0.5])
def test_sigma_covers_the_error_for_any_noise(sigma: float) -> None:
    rng = np.random.default_rng(int(1000 * sigma))
    pulls = []
    for _ in range(8):
        mean = rng.uniform(-2.0, 2.0, 6)
        found = combine(steps_of(rng, mean, sigma), STEPS_SI, QUIET, 180.0)
        pulls += ((found.mean / STEPS_SI - mean) / (found.sigma_stat / STEPS_SI)).tolist()
    rms = math.sqrt(np.mean(np.square(pulls)))
    assert rms < 1.6
    # Nor is it hidden behind too wide a sigma, but where there is no noise at all to be seen.
    assert sigma < 0.05 or rms > 0.5


@settings(max_examples=100)
@given(reading=st.floats(-2000.0, 2000.0), off=st.floats(-1.0, 1.0), alternate=st.booleans())
def test_no_shifted_reading_comes_near_zero(reading: float, off: float, *, alternate: bool) -> None:
    shifts = shifts_lsb(np.full(6, reading), alternate=alternate)
    assert len(shifts) == STEPS
    assert min(abs(reading + off + float(shift[0])) for shift in shifts) > 2.0


def test_every_alternating_step_is_more_than_px4_ignores_on_every_axis() -> None:
    """Autopilots 4.2: a vector within 0.01 rad/s or m/s^2 of that in use is ignored, also each of its three writes."""
    shifts = [np.zeros(6), *shifts_lsb(MEAN, alternate=True), np.zeros(6)]
    for before, after in itertools.pairwise(shifts):
        change = np.abs(after - before) * STEPS_SI
        assert change.min() > 0.01


def test_a_step_in_which_the_aircraft_moved_is_void_and_quantisation_alone_is_not() -> None:
    rng = np.random.default_rng(2)
    for sigma in (0.0, 0.2, 0.5):
        steps = steps_of(rng, MEAN, sigma)
        for index in range(STEPS):
            assert why_void(steps[:index], steps[index], STEPS_SI) is None
    steps = steps_of(rng, MEAN, 0.2)
    turned = MEAN.copy()
    turned[3] += 3.0  # 3 mg: 0.17 deg of tilt
    moved = Step(steps[4].shift_lsb, seconds_of(rng, turned + steps[4].shift_lsb, 0.2))
    words = why_void(steps[:4], moved, STEPS_SI)
    assert words is not None
    assert "accel x moved" in words


def test_a_shift_that_was_not_taken_is_void() -> None:
    """The parameter reads back right and has no effect: the base of four steps is missing."""
    rng = np.random.default_rng(3)
    steps = steps_of(rng, MEAN, 0.2)
    ignored = Step(steps[3].shift_lsb, seconds_of(rng, MEAN, 0.2))
    assert why_void(steps[:3], ignored, STEPS_SI) is not None
    assert why_void([], ignored, STEPS_SI) == "a reading too near to zero"


def test_too_few_seconds_or_steps_are_no_result() -> None:
    rng = np.random.default_rng(4)
    steps = steps_of(rng, MEAN, 0.2)
    assert why_void([], Step(steps[0].shift_lsb, steps[0].batches[:1]), STEPS_SI) == "too few readings"
    assert why_void([], Step(steps[0].shift_lsb, []), STEPS_SI) == "too few readings"
    with pytest.raises(CalibrationRefusedError, match="9 of 10 steps"):
        combine(steps[:9], STEPS_SI, QUIET, 180.0)


def test_sigma_use_has_the_floor_of_the_sensor() -> None:
    rng = np.random.default_rng(5)
    profile = imu().profile
    found = combine(steps_of(rng, MEAN, 0.2), STEPS_SI, profile, 180.0)
    # ICM-42688-P, a mean of 60 s for the next 180 s: 4.7 deg/h and 17 ug (method 2.2).
    assert found.sigma_use[:3] / DEG_H == pytest.approx([4.9] * 3, abs=0.5)
    assert found.sigma_use[3:] / MG == pytest.approx([0.017] * 3, abs=0.003)
