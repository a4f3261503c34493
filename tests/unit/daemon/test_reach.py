"""Obstacles between ground stations and the companion."""

from __future__ import annotations

import asyncio
from types import SimpleNamespace
from typing import Any

import pytest

from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.daemon.core import RepeatedRead
from companion.daemon.devices.subsystem import Reach
from companion.errors import AutopilotError
from companion.links.mavlink.link import MavlinkLink
from companion.links.system.events import Listeners
from tests.support.scripted_autopilot import ScriptedAutopilot, flying_on
from tests.support.scripted_px4 import ScriptedPx4
from tests.support.virtual_time import run_virtual


def words_of(autopilot: ScriptedAutopilot) -> tuple[bool, str]:
    async def main() -> tuple[bool, str]:
        link = MavlinkLink()
        vehicle = Vehicle(link)
        parameters = ParameterClient(link, vehicle)
        reach = Reach(link, vehicle, parameters, "serial:/dev/serial0:921600")
        async with flying_on(link, autopilot):
            running = asyncio.create_task(reach.reading.run())
            await asyncio.sleep(8.0)
            found = reach.text()
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
        vehicle.close()
        return found

    return run_virtual(main())


@pytest.mark.parametrize(
    ("links", "good", "words"),
    [
        ({0: (101, 1), 1: (102, 0), 2: (0, 0)}, False, "does not forward to or from MAV_1:"),
        ({0: (101, 1), 1: (102, 0), 2: (103, 0)}, False, "does not forward to or from MAV_1, MAV_2:"),
        ({0: (101, 1), 1: (102, 1), 2: (0, 0)}, True, "forwards between all its links"),
    ],
)
def test_px4_links_that_do_not_forward_are_named_with_the_fix(
    links: dict[int, tuple[int, int]], good: bool, words: str
) -> None:
    px4 = ScriptedPx4()
    for n, (config, forward) in links.items():
        px4.parameters |= {f"MAV_{n}_CONFIG": config, f"MAV_{n}_FORWARD": forward}
    found = words_of(px4)
    assert found[0] == good
    assert words in found[1]
    assert good or "set MAV_1_FORWARD=1 and reboot" in found[1]


def test_an_autopilot_that_never_answers_does_not_hear_us() -> None:
    autopilot = ScriptedAutopilot()

    def deaf(_message: Any) -> bool:
        return False

    autopilot.on_message = deaf
    good, words = words_of(autopilot)
    assert not good
    assert "sends but does not answer: check the wire to its RX" in words


def test_ardupilot_needs_nothing_but_our_heartbeat() -> None:
    good, words = words_of(ScriptedAutopilot(parameters={"INS_GYR_CAL": 0.0}))
    assert good
    assert "no ground station found" in words
    assert "set not to forward" in words


async def test_it_reads_after_each_start_on_request_and_again_after_a_failure() -> None:
    loop, reads, fails = asyncio.get_running_loop(), list[float](), [False]
    vehicle: Any = SimpleNamespace(found=asyncio.Event(), on_event=Listeners())

    async def read() -> None:
        reads.append(round(loop.time(), 3))
        if fails[0]:
            raise AutopilotError("no answer")

    reading = RepeatedRead(vehicle, read, 3.0)
    running = asyncio.create_task(reading.run())
    await asyncio.sleep(10.0)
    assert reads == []  # nobody is there to be asked
    began_s = loop.time()
    vehicle.found.set()
    await asyncio.sleep(1.0)
    fails[0] = True
    vehicle.on_event.tell("rebooted")
    await asyncio.sleep(7.0)
    fails[0] = False
    await asyncio.sleep(10.0)
    for _ in range(3):  # a change that anybody may announce is read at once, and then every half second
        reading.again(0.5)
        await asyncio.sleep(0.1)
    await asyncio.sleep(5.0)
    running.cancel()
    assert [round(each - began_s, 1) for each in reads] == [0.0, 1.0, 4.0, 7.0, 10.0, 18.0, 18.5]
