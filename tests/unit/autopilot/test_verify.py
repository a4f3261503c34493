from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from companion.autopilot.parameters.verify import EffectVerdict, Observation, judge
from companion.samples import Vector

NAMES = ("INS_GYROFFS_X", "INS_GYROFFS_Y", "INS_GYROFFS_Z")
YAW_90 = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def observation(step: Vector, made: Vector, sigma: float = 1e-5) -> Observation:
    before = (0.002, -0.003, 0.004)
    b, s, m = (np.asarray(v) for v in (before, step, made))
    after, truth = b + m, b + s
    return Observation(
        parameters=NAMES,
        unit="rad/s",
        before=before,
        before_sigma=(sigma,) * 3,
        after=(after[0], after[1], after[2]),
        after_sigma=(sigma,) * 3,
        expected_step=step,
        truth=(truth[0], truth[1], truth[2]),
        tolerance=2e-5,
    )


def words(verdict: EffectVerdict) -> list[str]:
    return list(verdict.axes.values())


def test_the_whole_step_is_seen_and_verified() -> None:
    verdict = judge(observation((-0.002, 0.003, -0.004), (-0.00201, 0.00298, -0.00401)))
    assert words(verdict) == ["seen"] * 3
    assert verdict.ok
    assert verdict.outcome("INS_GYROFFS_Y") == "verified"
    assert verdict.hidden == ()


def test_an_autopilot_that_echoes_but_does_not_use_the_value_is_named() -> None:
    verdict = judge(observation((-0.002, 0.003, -0.004), (0.0, 1e-5, -1e-5)))
    assert words(verdict) == ["not seen"] * 3
    assert not verdict.ok
    assert "INS_GYROFFS_X" in verdict.problems[0]
    assert "does not use" in verdict.problems[0]
    assert verdict.outcome("INS_GYROFFS_X") == "failed"


@pytest.mark.parametrize(
    "made", [(0.002, -0.003, 0.004), (0.003, -0.002, -0.004), (-0.001, 0.0015, -0.002)], ids=["sign", "axes", "half"]
)
def test_a_step_that_is_not_the_written_one_is_wrong(made: Vector) -> None:
    verdict = judge(observation((-0.002, 0.003, -0.004), made))
    assert "wrong" in words(verdict)
    assert not verdict.ok


def test_a_step_within_the_noise_is_too_small_and_only_stored() -> None:
    verdict = judge(observation((-2e-5, 3e-5, 0.0), (1e-5, 1e-5, -1e-5)))
    assert words(verdict) == ["too small to see"] * 3
    assert verdict.ok
    assert verdict.outcome("INS_GYROFFS_X") == "stored"
    assert len(verdict.hidden) == 2  # the one that was to stay is no news


def test_an_axis_that_moves_although_it_should_not_is_wrong() -> None:
    verdict = judge(observation((-0.002, 0.0, 0.0), (-0.002, 0.001, 0.0)))
    assert words(verdict) == ["seen", "wrong", "too small to see"]
    assert "although it should not" in verdict.problems[0]


def test_three_axes_together_see_what_none_sees_alone() -> None:
    # Each axis: 7 sigma of the difference; together 12.
    step = 7 * np.sqrt(2) * 1e-5
    verdict = judge(observation((step, step, step), (step, step, step)))
    assert words(verdict) == ["too small to see"] * 3
    assert verdict.ok
    assert verdict.hidden == ()
    unused = judge(dataclasses.replace(observation((step, step, step), (0.0, 0.0, 0.0)), tolerance=1.0))
    assert not unused.ok


def test_verdicts_name_the_parameter_of_the_boards_own_axis() -> None:
    # The board is turned by 90 degrees about z: its y points to the vehicle's -x, its x to the vehicle's y.
    board_step = np.array([0.005, 0.0, 0.0])
    step = YAW_90 @ board_step
    assert step[1] == pytest.approx(0.005)
    seen = observation((step[0], step[1], step[2]), (0.0, 0.0, 0.0))
    verdict = judge(dataclasses.replace(seen, orientation=YAW_90))
    assert words(verdict) == ["not seen", "too small to see", "too small to see"]
    assert verdict.problems[0].startswith("INS_GYROFFS_X:")


def test_sigmas_turn_with_the_board() -> None:
    seen = dataclasses.replace(
        observation((0.0, 0.005, 0.0), (0.001, 0.006, 0.0)),
        orientation=YAW_90,
        before_sigma=(1e-5, 1e-2, 1e-5),
        after_sigma=(1e-5, 1e-2, 1e-5),
        tolerance=1.0,
    )
    verdict = judge(seen)
    assert words(verdict) == ["too small to see", "wrong", "too small to see"]
    assert "INS_GYROFFS_Y: the output changed by -0.001 rad/s, expected 0, noise 1.4e-05:" in verdict.problems[0]


def test_what_remains_is_compared_with_the_tolerance() -> None:
    seen = dataclasses.replace(observation((-0.002, 0.003, -0.004), (-0.002, 0.003, -0.004)), truth=(0.0, 0.0, 0.001))
    verdict = judge(seen)
    assert not verdict.ok
    assert "still off by -0.001 rad/s" in verdict.problems[0]


def test_integer_messages_hide_steps_of_a_digit() -> None:
    seen = observation((-0.0009, 0.0009, 0.02), (0.0, 0.0, 0.0195), sigma=1e-7)
    verdict = judge(dataclasses.replace(seen, resolution=1e-3, tolerance=1e-4))
    assert words(verdict) == ["too small to see", "too small to see", "seen"]
    assert verdict.ok


def test_not_a_number_is_wrong() -> None:
    verdict = judge(observation((-0.002, 0.003, -0.004), (float("nan"), 0.003, -0.004)))
    assert verdict.axes[NAMES[0]] == "wrong"
    assert not verdict.ok


def test_false_alarms_are_rare_and_unused_values_are_found() -> None:
    rng = np.random.default_rng(5)
    false_alarms = misses = 0
    for _ in range(2000):
        sigma = 1e-5
        step = rng.normal(0, 2e-3, 3)
        noise = rng.normal(0, sigma * np.sqrt(2), 3)
        good, unused = step + noise, noise
        expected = (step[0], step[1], step[2])
        false_alarms += not judge(observation(expected, (good[0], good[1], good[2]))).ok
        misses += judge(observation(expected, (unused[0], unused[1], unused[2]))).ok
    assert false_alarms <= 4
    assert misses == 0


def test_a_step_made_by_a_turned_board_is_seen_in_its_own_axis() -> None:
    step = YAW_90 @ np.array([0.005, -0.002, 0.001])
    vector = (float(step[0]), float(step[1]), float(step[2]))
    verdict = judge(dataclasses.replace(observation(vector, vector), orientation=YAW_90))
    assert words(verdict) == ["seen"] * 3
