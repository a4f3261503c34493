"""A request from the ground against the real component, over radios that lose packets."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import cast

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.ground.exchange import Answer, Exchange
from companion.ground.heard import Ack
from companion.ground.link import GroundLink
from tests.support.component import (
    ACCEPTED,
    CALIBRATE,
    FAILED,
    UNDO,
    Bench,
    bench,
)
from tests.support.ground_wire import COMPANION, StationOnTheWire, is_final
from tests.support.virtual_time import run_virtual


def exchange(
    station: StationOnTheWire,
    command: int = CALIBRATE,
    *parameters: float,
    on_progress: Callable[[int, float], None] = lambda percent, silent_s: None,
) -> Exchange:
    # As much of a GroundLink as an exchange uses.
    link = cast("GroundLink", station)
    return Exchange(
        link,
        COMPANION,
        command,
        *parameters,
        busy=lambda since_s: station.heard.busy(1, since_s),
        on_progress=on_progress,
    )


def test_progress_is_shown_and_the_end_is_the_companions() -> None:
    async def main() -> None:
        station = StationOnTheWire()
        async with bench(ground=station) as b:
            shown: list[int] = []
            one = exchange(station, CALIBRATE, 1.0, on_progress=lambda percent, silent_s: shown.append(percent))
            asking = asyncio.create_task(one.run())
            for percent in (10, 40, 95):
                await asyncio.sleep(1.0)
                b.service.jobs[0].progress_percent = percent
            await asyncio.sleep(1.0)
            b.service.jobs[0].finish("failed", "no")
            assert await asking == Answer(FAILED, begun=True)
            assert [percent for percent in (10, 40, 95) if percent in shown] == [10, 40, 95]
            assert shown == sorted(shown)
            assert station.confirmations == [0], "nothing was lost: nothing is to be repeated"
            assert not station.on_ack
            assert b.service.started[0].what.name == "GYROS"  # type: ignore[union-attr]

    run_virtual(main())


@pytest.mark.parametrize("block", range(4))
def test_on_a_lossy_radio_one_press_is_one_calibration_and_its_end_is_heard(block: int) -> None:
    """Three of ten packets lost, each way. Where an answer and all repeats are lost, no end is claimed."""

    async def main(seed: int) -> str:
        station = StationOnTheWire()
        async with bench(ground=station, seed=seed, loss=0.3) as b:
            b.service.takes_s = (0.0, 0.3, 2.0, 8.0)[seed % 4]
            answer = await exchange(station, UNDO if seed % 5 == 0 else CALIBRATE).run()
            assert len(b.service.started) <= 1, f"seed {seed}"
            assert b.service.started or not answer.begun, f"seed {seed}"
            assert answer.result in (ACCEPTED, None), f"seed {seed}"
            return "heard" if answer.result == ACCEPTED else "said that it is not known"

    ends = [run_virtual(main(seed)) for seed in range(block * 50, block * 50 + 50)]
    assert ends.count("heard") >= 47


def test_the_final_ack_is_asked_for_again_when_it_got_lost() -> None:
    async def main() -> None:
        station = StationOnTheWire()
        lost = 0

        def first_two_finals(message: mavlink.MAVLink_message) -> bool:
            nonlocal lost
            lost += is_final(message)
            return is_final(message) and lost <= 2

        station.deaf_to = first_two_finals
        async with bench(ground=station) as b:
            b.service.takes_s = 3.0
            assert await exchange(station).run() == Answer(ACCEPTED, begun=True)
            assert len(b.service.started) == 1
            assert station.confirmations == [0, 1, 2]

    run_virtual(main())


def test_nobody_answers() -> None:
    async def main() -> None:
        station = StationOnTheWire()
        async with bench(ground=station) as b:
            b.wire.cut = True
            begun_s = asyncio.get_running_loop().time()
            assert await exchange(station).run() == Answer(None, begun=False)
            assert asyncio.get_running_loop().time() - begun_s <= 6.0
            assert station.confirmations == [0, 1, 2, 3, 4]

    run_virtual(main())


def test_an_end_that_nobody_heard_is_noticed_by_the_heartbeat() -> None:
    async def main() -> None:
        station = StationOnTheWire()
        station.deaf_to = is_final
        async with bench(ground=station) as b:
            b.service.takes_s = 3.0
            b.service.mav_state = mavlink.MAV_STATE_STANDBY
            begun_s = asyncio.get_running_loop().time()
            assert await exchange(station).run() == Answer(None, begun=True)
            assert asyncio.get_running_loop().time() - begun_s <= 3.0 + 8.0
            assert len(b.service.started) == 1

    run_virtual(main())


async def _cut_for(b: Bench, seconds: float) -> None:
    b.wire.cut = True
    await asyncio.sleep(seconds)
    b.wire.cut = False


def test_a_link_that_stays_away_is_given_up() -> None:
    async def main() -> None:
        station = StationOnTheWire()
        async with bench(ground=station) as b:
            b.service.mav_state = mavlink.MAV_STATE_CALIBRATING
            silence: list[float] = []
            one = exchange(station, on_progress=lambda percent, silent_s: silence.append(silent_s))
            asking = asyncio.create_task(one.run())
            await asyncio.sleep(2.0)
            b.wire.cut = True
            assert await asking == Answer(None, begun=True)
            assert 19.0 <= max(silence) <= 21.0, "and until then it is said for how long nothing has come"

    run_virtual(main())


def test_answers_to_others_and_of_others_are_not_ours() -> None:
    async def main() -> None:
        station = StationOnTheWire()
        async with bench(ground=station) as b:
            asking = asyncio.create_task(exchange(station).run())
            await asyncio.sleep(0.5)
            for source, command in (
                (COMPANION._replace(component_id=1), CALIBRATE),
                (COMPANION._replace(system_id=2), CALIBRATE),
                (COMPANION, UNDO),
            ):
                station.on_ack.tell(Ack(source, command, mavlink.MAV_RESULT_DENIED, 0, 0))
            await asyncio.sleep(0.5)
            assert not asking.done()
            b.service.jobs[0].finish("done")
            assert await asking == Answer(ACCEPTED, begun=True)

    run_virtual(main())
