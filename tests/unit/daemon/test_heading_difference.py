"""Our attitude beside the autopilot's, as it comes: late, and by a clock that is not ours."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.attitude.estimator import Attitude
from companion.attitude.quaternion import Quaternion, conjugate, from_roll_pitch_yaw, multiply, rotate
from companion.daemon.heading.health import ATTITUDE_RATE_HZ, Difference

TURNS_AT_S = 60.0


def compare(rate_rad_s: float, clock: float, late_s: Callable[[int], float], drift_rad_s: float = 0.0) -> Difference:
    """An aircraft that stands for a minute, then turns for 8 s, as the autopilot tells it `late_s` later.

    `clock`: how fast the autopilot's runs; our heading drifts from the start of the turn on. Ends where it strays.
    """
    heard: list[Callable[[Any, float], None]] = []
    vehicle: Any = SimpleNamespace(hear=lambda _message, handler, _rate: heard.append(handler))
    now_s = 0.0

    def ours(t_s: float) -> float:
        return (rate_rad_s + drift_rad_s) * max(0.0, t_s - TURNS_AT_S)

    def attitude(t_s: float) -> Quaternion:
        return from_roll_pitch_yaw(0.0, 0.0, ours(t_s))

    def now() -> Attitude:
        rate = rate_rad_s + drift_rad_s if now_s > TURNS_AT_S else 0.0
        sigma = math.radians(1.0)
        return Attitude(now_s, attitude(now_s), 0.0, 0.0, ours(now_s), (0.0, 0.0, rate), (sigma, sigma, sigma))

    carrier: Any = SimpleNamespace(now=now, kept_at=lambda t_s: (t_s, attitude(t_s)))
    difference = Difference(vehicle, carrier)
    for k in range(int((TURNS_AT_S + 8.0) * ATTITUDE_RATE_HZ)):
        said_s = 1.0 + k / ATTITUDE_RATE_HZ
        rate = rate_rad_s if said_s > TURNS_AT_S else 0.0
        boot_ms = round(1e3 * (100.0 + clock * said_s))
        theirs = math.remainder(rate_rad_s * max(0.0, said_s - TURNS_AT_S), math.tau)
        message = mavlink.MAVLink_attitude_message(boot_ms, 0.0, 0.0, theirs, 0.0, 0.0, rate)
        now_s = max(now_s, said_s + late_s(k))
        heard[0](message, now_s)
        if difference.straying.is_too_far:
            break
    return difference


@pytest.mark.parametrize("clock", [1.0, 0.989, 1.011], ids=["as ours", "slower", "faster"])
@pytest.mark.parametrize("late_s", [lambda _k: 0.0, lambda k: 0.06 * (k % 3)], ids=["at once", "late at times"])
def test_a_turn_is_the_same_to_both_whatever_the_autopilots_clock(clock: float, late_s: Callable[[int], float]) -> None:
    """Pairing a heading of 12:00:00 with one of 12:00:01 would show a drift in every turn."""
    difference = compare(math.radians(40.0), clock, late_s)
    assert not difference.straying.is_too_far
    assert abs(difference.heading_rad) < math.radians(3.0)


@pytest.mark.parametrize("rate_deg_s", [45.0, 90.0, -180.0])
@pytest.mark.parametrize("recovers_s", [0.5, 2.0, 6.0])
def test_a_line_that_is_late_for_a_while_makes_no_turn_a_drift(rate_deg_s: float, recovers_s: float) -> None:
    """Late by 0.3 s for 10 s, and on time again so long after the turn has begun."""
    last = round((TURNS_AT_S + recovers_s - 1.0) * ATTITUDE_RATE_HZ)
    difference = compare(math.radians(rate_deg_s), 1.0, lambda k: 0.3 if last - 100 < k <= last else 0.0)
    assert not difference.straying.is_too_far


def test_a_line_that_is_quicker_now_and_then_hides_no_drift() -> None:
    """PX4 leaps to a heading that it has refused for 1 s; one of 3 deg/s it refuses from 2.7 s on."""
    late = compare(0.0, 1.0, lambda k: 0.0 if k % 18 == 0 else 0.08, drift_rad_s=math.radians(3.0))
    assert late.straying.is_too_far
    assert late.heard_s < TURNS_AT_S + 2.7


def test_what_is_sent_has_the_autopilots_vertical_and_our_heading() -> None:
    """Both lean by 33 deg towards a corner, ours by 4 deg less: PX4 would take the two headings in other orders."""
    heard: list[Callable[[Any, float], None]] = []
    vehicle: Any = SimpleNamespace(hear=lambda _message, handler, _rate: heard.append(handler))
    angles = (math.radians(-20.0), math.radians(21.0), math.radians(40.0))
    sigma = (0.02, 0.02, 0.02)
    ours = Attitude(10.0, from_roll_pitch_yaw(*angles), *angles, (0.0, 0.0, 0.0), sigma)
    carrier: Any = SimpleNamespace(now=lambda: ours, kept_at=lambda _t_s: (10.0, ours.quaternion))
    difference = Difference(vehicle, carrier)
    assert difference.levelled(ours, 10.0) is ours
    roll, pitch = math.radians(-24.0), math.radians(23.0)
    heard[0](mavlink.MAVLink_attitude_message(5000, roll, pitch, math.radians(41.0), 0.0, 0.0, 0.0), 10.0)
    found = difference.levelled(ours, 10.1)
    assert (found.roll_rad, found.pitch_rad) == pytest.approx((roll, pitch), abs=1e-6)
    # Turned about a level axis: what is forward, seen from above, has turned by the share of it that the tilt lets.
    down = rotate(multiply(found.quaternion, conjugate(ours.quaternion)), (0.0, 0.0, 1.0))
    turn = multiply(found.quaternion, conjugate(ours.quaternion))
    assert turn[3] == pytest.approx(0.0, abs=1e-6)
    assert math.degrees(math.acos(down[2])) == pytest.approx(4.3, abs=0.3)
    assert (found.t_s, found.sigma_rad, found.rate_rad_s) == (ours.t_s, ours.sigma_rad, ours.rate_rad_s)
