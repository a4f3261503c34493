"""Requested and accepted stands: a pilot's turns and tilts, in figures worked out by hand."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator

import numpy as np
import pytest

from companion.component.statustext import Severity, as_lines
from companion.estimation.alignment.faces import _all_sides
from companion.estimation.alignment.poses import (
    AlignmentRequest,
    HeldPose,
    asked_turn_deg,
    leaned_deg,
    objection,
    wanted_pose,
)


def stands(heading_deg: float, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> HeldPose:
    theta, gamma = math.radians(pitch_deg), math.radians(roll_deg)
    up = [math.sin(theta), -math.sin(gamma) * math.cos(theta), -math.cos(gamma) * math.cos(theta)]
    return HeldPose(np.array(up), heading_deg)


LEVEL = stands(350.0, 0.4, -0.3)


def test_there_and_back() -> None:
    plan = AlignmentRequest("zero")
    assert "marked spot" in wanted_pose(plan, []).words
    assert objection(plan, [], LEVEL) is None
    propped = HeldPose(np.array([np.sin(np.radians(45.0)), 0.0, -np.cos(np.radians(45.0))]), 0.0)
    assert objection(plan, [], propped) == "tilted by 45 degrees: stand it on its base"
    assert "by 180 degrees" in wanted_pose(plan, [LEVEL]).words
    for heading in (170.0, 150.0, 195.0):
        assert objection(plan, [LEVEL], stands(heading)) is None
    said = objection(plan, [LEVEL], stands(90.0))
    assert said == "100 degrees, not 180: turn it by 80 degrees more"
    assert "the same way" in wanted_pose(plan, [LEVEL, stands(170.0)]).words
    assert objection(plan, [LEVEL, stands(170.0)], stands(5.0)) is None
    assert objection(plan, [LEVEL, stands(170.0)], stands(170.0)) is not None


def test_quarters_out_of_order_are_led_to_the_one_that_is_open() -> None:
    plan = AlignmentRequest("turn", headings=4)
    taken = [stands(10.0), stands(190.0), stands(283.0)]
    assert wanted_pose(plan, taken).words == "turn it by 180 degrees on its spot"
    assert objection(plan, taken, stands(6.0)) == "0 degrees again: turn it on by 90 degrees"
    assert objection(plan, taken, stands(185.0)) == "180 degrees again: turn it on by 270 degrees"
    assert asked_turn_deg(plan, [*taken, stands(102.0)]) == 270.0


def test_a_lean_within_a_stand_is_told_from_noise() -> None:
    noise = 0.001 * np.random.default_rng(7).standard_normal((12, 3))
    still = np.array([0.3, -0.2, -9.8]) + noise
    assert leaned_deg(still) == 0.0
    slowly = still + np.outer(np.linspace(0.0, 9.81 * math.radians(0.15), 12), [0.0, 1.0, 0.0])
    assert leaned_deg(slowly) == pytest.approx(0.1, abs=0.02)  # from the middle of the first third to that of the last
    assert leaned_deg(slowly[:5]) == 0.0


def test_tilts_to_sides_not_yet_taken() -> None:
    plan = AlignmentRequest("tilts")
    spot = [stands(350.0), stands(80.0), stands(170.0), stands(260.0)]
    assert "nose up, nose down, left or right side down" in wanted_pose(plan, spot).words
    assert "tilted by 5 degrees only" in (objection(plan, spot, stands(3.0, 5.0)) or "")
    taken = [*spot, stands(3.0, 22.0), stands(9.0, 0.0, -22.0)]
    assert "not nose up or left side down again" in wanted_pose(plan, taken).words
    assert "nose up again" in (objection(plan, taken, stands(0.0, 20.0, 5.0)) or "")
    assert objection(plan, taken, stands(0.0, -20.0)) is None
    assert objection(plan, taken, stands(0.0, 1.0, 25.0)) is None


@pytest.mark.parametrize(
    ("plan", "number", "turn_deg"),
    [
        (AlignmentRequest("zero"), 1, 180.0),
        (AlignmentRequest("zero"), 2, 180.0),
        (AlignmentRequest("turn", headings=4), 4, 90.0),
        (AlignmentRequest("tilts"), 3, 90.0),
        (AlignmentRequest("tilts"), 4, 0.0),
    ],
)
def test_a_turn_that_nobody_counted_is_taken_as_asked(plan: AlignmentRequest, number: int, turn_deg: float) -> None:
    """And always goes on: turned back, the gyros' scale would stay unknown."""
    taken = [stands(asked_turn_deg(plan, [stands(0.0)]) * k + 10.0) for k in range(number)]
    assert asked_turn_deg(plan, taken) == turn_deg


def every_request() -> Iterator[str]:
    """With the longest words and numbers that there can be."""
    for plan in (AlignmentRequest("zero"), AlignmentRequest("turn", headings=4), AlignmentRequest("tilts")):
        spot = [stands(heading) for heading in (0.0, 90.0, 180.0, 270.0, 0.0)][: plan.on_spot]
        tilted = [stands(0.0, 22.0), stands(0.0, -22.0), stands(0.0, 0.0, -22.0), stands(0.0, 0.0, 22.0)]
        taken = [*spot, *tilted][: plan.total]
        for number in range(plan.total):
            yield f"{number + 1} of {plan.total}: {wanted_pose(plan, taken[:number]).words}"
    for side, _ in _all_sides(np.eye(3)):
        yield f"24 of 24: {side}: one pose does not fit, this one shows which"


def test_what_is_asked_for_is_one_line_to_be_heard() -> None:
    spoken = [as_lines(Severity.NOTICE, asked)[0][1].rstrip(":") for asked in every_request()]
    for words in spoken:
        assert len(words) <= 50, words
        assert not re.search(r"\b(deg|mg|s)\b|[%/;]", words), "no abbreviations: it is spoken"
    assert "2 of 3: turn it by 180 degrees, onto its marks" in spoken
    assert "24 of 24: on its back with right side half down" in spoken


def test_what_is_wrong_with_a_turn_or_a_tilt_is_one_line_too() -> None:
    tilts = AlignmentRequest("tilts")
    spot = [stands(heading) for heading in (0.0, 90.0, 180.0, 270.0)]
    tilted = [*spot, stands(0.0, 0.0, 22.0)]
    said = [
        objection(AlignmentRequest("zero"), [LEVEL], stands(10.0)),
        objection(AlignmentRequest("zero"), [LEVEL, stands(180.0)], stands(180.0)),
        objection(AlignmentRequest("zero", headings=4), [LEVEL], stands(224.0)),
        objection(AlignmentRequest("zero", headings=4), [LEVEL, stands(270.0)], stands(270.0)),
        objection(tilts, spot, stands(0.0, 12.0)),
        objection(tilts, tilted, stands(0.0, 0.0, 25.0)),
    ]
    for words in said:
        assert words is not None
        assert len(words) <= 50, words
        assert not re.search(r"\bdeg\b|[%/;]", words), words
