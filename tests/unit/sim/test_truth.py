"""The aircraft's truth against the vectors of the method and against closed forms written out here."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim.aircraft import Pose, Site, VirtualAircraft
from sim.devices import Gradienter
from sim.earth import body_from_ned, earth_rate_ned_rad_s, normal_gravity_m_s2
from sim.motions import Handling, Motion, SlowTurn, Turn, Vibration

CASES: list[dict[str, Any]] = json.loads(
    (Path(__file__).parents[2] / "vectors" / "method.json").read_text(encoding="utf-8")
)["cases"]


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case['latitude_deg']:.1f}")
def test_truth_plus_bias_is_what_the_published_vectors_measure(case: dict[str, Any]) -> None:
    aircraft = VirtualAircraft(
        Pose(case["theta_deg"], case["gamma_deg"], case["heading_true_deg"]),
        Site(case["latitude_deg"], 0.0, case["height_m"]),
    )
    rate, force = aircraft.truth_at(0.0)
    assert force + case["bias_accel_frd_m_s2"] == pytest.approx(case["mean_accel_frd_m_s2"], abs=1e-9)
    assert rate + case["bias_gyro_frd_rad_s"] == pytest.approx(case["mean_gyro_frd_rad_s"], abs=1e-15)
    assert aircraft.site.gravity_m_s2 == pytest.approx(case["gravity_m_s2"], abs=1e-9)
    law = case["gradienter_law"]
    x, y = Gradienter(aircraft, law=law).tilt_deg(np.array([0.0]))[0]
    assert (x, y) == pytest.approx((case["qx_deg"], case["qy_deg"]), abs=1e-9)


def test_gravity_at_the_poles_the_equator_and_in_beijing() -> None:
    assert normal_gravity_m_s2(0.0) == pytest.approx(9.7803253359, abs=1e-10)
    assert normal_gravity_m_s2(90.0) == pytest.approx(9.8321849378, abs=1e-9)
    assert normal_gravity_m_s2(40.0, 50.0) == pytest.approx(9.801543, abs=5e-7)
    fall_per_100_m = (normal_gravity_m_s2(45.0, 0.0) - normal_gravity_m_s2(45.0, 100.0)) / 9.80665e-6
    assert fall_per_100_m == pytest.approx(31.5, abs=0.1)  # micro-g


MOTIONS: list[Motion] = [
    Handling(start_s=2.0, duration_s=6.0, seed=3),
    SlowTurn(start_s=2.0, duration_s=6.0, rate_deg_s=-2.0),
    SlowTurn(start_s=2.0, duration_s=1.0, rate_deg_s=5.0, ramp_s=4.0),
    Turn(start_s=2.0, duration_s=1.5, roll_deg=7.0, pitch_deg=-4.0, heading_deg=100.0),
    Vibration(start_s=2.0, duration_s=1.0, frequency_hz=20.0, rocking_deg_s=3.0),
]


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: type(motion).__name__)
def test_body_rate_is_the_derivative_of_the_attitude_plus_the_earths_rate(motion: Motion) -> None:
    site = Site(-35.0, 149.0, 600.0)
    aircraft = VirtualAircraft(Pose(12.0, -20.0, 300.0), site, motions=[motion])
    step = 1e-5
    for t_s in np.linspace(2.0003, motion.end_s - 0.0003, 97):
        before, now, after = (body_from_ned(*aircraft.angles_rad(t)) for t in (t_s - step, t_s, t_s + step))
        turning = -((after - before) / (2.0 * step)) @ now.T
        rate = np.array([turning[2, 1], turning[0, 2], turning[1, 0]]) + now @ earth_rate_ned_rad_s(-35.0)
        assert aircraft.truth_at(float(t_s)).rate_rad_s == pytest.approx(rate, abs=3e-6)


@pytest.mark.parametrize("motion", MOTIONS, ids=lambda motion: type(motion).__name__)
def test_a_block_of_times_gives_what_single_times_give_and_stillness_is_known(motion: Motion) -> None:
    aircraft = VirtualAircraft(Pose(1.0, 2.0, 3.0), motions=[motion])
    times = np.linspace(0.0, motion.end_s + 2.0, 301)
    block = aircraft.truth(times)
    for number, t_s in enumerate(times):
        single = aircraft.truth_at(float(t_s))
        assert block.rate_rad_s[number] == pytest.approx(single.rate_rad_s, abs=1e-15)
        assert block.force_m_s2[number] == pytest.approx(single.force_m_s2, abs=1e-12)
        assert aircraft.still_at(float(t_s)) == (not motion.start_s <= t_s < motion.end_s)


def test_a_turn_stays_and_a_handling_comes_back() -> None:
    aircraft = VirtualAircraft(
        Pose(5.0, -3.0, 350.0),
        motions=[
            Handling(start_s=1.0, duration_s=3.0),
            Turn(start_s=6.0, duration_s=1.0, pitch_deg=-6.0, heading_deg=30.0),
            SlowTurn(start_s=8.0, duration_s=10.0, rate_deg_s=1.5, ramp_s=2.0),
        ],
    )
    assert aircraft.pose_at(5.9).pitch_deg == pytest.approx(5.0, abs=1e-9)
    after = aircraft.pose_at(30.0)
    assert after.pitch_deg == pytest.approx(-1.0)
    assert after.roll_deg == pytest.approx(-3.0)
    assert after.heading_deg == pytest.approx(350.0 + 30.0 + 1.5 * (10.0 - 2.0) - 360.0)
