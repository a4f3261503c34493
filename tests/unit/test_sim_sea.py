"""The sea: its angles, rates and accelerations belong together, and nothing drifts away."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sim.aircraft import DEFAULT_SITE, Pose, VirtualAircraft
from sim.devices import HMR3300, Gradienter
from sim.earth import STANDARD_GRAVITY_M_S2, body_from_ned
from sim.motions import SlowTurn
from sim.sea import DAY_S, MOTIONS, Sea, Wave, motions_of


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


def test_a_raft_feels_no_tilt() -> None:
    raft = Sea(surge=1.0, surge_lead_rad=0.0, heave=0.0, waves=(Wave(0.2, 5.0),))
    aircraft = VirtualAircraft(Pose(), motions=[raft])
    t_s = np.arange(10.0, 60.0, 0.1)
    force = aircraft.truth(t_s).force_m_s2 / STANDARD_GRAVITY_M_S2
    assert np.degrees(np.abs(force[:, :2])).std() < 0.2
    assert np.degrees(raft.euler_rad(t_s)[0][:, :2]).std() > 3.0


def test_a_gradienter_lies_by_what_it_is_pushed() -> None:
    swaying, pushed = (Sea(surge=surge, heave=0.0) for surge in (0.0, 1.0))
    t_s = np.arange(10.0, 60.0, 0.1)
    spread = [
        Gradienter(VirtualAircraft(Pose(), motions=[sea]), lag_s=0.0).tilt_deg(t_s)[:, 0].std()
        for sea in (swaying, pushed)
    ]
    assert spread[1] < 0.6 * spread[0]


def test_a_compass_lags_behind_a_turn() -> None:
    aircraft = VirtualAircraft(Pose(heading_deg=350.0), motions=[SlowTurn(start_s=-10.0, duration_s=DAY_S)])
    compass = HMR3300(aircraft, lag_s=0.5, heading_noise_deg=0.0)
    for frame in compass.frames_until(60.0):
        shown = float(frame.data.split(b",")[0])
    behind = (math.degrees(aircraft.angles_rad(frame.sampled_s)[2]) - shown + 180.0) % 360.0 - 180.0
    assert behind == pytest.approx(0.5, abs=0.06)


@pytest.mark.parametrize("name", MOTIONS)
def test_every_motion_by_name_goes_on_all_day(name: str) -> None:
    aircraft = VirtualAircraft(Pose(), motions=motions_of(name))
    assert aircraft.still_at(3600.0) == (name == "still")
