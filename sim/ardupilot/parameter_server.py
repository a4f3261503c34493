"""ArduPilot's parameter protocol over one or more ports (autopilots 1.3, 7.5 and 9.1)."""

from __future__ import annotations

import math

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.ardupilot.board import ArduPilotBoard
from sim.ardupilot.parameters import since
from sim.firmware.channel import Channel, Write
from sim.firmware.faults import names_match

NO_INDEX = 65535
LIST_PERIOD_S = 0.00176
"""Time per parameter of a list: the real firmware sent 1362 parameters in 2.4 s."""
_CHUNK = 5
DOES_NOT_EXIST, OUT_OF_RANGE, PERMISSION_DENIED = 1, 2, 3


class ArduPilotParameterServer:
    """Answers PARAM_SET, PARAM_REQUEST_READ and PARAM_REQUEST_LIST for the double."""

    def __init__(self, double: ArduPilotBoard) -> None:
        self._double = double

    def set(self, channel: Channel, message: mavlink.MAVLink_param_set_message, loop_s: float) -> None:
        """Handle PARAM_SET: store at once, armed or not; the answer goes to every port some milliseconds later."""
        double, faults = self._double, self._double.faults
        name, value = message.param_id, message.param_value
        source = (message.get_srcSystem(), message.get_srcComponent())
        double.writes.append(Write(loop_s, name, value, double.armed, *source))
        if names_match(faults.ignore, name):
            return
        if name not in double.parameters:
            self._error(channel, message, name, -1, DOES_NOT_EXIST)
            return
        if not math.isfinite(value):
            self._error(channel, message, name, -1, OUT_OF_RANGE)
            return
        if names_match(faults.refuse, name):
            double.say(mavlink.MAV_SEVERITY_WARNING, f"Param write denied ({name})")
            self._error(channel, message, name, -1, PERMISSION_DENIED)
            self.announce(name)
            return
        double.update_estimator(loop_s)
        double.parameters.set(name, value, takes_effect=not faults.echo_without_effect)
        if not double.after_write():
            wrong = names_match(faults.wrong_echo, name)
            for member in double.parameters.family(name):
                self.announce(member, wrong=wrong and member == name)

    def read(self, channel: Channel, message: mavlink.MAVLink_param_request_read_message) -> None:
        """Handle PARAM_REQUEST_READ by name (index -1) or index; an unknown one is an error, silence before 4.7."""
        double = self._double
        if message.param_index >= 0:
            names = double.parameters.names
            if message.param_index >= len(names):
                self._error(channel, message, "", message.param_index, DOES_NOT_EXIST)
                return
            name, index = names[message.param_index], message.param_index
        else:
            name, index = message.param_id, NO_INDEX
            if name not in double.parameters:
                if not names_match(double.faults.ignore, name):
                    self._error(self._whose_turn(channel), message, name, -1, DOES_NOT_EXIST)
                return
        if not names_match(double.faults.ignore, name):
            double.soon(double.read_delay_s(), lambda: self._send(channel, name, index))

    def list_all(self, channel: Channel) -> None:
        """Handle PARAM_REQUEST_LIST: send a paced list with true indices, while the other streams slow down."""
        if channel.listing:
            return
        channel.listing = True
        self._list_from(channel, 0)

    def _list_from(self, channel: Channel, start: int) -> None:
        names = self._double.parameters.names
        for index in range(start, min(start + _CHUNK, len(names))):
            self._send(channel, names[index], index)
        if start + _CHUNK < len(names):
            self._double.soon(LIST_PERIOD_S * _CHUNK, lambda: self._list_from(channel, start + _CHUNK))
        else:
            channel.listing = False

    def _whose_turn(self, asker: Channel) -> Channel:
        """Return the port that receives the error to a read: at random the requester's or another one."""
        others = [channel for channel in self._double.channels if channel is not asker]
        return others[0] if others and self._double.random.integers(2) else asker

    def announce(self, name: str, *, wrong: bool = False) -> None:
        """Send PARAM_VALUE with index 65535 on every port, as after a write."""
        self._double.soon(self._double.answer_delay_s(), lambda: self._send_everywhere(name, wrong=wrong))

    def _send_everywhere(self, name: str, *, wrong: bool) -> None:
        for channel in self._double.channels:
            self._send(channel, name, NO_INDEX, wrong=wrong)

    def _send(self, channel: Channel, name: str, index: int, *, wrong: bool = False) -> None:
        if self._double.faults.silent:
            return
        store = self._double.parameters
        value = store.values[name]
        if wrong:
            value = value + max(abs(value), 1.0) * 0.125
        channel.send(
            mavlink.MAVLink_param_value_message(
                name.encode(), value, store.type_of(name), len(store.names), index
            )
        )  # fmt: skip

    def _error(
        self,
        channel: Channel,
        message: mavlink.MAVLink_param_set_message | mavlink.MAVLink_param_request_read_message,
        name: str,
        index: int,
        error: int,
    ) -> None:
        if not since(self._double.version, "4.7"):
            return
        answer = mavlink.MAVLink_param_error_message(
            message.get_srcSystem(), message.get_srcComponent(), name.encode(), index, error
        )
        self._double.soon(self._double.answer_delay_s(), lambda: self._double.answer(channel, answer))
