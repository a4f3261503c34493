"""Requests in COMMAND_LONG and COMMAND_INT: parse and check them before anything is done."""

from __future__ import annotations

import math
from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.commands import Calibrate, Cancel, Undo
from companion.estimation.request import What

CommandMessage = mavlink.MAVLink_command_long_message | mavlink.MAVLink_command_int_message


class Key(NamedTuple):
    """Identity of a request: a COMMAND_ACK names its requester and the command, nothing else."""

    system_id: int
    component_id: int
    command: int


class ReceivedCommand(NamedTuple):
    """A command, from either message."""

    key: Key
    parameters: tuple[float, float, float, float, float, float, float]
    confirmation: int
    """Number of earlier transmissions; COMMAND_INT has no such field and always counts as new."""
    packet: bytes
    """The packet with its sequence number: only a copy made by the network is equal."""


class SendVersion(NamedTuple):
    """A request for AUTOPILOT_VERSION."""


class Refused(NamedTuple):
    """A refusal: the MAV_RESULT and the reason."""

    result: int
    reason: str


Request = Calibrate | Undo | Cancel | SendVersion


def from_message(message: CommandMessage) -> ReceivedCommand:
    """Parse a COMMAND_LONG or COMMAND_INT; x, y and z of the latter are parameters 5, 6 and 7."""
    key = Key(message.get_srcSystem(), message.get_srcComponent(), message.command)
    if isinstance(message, mavlink.MAVLink_command_int_message):
        last, confirmation = (float(message.x), float(message.y), message.z), 0
    else:
        last, confirmation = (message.param5, message.param6, message.param7), message.confirmation
    first = (message.param1, message.param2, message.param3, message.param4)
    return ReceivedCommand(key, (*first, *last), confirmation, bytes(message.get_msgbuf()))


def judge(command: ReceivedCommand) -> Request | Refused:
    """Return the request of a command. NaN, 0.5 and 3 are refused where 0, 1 and 2 are allowed."""
    match command.key.command:
        case mavlink.MAV_CMD_USER_1:
            return _calibrate(command.parameters[0], command.parameters[1])
        case mavlink.MAV_CMD_USER_2:
            return Cancel()
        case mavlink.MAV_CMD_USER_3:
            return Undo()
        case mavlink.MAV_CMD_PREFLIGHT_CALIBRATION:
            return _preflight_calibration(command.parameters)
        case mavlink.MAV_CMD_REQUEST_MESSAGE:
            return _request_message(command.parameters[0])
        case mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES if command.parameters[0] == 1:
            return SendVersion()
        case other:
            return Refused(mavlink.MAV_RESULT_UNSUPPORTED, f"Command {other} is not supported by the companion")


def _calibrate(which: float, reboot: float) -> Calibrate | Refused:
    # NaN stands for "not given" with some ground stations.
    if reboot not in (0.0, 1.0) and not math.isnan(reboot):
        return _denied(f"Calibration refused: param2 {reboot:g}, allowed 0, 1")
    for what in What:
        if which == what.value:
            return Calibrate.of(what, reboot=reboot == 1.0)
    return _denied(f"Calibration refused: param1 {which:g}, allowed 0, 1, 2")


def _preflight_calibration(parameters: tuple[float, ...]) -> Calibrate | Refused:
    """Parse MAV_CMD_PREFLIGHT_CALIBRATION: param1 gyros, param5 accelerometers.

    Mission Planner's button always sets param3, ground pressure, too: it is ignored beside gyros or accelerometers.
    """
    for number, value in enumerate(parameters, start=1):
        if value != 0 and not (number in (1, 3, 5) and value == 1):
            allowed = "0 or 1" if number in (1, 3, 5) else "0"
            return _denied(f"Calibration refused: param{number} {value:g}, allowed {allowed}")
    chosen = {(1, 1): What.BOTH, (1, 0): What.GYROS, (0, 1): What.ACCELEROMETERS}
    what = chosen.get((int(parameters[0]), int(parameters[4])))
    return _denied("Calibration refused: set param1 or param5 to 1") if what is None else Calibrate.of(what)


def _request_message(message_id: float) -> SendVersion | Refused:
    if message_id == mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
        return SendVersion()
    if 0 <= message_id < 1 << 24 and message_id.is_integer():
        return Refused(mavlink.MAV_RESULT_UNSUPPORTED, f"Message {message_id:.0f} cannot be requested here")
    return _denied(f"Message request refused: param1 {message_id:g}")


def _denied(reason: str) -> Refused:
    return Refused(mavlink.MAV_RESULT_DENIED, reason)
