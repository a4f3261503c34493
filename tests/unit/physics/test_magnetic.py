"""The heading in a field vector, its sensitivity to tilt, and the model of the Earth's field."""

from __future__ import annotations

import datetime
import math

import numpy as np
import pytest

from companion.physics import earth
from companion.physics.frames import wrap_deg
from companion.physics.magnetic import (
    BOUND_OF_ONE,
    BOUND_OF_TWO,
    deflection_bound_deg,
    heading_by_up,
    heading_rad,
    inclination_by_up,
    inclination_rad,
)
from companion.physics.units import DEG
from tests.support.windows import ned_from_body

UP_NED = np.array([0.0, 0.0, -1.0])


def field_ned(inclination_deg: float) -> np.ndarray:
    return np.array([math.cos(inclination_deg * DEG), 0.0, math.sin(inclination_deg * DEG)])


POSES = [(p, r, h) for p in (-40.0, 0.0, 25.0) for r in (-35.0, 0.0, 50.0) for h in (0.0, 40.0, 179.0, 271.0)]


@pytest.mark.parametrize("inclination_deg", [-72.0, 0.0, 58.0, 86.0])
def test_heading_and_inclination_of_every_pose(inclination_deg: float) -> None:
    for pose in POSES:
        body = ned_from_body(*pose).T
        field, up = 0.5 * body @ field_ned(inclination_deg), body @ UP_NED
        assert wrap_deg(heading_rad(field, up) / DEG - pose[2]) == pytest.approx(0.0, abs=1e-9)
        assert inclination_rad(field, up) / DEG == pytest.approx(inclination_deg, abs=1e-9)


def test_sensitivities_are_those_of_finite_differences() -> None:
    for pose in POSES:
        for inclination_deg in (-65.0, 20.0, 68.0):
            body = ned_from_body(*pose).T
            field, up = body @ field_ned(inclination_deg), body @ UP_NED
            by_heading, by_inclination = heading_by_up(field, up), inclination_by_up(field, up)
            for axis in np.eye(3):
                step = 1e-6 * (axis - (axis @ up) * up)
                ahead, behind = ((up + s * step) / np.linalg.norm(up + s * step) for s in (1.0, -1.0))
                turned = heading_rad(field, ahead) - heading_rad(field, behind)
                turned = math.remainder(turned, 2 * math.pi)
                assert turned / 2e-6 == pytest.approx(by_heading @ step / 1e-6, abs=1e-6)
                dipped = inclination_rad(field, ahead) - inclination_rad(field, behind)
                assert dipped / 2e-6 == pytest.approx(by_inclination @ step / 1e-6, abs=1e-6)


def test_no_heading_where_field_or_nose_is_vertical() -> None:
    for field, up in ((UP_NED, UP_NED), (np.zeros(3), UP_NED), (field_ned(50.0), np.array([1.0, 0.0, 0.0]))):
        with pytest.raises(ValueError, match="vertical"):
            heading_rad(field, up)


def test_the_bound_of_the_unseen_part_holds_in_19_of_20_directions() -> None:
    directions = np.random.default_rng(3).standard_normal((200_000, 3))
    two = np.mean(np.abs(directions[:, 1]) <= BOUND_OF_TWO * np.hypot(directions[:, 0], directions[:, 2]))
    one = np.mean(np.abs(directions[:, 1]) <= BOUND_OF_ONE * np.abs(directions[:, 2]))
    assert (two, one) == pytest.approx((0.95, 0.95), abs=0.002)


def test_the_methods_example_of_a_deflection() -> None:
    # Method 3.5: 1.3 uT across makes 4 deg at I = 68 deg (49 uT there).
    assert deflection_bound_deg(0.013, 0.49 * math.cos(68 * DEG)) == pytest.approx(4.06, abs=0.1)
    assert deflection_bound_deg(0.2, 0.19) == 180.0


def test_the_earths_field_is_the_published_one() -> None:
    # NOAA's test value (method 3.5), and the example of wrldmagm in MathWorks' Aerospace Toolbox: 1000 m over
    # Natick on 4 July 2028: D -13.6891, I 65.9899 deg, F 50940, H 20727 nT.
    pole = earth.magnetic_field(80.0, 0.0, 0.0, datetime.date(2025, 1, 1))
    assert (pole.declination_deg, pole.inclination_deg) == pytest.approx((1.28, 83.21), abs=0.005)
    natick = earth.magnetic_field(42.283, -71.35, 1000.0, datetime.date(2028, 7, 4))
    assert natick.declination_deg == pytest.approx(-13.6891, abs=0.002)
    assert natick.inclination_deg == pytest.approx(65.9899, abs=0.002)
    assert natick.strength_gauss * 1e5 == pytest.approx(50940, abs=2)
    assert natick.horizontal_gauss * 1e5 == pytest.approx(20727, abs=2)
    assert natick.compass_use == "good"


def test_the_models_own_error_grows_towards_the_magnetic_pole() -> None:
    date = datetime.date(2026, 11, 21)
    beijing, resolute = (earth.magnetic_field(*place, 0.0, date) for place in ((40.0, 116.0), (74.7, -94.8)))
    assert beijing.declination_sigma_deg == pytest.approx(math.hypot(0.26, 0.194), abs=0.002)
    assert resolute.declination_sigma_deg > 4 * beijing.declination_sigma_deg
    assert resolute.compass_use == "poor"
    at_the_dip_pole = earth.magnetic_field(86.0, 140.0, 0.0, date)
    assert at_the_dip_pole.compass_use == "none"
    assert at_the_dip_pole.inclination_deg > 89.0
