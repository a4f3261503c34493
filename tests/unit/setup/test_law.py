"""The guided test of a gradienter: from two tilts, law and mounting are told or the test refuses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.errors import CalibrationRefusedError
from companion.physics.gradienter import Law
from companion.physics.units import G
from companion.setup.law import LEAST_DEG, STEPS, Tilt, TiltTest, law_of


def readings_deg(law: Law, pitch_deg: float, roll_deg: float, yaw_deg: int) -> tuple[float, float]:
    """Readings x and y by the table of docs/calibration.md, of a sensor turned clockwise by `yaw_deg`."""
    theta, gamma = math.radians(pitch_deg), math.radians(roll_deg)
    # Direction up along front and right of the aircraft, then of the turned sensor.
    front, right = math.sin(theta), -math.sin(gamma) * math.cos(theta)
    c, s = {0: (1, 0), 90: (0, 1), 180: (-1, 0), 270: (0, -1)}[yaw_deg]
    front, right = c * front + s * right, c * right - s * front
    theta = math.asin(front)
    gamma = math.asin(-right / math.cos(theta))
    by_law = {
        "axis": (math.asin(-right), theta),
        "slope": (gamma, math.atan(math.tan(theta) / math.cos(gamma))),
        "euler": (gamma, theta),
    }
    return math.degrees(by_law[law][0]), math.degrees(by_law[law][1])


def tilt(law: Law, pitch_deg: float, roll_deg: float, yaw_deg: int, bias_g: tuple[float, float, float]) -> Tilt:
    theta, gamma = math.radians(pitch_deg), math.radians(roll_deg)
    up = np.array([math.sin(theta), -math.sin(gamma) * math.cos(theta), -math.cos(gamma) * math.cos(theta)])
    zero_deg = (0.8, -1.1)
    return Tilt(np.add(readings_deg(law, pitch_deg, roll_deg, yaw_deg), zero_deg), G * (up + np.array(bias_g)))


@pytest.mark.parametrize("bias_g", [(0.0, 0.0, 0.0), (0.06, -0.04, 0.05)])
@pytest.mark.parametrize("yaw_deg", [0, 90, 180, 270])
@pytest.mark.parametrize("law", ["axis", "slope", "euler"])
def test_two_tilts_tell_law_and_mounting(law: Law, yaw_deg: int, bias_g: tuple[float, float, float]) -> None:
    tilts = [tilt(law, 22.0, 19.0, yaw_deg, bias_g), tilt(law, -18.0, -26.0, yaw_deg, bias_g)]
    assert law_of(tilts) == (law, yaw_deg)


def test_tilts_that_fit_none_or_two_are_refused() -> None:
    first, second = tilt("axis", 22.0, 19.0, 0, (0.0, 0.0, 0.0)), tilt("axis", -22.0, -19.0, 0, (0.0, 0.0, 0.0))
    with pytest.raises(CalibrationRefusedError, match="no law explains"):
        law_of([first._replace(readings_deg=first.readings_deg * 1.4), second])
    small = [tilt("slope", sign * 8.0, sign * 8.0, 0, (0.0, 0.0, 0.0)) for sign in (1, -1)]
    with pytest.raises(CalibrationRefusedError, match="tilt further"):
        law_of(small)


def force(pitch_deg: float, roll_deg: float) -> np.ndarray:
    return tilt("euler", pitch_deg, roll_deg, 0, (0.0, 0.0, 0.0)).force_m_s2


def test_only_steady_and_opposite_tilts_count() -> None:
    said: list[str] = []
    test, seconds = TiltTest(said.append), iter(range(100))

    def held(x_deg: float, y_deg: float, sway_deg: float = 0.0) -> None:
        for k in range(5):
            test.add(next(seconds), Tilt(np.array([x_deg + sway_deg * k, y_deg]), force(y_deg, x_deg)))

    held(3.0, 25.0)
    held(25.0, 25.0, sway_deg=1.0)
    assert test.tilts == []
    assert said[-1] == "  Nose up 25 deg: good; right side down 25 deg: good. It moves: hold it still."
    held(25.0, 25.0)
    held(-25.0, 25.0)
    assert len(test.tilts) == 1
    assert [line for line in said if not line.startswith("  ")] == list(STEPS)
    held(-22.0, -28.0)
    assert len(test.tilts) == 2
    assert said[-1] == "Tilt 2 is measured."


@pytest.mark.parametrize("law", ["axis", "slope", "euler"])
@pytest.mark.parametrize("angles_deg", [(17.0, 17.0), (17.0, 26.0), (26.0, 17.0), (26.0, 26.0)])
def test_the_tilts_asked_for_are_in_a_range_of_30_deg_and_tell_the_law(
    law: Law, angles_deg: tuple[float, float]
) -> None:
    for sign in (1.0, -1.0):
        sizes = np.abs(readings_deg(law, sign * angles_deg[0], sign * angles_deg[1], 0))
        assert sizes.min() > LEAST_DEG
        assert sizes.max() < 30.0 - 1.0, "a degree is left for its zero"
    both = [tilt(law, sign * angles_deg[0], sign * angles_deg[1], 0, (0.0, 0.0, 0.0)) for sign in (1.0, -1.0)]
    assert law_of(both) == (law, 0)


def test_it_says_how_much_each_angle_wants_and_how_far_to_come_back_into_the_range() -> None:
    said: list[str] = []
    test, seconds = TiltTest(said.append), iter(range(100))

    def at(pitch_deg: float, roll_deg: float, *, reads: bool = True) -> str:
        readings = np.array(readings_deg("axis", pitch_deg, roll_deg, 0) if reads else (math.nan, math.nan))
        for _ in range(3):
            test.add(next(seconds), Tilt(readings, force(pitch_deg, roll_deg)))
        return said[-1]

    assert at(10.0, 4.0) == "  Nose up 10 deg: 10 deg more; right side down 4 deg: 16 deg more."
    lines = len(said)
    assert at(12.0, 5.0) == said[lines - 1], "one line is enough while little changes"
    assert at(33.0, 26.0, reads=False) == (
        "  Nose up 33 deg: 15 deg back; right side down 26 deg: 8 deg back. The gradienter gives no reading: over its"
        " range?"
    )
    assert at(-18.0, -18.0).startswith("  Nose up -18 deg: 38 deg more; "), "the other way round is the second tilt"
    assert at(18.0, 18.0) == STEPS[1]
    assert at(18.0, 18.0) == "  Nose down -18 deg: 38 deg more; right side up -18 deg: 38 deg more."
    assert at(-30.0, -10.0) == "  Nose down 30 deg: 10 deg back; right side up 10 deg: 10 deg more."
