"""Boards turned and propped up by hand: a slice of the bench, and its rivals on readings whose truth is plain."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sim.accuracy.by_hand import rivals, table
from sim.accuracy.by_hand.stands import BY_HAND, TURNS, HandRun, by_hand
from sim.accuracy.figures import rms
from sim.earth import STANDARD_GRAVITY_M_S2
from sim.imu_model import MG
from tests.support.extent import extent

Floats = NDArray[np.float64]
EACH = extent(whole=60, a_slice=4)
BIAS, SCALE = np.array([20.0, -30.0, 10.0]) * MG, np.array([0.004, -0.006, 0.002])
SIDES = np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)], dtype=np.float64)
EDGES = np.array([(1, 1, 0), (1, -1, 0), (-1, 0, 1), (0, 1, -1), (0, -1, -1), (-1, -1, 0)]) / np.sqrt(2.0)


def read(ups: Floats, response: Floats, gravity_m_s2: float) -> list[Floats]:
    """A thousand readings without noise of each stand."""
    return [np.tile(response @ up * gravity_m_s2 + BIAS, (1000, 1)) for up in ups]


def test_the_rivals_find_what_they_can_find() -> None:
    sheared = np.diag(1.0 + SCALE) + 0.003 * (np.ones((3, 3)) - np.eye(3))
    found = rivals.imu_tk(read(np.vstack([SIDES, EDGES]), sheared, 9.79), 9.79)
    np.testing.assert_allclose(found.bias, BIAS, atol=1e-6)
    np.testing.assert_allclose(found.scale, SCALE, atol=1e-7)
    square = read(SIDES, np.diag(1.0 + SCALE), STANDARD_GRAVITY_M_S2)
    for method in (rivals.ardupilot, rivals.px4):
        found = method(square)
        np.testing.assert_allclose(found.bias, BIAS, atol=1e-6)
        np.testing.assert_allclose(found.scale, SCALE, atol=1e-7)


def test_px4_takes_its_sides_for_exact_and_both_firmwares_gravity_for_standard() -> None:
    tilt = np.radians(5.0)
    tipped = SIDES.copy()
    tipped[0] = [np.cos(tilt), np.sin(tilt), 0.0]
    off = rivals.px4(read(tipped, np.eye(3), STANDARD_GRAVITY_M_S2)).bias - BIAS
    assert off[0] == pytest.approx(-(1.0 - np.cos(tilt)) / 2.0 * STANDARD_GRAVITY_M_S2, rel=0.01)
    heavy = read(SIDES, np.eye(3), 9.83)
    for method in (rivals.ardupilot, rivals.px4):
        np.testing.assert_allclose(method(heavy).scale, 9.83 / STANDARD_GRAVITY_M_S2 - 1.0, atol=1e-6)


@pytest.fixture(scope="module")
def runs() -> list[HandRun]:
    return [by_hand(part, 1, number) for part in BY_HAND for number in range(EACH)]


def test_every_claim_holds_in_small(runs: list[HandRun]) -> None:
    section = table.section(runs, EACH)
    assert not [str(claim) for claim in section.claims if not claim.holds]
    assert set(section.figures) == {"turn", "faces", "level"}


def test_errors_are_within_what_is_said_of_them(runs: list[HandRun]) -> None:
    for run in runs:
        assert (np.abs(run.faces) < 5.0 * run.faces_sigma).all()
        assert (np.abs(run.turn) < 5.0 * run.turn_sigma).all()
        assert (np.abs(run.level) < 5.0 * run.level_sigma).all()


def test_the_firmwares_put_the_slope_into_the_level(runs: list[HandRun]) -> None:
    found = np.degrees([np.linalg.norm(run.level_firmware) for run in runs])
    np.testing.assert_allclose(found, 5.0, atol=0.3)


def test_half_a_turn_on_a_steep_slope_is_nearly_as_good_as_four(runs: list[HandRun]) -> None:
    """A degree of turn costs 0.76 mg there: it is known to a fifth of one, once the circle is closed."""
    sigma = np.array([run.turn_sigma for run in runs]).mean(axis=(0, 2)) / MG
    by = dict(zip(TURNS, sigma, strict=True))
    assert by[2, 5.0] < 1.6 * by[4, 5.0]
    assert by[2, 0.5] < 0.25
    row = TURNS.index((2, 5.0))
    assert rms(np.array([run.turn[row] for run in runs])).value / MG < 0.35
