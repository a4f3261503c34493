"""Commands to the PX4 double, its own calibrations, its texts and its routing (autopilots 4.6, 5.4, 9.2, 9.3.2)."""

from __future__ import annotations

import asyncio

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.support.px4_stage import PX4Stage


@pytest.mark.parametrize(("forward_1", "forward_0", "passes"), [(0, 1, False), (1, 0, False), (1, 1, True)])
async def test_messages_pass_only_between_ports_that_both_forward(forward_1: int, forward_0: int, passes: bool) -> None:
    parameters = {"MAV_1_FORWARD": forward_1, "MAV_0_FORWARD": forward_0}
    async with PX4Stage(parameters=parameters) as stage:
        await asyncio.sleep(2.0)
        stage.ground.send(mavlink.MAVLink_command_long_message(1, 191, 31010, 0, 0, 0, 0, 0, 0, 0, 0))
        stage.ground.send(mavlink.MAVLink_command_long_message(1, 77, 31010, 0, 0, 0, 0, 0, 0, 0, 0))
        await asyncio.sleep(0.1)
        commands = stage.companion.all(mavlink.MAVLink_command_long_message)
        assert [command.target_component for command in commands] == ([191] if passes else [])
        heard = [m for _, m in stage.ground.heard if m.get_srcComponent() == 191]
        assert bool(heard) is passes
