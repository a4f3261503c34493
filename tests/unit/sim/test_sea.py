"""The sea: its angles, rates and accelerations belong together, and nothing drifts away."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sim.aircraft import DEFAULT_SITE, Pose, VirtualAircraft
from sim.earth import body_from_ned
from sim.motions import MOTIONS, Sea, Wave, motions_of


def test_rates_are_the_derivatives_of_the_angles() -> None:
    sea = Sea(seed=3)
    t_s = np.arange(0.0, 60.0, 0.01)
    angles, rates = sea.euler_rad(t_s)
    found = np.gradient(angles, t_s, axis=0)
    assert np.abs(found - rates)[2:-2].max() < 1e-3 * np.abs(rates).max()


def test_a_wave_has_the_energy_of_its_sine_and_its_frequency() -> None:
    sea = Sea(waves=(Wave(0.2, 5.0),), seed=5)
    t_s = np.arange(10.0, 20000.0, 0.25)
    roll = sea.euler_rad(t_s)[0][:, 0]
    assert math.degrees(roll.std()) == pytest.approx(5.0 / math.sqrt(2.0), rel=0.05)
    power = np.abs(np.fft.rfft(roll)) ** 2
    frequencies = np.fft.rfftfreq(len(roll), 0.25)
    assert float((power * frequencies).sum() / power.sum()) == pytest.approx(0.2, rel=0.1)
    assert power[frequencies < 0.05].sum() < 1e-3 * power.sum()


def test_the_mean_acceleration_of_a_deck_that_turns_is_zero() -> None:
    aircraft = VirtualAircraft(Pose(2.0, -1.0, 40.0), motions=motions_of("sea", seed=1))
    t_s = np.arange(10.0, 1210.0, 0.25)
    force = aircraft.truth(t_s).force_m_s2
    ned = np.array([body_from_ned(*aircraft.angles_rad(t)).T @ f for t, f in zip(t_s.tolist(), force, strict=True)])
    mean = np.array([0.0, 0.0, DEFAULT_SITE.gravity_m_s2]) + ned.mean(axis=0)
    assert np.abs(mean).max() < 1e-3
    assert ned.std(axis=0).min() > 0.1


@pytest.mark.parametrize("name", MOTIONS)
def test_every_motion_by_name_goes_on_all_day(name: str) -> None:
    aircraft = VirtualAircraft(Pose(), motions=motions_of(name))
    assert aircraft.still_at(3600.0) == (name == "still")
