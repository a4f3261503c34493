"""Which stand is asked for, and which is taken: a pilot's turns and tilts, in figures worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.daemon.calibrating.align_steps import Plan, Seen, objection, request, turned_deg


def stands(heading_deg: float, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> Seen:
    theta, gamma = math.radians(pitch_deg), math.radians(roll_deg)
    up = [math.sin(theta), -math.sin(gamma) * math.cos(theta), -math.cos(gamma) * math.cos(theta)]
    return Seen(np.array(up), heading_deg)


LEVEL = stands(350.0, 0.4, -0.3)


@pytest.mark.parametrize(
    ("plan", "total", "on_spot"),
    [
        (Plan("zero"), 3, 3),
        (Plan("zero", headings=4), 4, 4),
        (Plan("tilts"), 8, 4),
    ],
)
def test_how_many_stands(plan: Plan, total: int, on_spot: int) -> None:
    assert (plan.total, plan.on_spot) == (total, on_spot)


def test_there_and_back() -> None:
    plan = Plan("zero")
    assert "marked spot" in request(plan, [])
    assert objection(plan, [], LEVEL) is None
    assert "by 180 deg" in request(plan, [LEVEL])
    for heading in (170.0, 150.0, 195.0):
        assert objection(plan, [LEVEL], stands(heading)) is None
    said = objection(plan, [LEVEL], stands(90.0))
    assert said == "it stands 100 deg from where it stood first, should be 180: turn it by 80 deg more"
    assert "turn it back" in request(plan, [LEVEL, stands(170.0)])
    assert objection(plan, [LEVEL, stands(170.0)], stands(5.0)) is None
    assert objection(plan, [LEVEL, stands(170.0)], stands(170.0)) is not None


def test_quarters_in_any_order() -> None:
    plan = Plan("zero", headings=4)
    taken = [LEVEL, stands(260.0)]
    assert objection(plan, taken, stands(80.0)) is None
    assert objection(plan, taken, stands(170.0)) is None
    assert "270 deg from the first was measured already" in (objection(plan, taken, stands(265.0)) or "")
    assert "0 deg from the first was measured already" in (objection(plan, taken, stands(352.0)) or "")
    assert "make it 90, 180 or 270" in (objection(plan, taken, stands(350.0 + 45.0)) or "")


def test_tilts_to_sides_not_yet_taken() -> None:
    plan = Plan("tilts")
    spot = [stands(350.0), stands(80.0), stands(170.0), stands(260.0)]
    assert "nose up, nose down, left or right side down" in request(plan, spot)
    assert "tilted by 5 deg only" in (objection(plan, spot, stands(3.0, 5.0)) or "")
    taken = [*spot, stands(3.0, 22.0), stands(9.0, 0.0, -22.0)]
    assert "not nose up or left side down again" in request(plan, taken)
    assert "nose up was measured already" in (objection(plan, taken, stands(0.0, 20.0, 5.0)) or "")
    assert objection(plan, taken, stands(0.0, -20.0)) is None
    assert objection(plan, taken, stands(0.0, 1.0, 25.0)) is None


def test_a_turn_by_the_gyros() -> None:
    rate = math.radians(18.0)
    assert turned_deg([rate + 0.001] * 10, 0.001) == pytest.approx(180.0)
