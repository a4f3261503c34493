"""Receivers of messages addressed to the companion (autopilots 5.4)."""

from __future__ import annotations

import asyncio

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.sitl.craft import Autopilot, Craft

ACK = mavlink.MAVLink_command_ack_message
COMMAND = mavlink.MAVLink_command_long_message
USER_1 = mavlink.MAV_CMD_USER_1


@pytest.mark.only("ardupilot")
def test_what_is_for_a_companion_not_yet_heard_ardupilot_carries_out_itself(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground = craft.ground
        await craft.reboot()  # routes last until then
        since_s = asyncio.get_running_loop().time()
        companion = (ground.vehicle, 191)
        # A command of its own it would obey; one of ours it does not know.
        assert await ground.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 148, target=companion) == 0
        assert await ground.command(USER_1, 1.0, target=companion) == mavlink.MAV_RESULT_UNSUPPORTED
        assert {ack.get_srcComponent() for ack in ground.all(ACK, since_s=since_s)} == {1}

    autopilot.run(main, 180.0)


def test_what_is_for_a_companion_that_was_heard_reaches_it_and_nobody_else_answers(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground, loop = craft.ground, asyncio.get_running_loop()
        companion = (ground.vehicle, 191)
        if craft.firmware == "px4" and not craft.real:
            await ground.put("MAV_1_FORWARD", 1)  # the real one's start script forwards between its links anyhow
            await craft.reboot()
        async with craft.companion() as station:
            await asyncio.sleep(2.5)
            since_s = loop.time()
            assert await ground.command(USER_1, 1.0, target=companion, wait_s=1.5) == -1
            got = [m for m in station.all(COMMAND, since_s=since_s) if m.command == USER_1]
            assert [m.get_srcSystem() for m in got] == [255]
            station.send(ACK(USER_1, mavlink.MAV_RESULT_IN_PROGRESS, 10, 0, 255, 190))
            await ground.wait_for(lambda: bool(ground.all(ACK, since_s=since_s)), 2.0, "the companion's answer")
            answer = ground.all(ACK, since_s=since_s)[-1]
            assert (answer.get_srcSystem(), answer.get_srcComponent(), answer.progress) == (*companion, 10)
            # Its heartbeat arrives too: that is how ground stations find it.
            beats = ground.all(mavlink.MAVLink_heartbeat_message, since_s=since_s - 2.0)
            assert companion in {(m.get_srcSystem(), m.get_srcComponent()) for m in beats}

    autopilot.run(main)


def test_an_arm_command_for_the_autopilot_is_not_shown_to_the_companion(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground, loop = craft.ground, asyncio.get_running_loop()
        async with craft.companion() as station:
            await asyncio.sleep(1.5)
            since_s = loop.time()
            await ground.arm(arm=False)
            await asyncio.sleep(0.5)
            seen = [m.command for m in station.all(COMMAND, since_s=since_s)]
        assert mavlink.MAV_CMD_COMPONENT_ARM_DISARM not in seen

    autopilot.run(main)


@pytest.mark.only("px4")
def test_px4_never_carries_out_what_is_for_another_component(autopilot: Autopilot) -> None:
    async def main(craft: Craft) -> None:
        ground = craft.ground
        since_s = asyncio.get_running_loop().time()
        target = (ground.vehicle, 77)
        assert await ground.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 148, target=target, wait_s=1.5) == -1
        assert not ground.all(mavlink.MAVLink_autopilot_version_message, since_s=since_s)

    autopilot.run(main)
