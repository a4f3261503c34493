"""AHRS.omegaI as the measure of whether the autopilot's EKF has settled."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.ekf import EkfWatch
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.links.mavlink.link import MavlinkLink
from tests.support.scripted_autopilot import ScriptedAutopilot, flying_on
from tests.support.virtual_time import run_virtual


async def settle(
    omega_deg_s: Callable[[float], float],
    period_s: float | None,
    *,
    within_s: float = 30.0,
    act: Callable[[ScriptedAutopilot], object] = lambda autopilot: None,
) -> tuple[str | None, float, list[str]]:
    """Texts, duration and progress of settling, with omegaI y sent every `period_s`."""
    link, autopilot = MavlinkLink(), ScriptedAutopilot()
    vehicle = Vehicle(link)
    watch = EkfWatch(vehicle)
    said: list[str] = []
    loop = asyncio.get_running_loop()

    async def tell(begun_s: float) -> None:
        while period_s is not None:
            await asyncio.sleep(period_s)
            rate = math.radians(omega_deg_s(loop.time() - begun_s))
            autopilot.send(mavlink.MAVLink_ahrs_message(0.0, -rate, 0.0, 0, 0, 0, 0))

    async with flying_on(link, autopilot):
        await vehicle.found.wait()
        await asyncio.sleep(1.0)
        begun_s = loop.time()
        telling = asyncio.create_task(tell(begun_s))
        loop.call_later(5.0, act, autopilot)
        words = await watch.settle(within_s, said.append)
        telling.cancel()
        took_s = loop.time() - begun_s
    vehicle.close()
    return words, took_s, said


def test_it_has_settled_when_the_mean_of_two_seconds_is_below_72_deg_h() -> None:
    words, took_s, said = run_virtual(settle(lambda t_s: 0.3 * math.exp(-t_s / 5.0), 0.25))
    assert words is None
    # 0.3 deg/s is down to 0.02 after 13.5 s; the mean lags by a second.
    assert 13.0 < took_s < 16.0
    assert said[0] == "EKF adjusting: 30 s at most"


def test_a_busy_link_that_lets_an_ahrs_through_now_and_then_is_enough() -> None:
    words, took_s, _ = run_virtual(settle(lambda t_s: 0.0, 3.0))
    assert words is None
    assert took_s < 10.0


def test_what_does_not_settle_is_named_with_its_figure() -> None:
    words, took_s, _ = run_virtual(settle(lambda t_s: 0.3, 0.25))
    assert words == "the EKF has not settled (0.30 deg/s): wait 2 min before take-off, or restart the autopilot"
    assert took_s == pytest.approx(30.0, abs=1.0)


def test_an_autopilot_without_ahrs_is_not_waited_for() -> None:
    words, took_s, _ = run_virtual(settle(lambda t_s: 0.0, None))
    assert words is not None
    assert "bias unknown" in words
    assert took_s < 6.0


def test_arming_ends_the_waiting() -> None:
    def arm(autopilot: ScriptedAutopilot) -> None:
        autopilot.armed = True
        autopilot.beat()

    words, took_s, _ = run_virtual(settle(lambda t_s: 0.3, 0.25, act=arm))
    assert words is not None
    assert words == "the heading may turn for a minute: armed before the EKF had settled (0.30 deg/s)"
    assert took_s < 6.0
