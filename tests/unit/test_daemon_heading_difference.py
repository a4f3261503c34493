"""Our attitude beside the autopilot's, as it comes: late, and by a clock that is not ours."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.attitude.estimator import Attitude
from companion.attitude.quaternion import Quaternion, from_roll_pitch_yaw
from companion.daemon.heading.health import ATTITUDE_RATE_HZ, Difference

RATE_RAD_S = math.radians(40.0)
TURNS_AT_S = 60.0


def yaw_at(t_s: float) -> float:
    """It stands for a minute, then turns."""
    return RATE_RAD_S * max(0.0, t_s - TURNS_AT_S)


@pytest.mark.parametrize("clock", [1.0, 0.989, 1.011], ids=["as ours", "slower", "faster"])
@pytest.mark.parametrize("late_s", [lambda _k: 0.0, lambda k: 0.06 * (k % 3)], ids=["at once", "late at times"])
def test_a_turn_is_the_same_to_both_whatever_the_autopilots_clock(clock: float, late_s: Callable[[int], float]) -> None:
    """Who pairs what was said at 12:00:00 with a heading of 12:00:01 sees a heading that strays in every turn."""
    heard: list[Callable[[Any, float], None]] = []
    vehicle: Any = SimpleNamespace(hear=lambda _message, handler, _rate: heard.append(handler))
    now_s = 0.0

    def attitude(t_s: float) -> Quaternion:
        return from_roll_pitch_yaw(0.0, 0.0, yaw_at(t_s))

    def now() -> Attitude:
        rate = RATE_RAD_S if now_s > TURNS_AT_S else 0.0
        sigma = math.radians(1.0)
        return Attitude(now_s, attitude(now_s), 0.0, 0.0, yaw_at(now_s), (0.0, 0.0, rate), (sigma, sigma, sigma))

    difference = Difference(vehicle, now, lambda t_s: (t_s, attitude(t_s)))
    for k in range(int((TURNS_AT_S + 8.0) * ATTITUDE_RATE_HZ)):
        said_s = 1.0 + k / ATTITUDE_RATE_HZ
        rate = RATE_RAD_S if said_s > TURNS_AT_S else 0.0
        boot_ms = round(1e3 * (100.0 + clock * said_s))
        message = mavlink.MAVLink_attitude_message(
            boot_ms, 0.0, 0.0, math.remainder(yaw_at(said_s), math.tau), 0.0, 0.0, rate
        )
        now_s = said_s + late_s(k)
        heard[0](message, now_s)
        assert not difference.straying.is_too_far, said_s
    assert abs(difference.heading_rad) < math.radians(3.0)
