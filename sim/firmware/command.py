"""COMMAND_LONG and COMMAND_INT, taken alike."""

from __future__ import annotations

from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.firmware.channel import Channel


class Command(NamedTuple):
    """COMMAND_LONG or COMMAND_INT, and where to answer."""

    channel: Channel
    number: int
    params: tuple[float, ...]
    system_id: int
    component_id: int
    loop_s: float


def command_of(
    channel: Channel, message: mavlink.MAVLink_command_long_message | mavlink.MAVLink_command_int_message, loop_s: float
) -> Command:
    """The common content of the two kinds; in COMMAND_INT x, y, z are params 5 to 7."""
    first = (message.param1, message.param2, message.param3, message.param4)
    if isinstance(message, mavlink.MAVLink_command_int_message):
        params = (*first, float(message.x), float(message.y), message.z)
    else:
        params = (*first, message.param5, message.param6, message.param7)
    return Command(channel, message.command, params, message.get_srcSystem(), message.get_srcComponent(), loop_s)
