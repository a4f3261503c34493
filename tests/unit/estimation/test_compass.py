"""Hard and soft iron of a compass against the truth, by formulas of `sim` and by hand."""

from __future__ import annotations

import dataclasses
import datetime
import math

import numpy as np
import pytest

from companion.errors import CalibrationRefusedError
from companion.estimation.alignment import compass as compass_module
from companion.estimation.alignment.compass import CompassFigures, CompassPose, compass
from companion.physics.earth import MagneticField, magnetic_field
from sim.accuracy import compasses
from sim.accuracy.figures import covered, rms, stack
from sim.earth import body_from_ned
from sim.hands import SIDES

EARTH = magnetic_field(47.4, 8.5, 400.0, datetime.date(2026, 6, 1))
NO_IRON = CompassFigures(np.zeros(3), np.eye(3))
UP = np.array([0.0, 0.0, -1.0])


def at(heading_deg: float, earth: MagneticField = EARTH, turned_deg: float = 0.0) -> CompassPose:
    """A level pose of a compass with an offset of 100 mG to the right."""
    h, heading = earth.horizontal_gauss, math.radians(heading_deg)
    raw = np.array([h * math.cos(heading), -h * math.sin(heading) - 0.1, earth.down_gauss])
    return CompassPose(UP, raw, np.full(3, 3e-4), math.radians(turned_deg), 0.003)


def test_four_headings_leave_less_than_half_a_degree_and_sigma_says_so() -> None:
    runs = [compasses.board(7, number) for number in range(40)]
    for slope_deg in (0.0, 10.0):
        case = compasses.CASES.index((4, slope_deg, compasses.QUIET))
        level, sigma = stack(runs, "level")[:, case], stack(runs, "level_sigma")[:, case]
        assert math.degrees(rms(level).value) < 0.45
        assert covered(level, sigma, 2.0).value > 0.9
        assert stack(runs, "named")[:, case].mean() < 0.05
    bent = compasses.CASES.index((4, 0.0, compasses.BENT))
    assert stack(runs, "named")[:, bent].mean() > 0.75


def test_a_turn_on_a_slope_is_no_azimuth() -> None:
    nose_up = body_from_ned(0.0, math.radians(10.0), 0.0)
    turned = compass_module._azimuth_turned(nose_up, math.radians(45.0))
    assert math.degrees(turned) == pytest.approx(math.degrees(math.atan(1.0 / math.cos(math.radians(10.0)))))
    assert compass_module._azimuth_turned(nose_up, math.radians(450.0)) == pytest.approx(math.radians(450.0))


def test_one_pose_and_a_typed_heading_carry_its_error() -> None:
    found = compass([at(30.0)], EARTH, NO_IRON, 0.001, (math.radians(31.0), math.radians(2.0)))
    assert found.figures.offset_gauss == pytest.approx([0.0, 0.1, 0.0], abs=EARTH.horizontal_gauss * math.radians(1.1))
    assert math.degrees(found.heading_sigma_rad) == pytest.approx(2.0, abs=0.1)
    assert math.degrees(found.sigma_rad()) > 2.0


def test_six_sides_at_unknown_headings_and_sigma_says_how_good_they_are() -> None:
    errors, sigmas, offsets = [], [], []
    for number in range(60):
        random = np.random.default_rng([number, 41])
        hard, soft = random.normal(0.0, 0.08, 3), np.eye(3) + np.diag(random.uniform(-0.05, 0.05, 3))
        soft[0, 1] = soft[1, 0] = random.uniform(-0.05, 0.05)
        soft[1, 2] = soft[2, 1] = random.uniform(-0.05, 0.05)
        field = np.array([EARTH.horizontal_gauss, 0.0, EARTH.down_gauss])
        here, poses = field + random.normal(0.0, 0.002, 3) * (1.0, 0.0, 1.0), []
        for pitch, roll in SIDES.values():
            off_roll, off_pitch = np.radians((roll, pitch)) + random.normal(0.0, math.radians(4.0), 2)
            body = body_from_ned(off_roll, off_pitch, random.uniform(0.0, math.tau))
            raw = np.linalg.solve(soft, body @ here) - hard + random.normal(0.0, 1.1e-3, 3)
            up = body @ UP + random.normal(0.0, 0.002, 3)
            poses.append(CompassPose(up / np.linalg.norm(up), raw, np.full(3, 5e-4), 0.0, math.inf))
        found = compass(poses, EARTH, NO_IRON, 0.002)
        errors.append(compasses._errors(found.figures, hard, soft, field, 0.0, 0.0))
        sigmas.append(np.full(36, found.sigma_rad()))
        offsets.append((found.figures.offset_gauss - hard) / found.offset_sigma_gauss)
        assert found.bent is None
    assert math.degrees(np.sqrt(np.mean(np.square(errors)))) < 0.7
    assert 0.92 < covered(np.array(errors), np.array(sigmas), 2.0).value < 0.995
    assert np.sqrt(np.mean(np.square(offsets))) < 1.1


def test_a_field_far_too_strong_is_named() -> None:
    strong = dataclasses.replace(EARTH, strength_gauss=1.2 * EARTH.strength_gauss)
    found = compass([at(heading, strong, 90.0) for heading in (0.0, 90.0, 180.0, 270.0)], EARTH, NO_IRON, 0.001)
    assert found.strength == pytest.approx(1.2, abs=0.01)
    assert found.bent == "field 20 % too strong here"


def test_readings_that_do_not_turn_with_the_aircraft_are_no_compass() -> None:
    still = [at(0.0, turned_deg=90.0) for _ in range(4)]
    try:
        found = compass(still, EARTH, NO_IRON, 0.001)
    except CalibrationRefusedError:
        return
    assert found.bent is not None
