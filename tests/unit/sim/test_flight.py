"""The moving aircraft's truth against independent integration and against what turns demand."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim.aircraft import Pose, Site, VirtualAircraft
from sim.earth import EARTH_RATE_RAD_S, STANDARD_GRAVITY_M_S2
from sim.flight import BankedCircles, MovingAircraft, Route, Shuttle

ROUTES = [BankedCircles(start_s=2.0), Shuttle(start_s=2.0)]
SITE = Site(latitude_deg=-33.0, longitude_deg=151.0, height_m=20.0, declination_deg=12.0)


@pytest.mark.parametrize("route", ROUTES, ids=["circles", "shuttle"])
def test_rates_and_forces_integrate_to_attitude_and_velocity(route: Route) -> None:
    aircraft = MovingAircraft(route, Pose(3.0, 9.52, 200.0), SITE)
    step = 2.5e-3
    times = np.arange(0.0, 40.0, step) + 0.5 * step
    rate, force = aircraft.truth(times)
    earth = EARTH_RATE_RAD_S * np.array([math.cos(math.radians(-33)), 0.0, -math.sin(math.radians(-33))])
    gravity = np.array([0.0, 0.0, SITE.gravity_m_s2])
    # In inertial space, where the rates are what they are; north, east and down turn in it with the Earth.
    steps, halves = (Rotation.from_rotvec(share * step * rate).as_matrix() for share in (1.0, 0.5))
    body = list(itertools.accumulate(steps, np.matmul, initial=aircraft.body_from_ned(0.0).T))
    pulled = Rotation.from_rotvec(-np.outer(times, earth)).apply(
        (np.array(body[:-1]) @ halves @ force[:, :, None])[:, :, 0]
    )
    coriolis = -2.0 * np.cross(earth, np.eye(3)).T
    velocity = np.zeros(3)
    for acceleration in pulled + gravity:
        velocity = velocity + step * (acceleration + coriolis @ velocity)
    end_s = float(times[-1]) + 0.5 * step
    ned_from_body = Rotation.from_rotvec(-end_s * earth) * Rotation.from_matrix(body[-1])
    wanted = Rotation.from_matrix(aircraft.body_from_ned(end_s).T)
    assert math.degrees((ned_from_body * wanted.inv()).magnitude()) < 1e-4
    turned = math.radians(200.0)
    over_ground = route.velocity_m_s(np.array([end_s]))[0]
    to_ned = np.array([[math.cos(turned), -math.sin(turned), 0], [math.sin(turned), math.cos(turned), 0], [0, 0, 1]])
    assert velocity == pytest.approx(to_ned @ over_ground, abs=2e-3)


@pytest.mark.parametrize("route", ROUTES, ids=["circles", "shuttle"])
def test_until_the_route_begins_it_stands(route: Route) -> None:
    aircraft, standing = MovingAircraft(route, Pose(3.0, -2.0, 77.0), SITE), VirtualAircraft(Pose(0, 0, 0), SITE)
    rate, force = aircraft.truth_at(1.0)
    assert np.linalg.norm(rate) == pytest.approx(np.linalg.norm(standing.truth_at(1.0).rate_rad_s), rel=1e-6)
    assert np.linalg.norm(force) == pytest.approx(SITE.gravity_m_s2, rel=1e-9)
    assert aircraft.still_at(1.9)
    assert not aircraft.still_at(2.1)


def test_a_coordinated_turn_feels_no_side_force() -> None:
    aircraft = MovingAircraft(BankedCircles(start_s=0.0), Pose(), SITE)
    roll, pitch, _ = aircraft.angles_rad(30.0)
    _, force = aircraft.truth_at(30.0)
    assert (math.degrees(roll), pitch) == pytest.approx((35.0, 0.0), abs=1e-9)
    # The bank is for standard gravity, the site's differs by 0.1 %; Coriolis adds 2 mm/s^2.
    assert force[1] == pytest.approx(0.0, abs=0.02)
    assert -force[2] == pytest.approx(STANDARD_GRAVITY_M_S2 / math.cos(roll), rel=2e-3)


def test_a_leaning_multirotor_pushes_along_its_own_axis() -> None:
    aircraft = MovingAircraft(Shuttle(start_s=0.0), Pose(), SITE)
    times = np.linspace(10.0, 60.0, 500)
    _, force = aircraft.truth(times)
    assert np.abs(force[:, :2]).max() < 0.03
    leans = [math.degrees(math.hypot(*aircraft.angles_rad(float(t))[:2])) for t in times]
    assert max(leans) == pytest.approx(12.0, abs=0.2)
