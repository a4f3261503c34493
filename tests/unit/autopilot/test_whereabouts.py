"""Accepted and rejected values of the autopilot's time and place."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.whereabouts import TimeAndPlace
from tests.support.virtual_time import run_virtual

HOME = (47.3977, 8.5456, 488.0)
EQUATOR = (0.0001, 8.5456, 488.0)
Story = Callable[[TimeAndPlace], Coroutine[None, None, None]]


def tell(story: Story, *, carried: bool = False) -> None:
    async def main() -> None:
        await story(TimeAndPlace(lambda: carried))

    run_virtual(main())


def now_s() -> float:
    return asyncio.get_running_loop().time()


def say(told: TimeAndPlace, latitude_deg: float, longitude_deg: float, height_m: float) -> None:
    message = mavlink.MAVLink_global_position_int_message(
        0, round(latitude_deg * 1e7), round(longitude_deg * 1e7), round(height_m * 1e3), 0, 0, 0, 0, 0
    )
    told.hear_estimate(message, now_s())


def receiver(told: TimeAndPlace, latitude_deg: float, longitude_deg: float, height_m: float, *, fix: int = 3) -> None:
    place = round(latitude_deg * 1e7), round(longitude_deg * 1e7), round(height_m * 1e3)
    told.hear_receiver(mavlink.MAVLink_gps_raw_int_message(0, fix, *place, 0, 0, 0, 0, 9), now_s())


async def say_for(told: TimeAndPlace, seconds: int, *place: float) -> None:
    for _ in range(seconds):
        say(told, *place)
        await asyncio.sleep(1.0)


def at(told: TimeAndPlace) -> tuple[float, float, float] | None:
    place = told.position
    return None if place is None else (place.latitude_deg, place.longitude_deg, place.height_m)


@pytest.mark.parametrize(
    ("unix_us", "known"),
    [
        (0, False),
        (1_577_836_799_000_000, False),  # 2019-12-31
        (1_577_836_801_000_000, True),
        (4_102_444_799_000_000, True),  # 2099-12-31
        (4_102_444_801_000_000, False),
        (2**63, False),
        (2**64 - 1, False),
    ],
)
def test_a_date_is_one_of_this_century(unix_us: int, known: bool) -> None:
    async def story(told: TimeAndPlace) -> None:
        told.hear_time(mavlink.MAVLink_system_time_message(1_800_000_000_000_000, 0), now_s())
        told.hear_time(mavlink.MAVLink_system_time_message(unix_us, 0), now_s())
        assert told.unix_time_s == (pytest.approx(unix_us * 1e-6) if known else None)

    tell(story)


def test_a_first_place_is_believed_once_it_has_been_confirmed() -> None:
    async def story(told: TimeAndPlace) -> None:
        say(told, *EQUATOR)
        assert (told.position, told.doubt is None) == (None, False)
        await asyncio.sleep(10.0)
        assert (told.position, told.doubt) == (None, None)  # nobody says so any more
        await say_for(told, 4, *HOME)
        assert at(told) == pytest.approx(HOME)
        assert told.doubt is None

    tell(story)


def test_one_packet_never_gives_an_aircraft_without_position_a_place() -> None:
    async def story(told: TimeAndPlace) -> None:
        for k in range(60):
            say(told, 0.0, 0.0, 0.0)  # ArduPilot's way of knowing none
            if k % 7 == 0:
                say(told, *EQUATOR)
            await asyncio.sleep(1.0)
            assert told.position is None

    tell(story)


@pytest.mark.parametrize(
    ("claim", "words"),
    [
        (EQUATOR, "position jumped 5270 km"),
        ((HOME[0], -171.4544, HOME[2]), "position jumped 9474 km"),
        ((HOME[0], HOME[1], 1500.0), "height jumped 1012 m"),
        ((HOME[0], HOME[1], 20000.0), "position gone or impossible"),
        ((HOME[0], HOME[1], -600.0), "position gone or impossible"),
        ((91.0, HOME[1], HOME[2]), "position gone or impossible"),
        ((0.0, 0.0, 0.0), "position gone or impossible"),
    ],
)
def test_a_jump_is_not_believed_while_somebody_contradicts_it(claim: tuple[float, float, float], words: str) -> None:
    async def story(told: TimeAndPlace) -> None:
        await say_for(told, 4, *HOME)
        for _ in range(120):
            say(told, *claim)
            await asyncio.sleep(0.3)
            say(told, *HOME)
            assert at(told) == pytest.approx(HOME)
            assert told.doubt is not None
            assert told.doubt.startswith(words)
            assert "set vehicle.latitude_deg" in told.doubt
            await asyncio.sleep(0.7)
        await say_for(told, 6, *HOME)
        assert told.doubt is None

    tell(story)


def test_a_jump_that_stays_is_believed_after_half_a_minute() -> None:
    async def story(told: TimeAndPlace) -> None:
        await say_for(told, 4, *HOME)
        await say_for(told, 29, *EQUATOR)
        assert at(told) == pytest.approx(HOME)
        assert told.doubt is not None
        await say_for(told, 3, *EQUATOR)
        assert at(told) == pytest.approx(EQUATOR)
        assert told.doubt is None

    tell(story)


def test_what_gnss_wanders_is_followed_and_small_steps_lead_nowhere_while_still() -> None:
    async def story(told: TimeAndPlace) -> None:
        await say_for(told, 4, *HOME)
        await say_for(told, 1, HOME[0] + 0.002, HOME[1] - 0.002, HOME[2] + 120.0)
        assert told.doubt is None
        assert at(told) == pytest.approx((HOME[0] + 0.002, HOME[1] - 0.002, HOME[2] + 120.0))
        for k in range(40):  # 100 m higher each second
            await say_for(told, 1, HOME[0], HOME[1], HOME[2] + 100.0 * k)
        assert told.position is not None
        assert told.position.height_m <= HOME[2] + 300.0
        assert told.doubt is not None

    tell(story)


def test_who_is_carried_is_followed_wherever_it_goes() -> None:
    async def story(told: TimeAndPlace) -> None:
        await say_for(told, 4, *HOME)
        for k in range(1000):  # 200 km by car, up and over a pass
            here = (HOME[0] + 0.0018 * k, HOME[1], HOME[2] + 2.0 * min(k, 1000 - k))
            await say_for(told, 1, *here)
            assert told.doubt is None
            assert at(told) == pytest.approx(here)
        say(told, *EQUATOR)  # no car goes as far in a second
        assert told.doubt is not None

    tell(story, carried=True)


def test_a_restart_forgets_the_place_and_not_what_it_is_compared_with() -> None:
    async def story(told: TimeAndPlace) -> None:
        await say_for(told, 4, *HOME)
        told.restarted()
        assert (told.position, told.unix_time_s) == (None, None)
        await say_for(told, 4, *EQUATOR)
        assert told.position is None
        say(told, *HOME)
        assert at(told) == pytest.approx(HOME)

    tell(story)


def test_the_receiver_serves_until_there_is_an_estimate() -> None:
    async def story(told: TimeAndPlace) -> None:
        for _ in range(4):
            say(told, 0.0, 0.0, 0.0)
            receiver(told, *HOME)
            receiver(told, *EQUATOR, fix=2)
            await asyncio.sleep(1.0)
        assert at(told) == pytest.approx(HOME)
        assert told.doubt is None
        say(told, HOME[0] + 0.001, HOME[1], HOME[2])
        receiver(told, *EQUATOR)
        assert told.position is not None
        assert told.position.source == "autopilot GLOBAL_POSITION_INT"
        assert told.doubt is None

    tell(story)
