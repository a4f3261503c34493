"""The guided test of a gradienter: from two tilts, law and mounting are told or the test refuses."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.errors import CalibrationRefusedError
from companion.physics.gradienter import Law
from companion.physics.units import G
from companion.setup.law import STEPS, Tilt, TiltTest, law_of


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


def test_only_steady_and_opposite_tilts_count() -> None:
    said: list[str] = []
    test, seconds = TiltTest(said.append), iter(range(100))
    force = np.array([0.0, 0.0, -G])

    def held(x_deg: float, y_deg: float, sway_deg: float = 0.0) -> None:
        for k in range(5):
            test.add(next(seconds), Tilt(np.array([x_deg + sway_deg * k, y_deg]), force))

    held(3.0, 25.0)
    held(25.0, 25.0, sway_deg=1.0)
    assert test.tilts == []
    held(25.0, 25.0)
    held(-25.0, 25.0)
    assert len(test.tilts) == 1
    assert said == list(STEPS)
    held(-22.0, -28.0)
    assert len(test.tilts) == 2
