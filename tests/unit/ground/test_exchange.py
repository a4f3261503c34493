"""A request from the ground against the real component, over radios that lose packets."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import cast

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.ground.link import Exchange, GroundLink
from tests.support.component import (
    ACCEPTED,
    CALIBRATE,
    UNDO,
    bench,
)
from tests.support.ground_wire import COMPANION, StationOnTheWire
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
        on_progress=on_progress,
    )


@pytest.mark.parametrize("block", range(4))
def test_on_a_lossy_radio_one_press_is_one_calibration_and_its_end_is_heard(block: int) -> None:
    """Three of ten packets lost, each way. Where an answer and all repeats are lost, no end is claimed."""

    async def main(seed: int) -> str:
        station = StationOnTheWire()
        async with bench(ground=station, seed=seed, loss=0.3) as b:
            b.service.takes_s = (0.0, 0.3, 2.0, 8.0)[seed % 4]
            asked = exchange(station, UNDO if seed % 5 == 0 else CALIBRATE)
            await asked.run()
            assert len(b.service.started) <= 1, f"seed {seed}"
            assert b.service.started or asked.unanswered, f"seed {seed}"
            assert asked.result in (ACCEPTED, None), f"seed {seed}"
            return "heard" if asked.result == ACCEPTED else "said that it is not known"

    ends = [run_virtual(main(seed)) for seed in range(block * 50, block * 50 + 50)]
    assert ends.count("heard") >= 47


async def test_answers_to_others_and_of_others_are_not_ours() -> None:
    station = StationOnTheWire()
    async with bench(ground=station) as b:
        asked = exchange(station)
        asking = asyncio.create_task(asked.run())
        await asyncio.sleep(0.5)
        for source, command in (
            (COMPANION._replace(component_id=1), CALIBRATE),
            (COMPANION._replace(system_id=2), CALIBRATE),
            (COMPANION, UNDO),
        ):
            station.on_ack.tell(source, {"command": command, "result": mavlink.MAV_RESULT_DENIED})
        await asyncio.sleep(0.5)
        assert not asking.done()
        b.service.jobs[0].finish("done")
        await asking
        assert (asked.result, asked.unanswered) == (ACCEPTED, False)
