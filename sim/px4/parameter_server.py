"""PX4's parameter protocol over its ports (autopilots 4.4, 7.5, 9.2; PX4 `mavlink_parameters.cpp`, 2026-08)."""

from __future__ import annotations

import functools

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.firmware.channel import Write
from sim.firmware.faults import names_match
from sim.px4.board import PX4Board
from sim.px4.parameters import INT32, REAL32, bytes_as_float, float_as_int
from sim.px4.port import PX4Port

DOES_NOT_EXIST, READ_ONLY, TYPE_UNSUPPORTED, TYPE_MISMATCH = 1, 5, 6, 7
ECHO_S = (0.0002, 0.001)
TELL_AFTER_S = (0.005, 0.015)
"""Delay, from and to, after which every port announces a change."""
HASH_NAME = "_HASH_CHECK"
NO_INDEX = 65535
LIST_PERIOD_S, LIST_CHUNK = 0.020, 20
"""Period and number of parameters per burst of a list: 929 parameters took 0.92 s on the real firmware."""
MEANINGLESS_INDEX = 14736
"""Index in a PARAM_ERROR that names a parameter: the real firmware leaves this field unset."""


class PX4ParameterServer:
    """Answers PARAM_SET, PARAM_REQUEST_READ and PARAM_REQUEST_LIST for the double."""

    def __init__(self, double: PX4Board) -> None:
        self._double = double
        self._telling: set[int] = set()

    def restart(self) -> None:
        self._telling.clear()

    def set(self, port: PX4Port, message: mavlink.MAVLink_param_set_message, loop_s: float) -> None:
        """Handle PARAM_SET: the name must exist and the type must be right; store and echo here at once."""
        double, store = self._double, self._double.parameters
        name, kind = message.param_id, message.param_type
        value = float(float_as_int(message.param_value)) if kind == INT32 else message.param_value
        source = (message.get_srcSystem(), message.get_srcComponent())
        double.writes.append(Write(loop_s, name, value, double.armed, *source))
        if names_match(double.faults.ignore, name):
            return
        if name == HASH_NAME:
            port.listing = False
            self._error(port, message, name, READ_ONLY)
        elif name not in store:
            self._error(port, message, name, DOES_NOT_EXIST)
        elif kind not in (INT32, REAL32):
            self._error(port, message, name, TYPE_UNSUPPORTED)
        elif kind != store.type_of(name):
            self._error(port, message, name, TYPE_MISMATCH)
        elif names_match(double.faults.refuse, name):
            self._error(port, message, name, READ_ONLY)
        else:
            if store.set(name, value):
                double.parameters_changed(consumers=not double.faults.echo_without_effect)
            if not double.after_write():
                self._send_soon(port, name, wrong=names_match(double.faults.wrong_echo, name))

    def read(self, port: PX4Port, message: mavlink.MAVLink_param_request_read_message) -> None:
        """Handle PARAM_REQUEST_READ by name (index -1) or index; an unknown one gets an error; before 1.17, silence."""
        store = self._double.parameters
        index, name = message.param_index, message.param_id
        if index >= 0:
            name = store.names[index] if index < len(store.names) else ""
        if names_match(self._double.faults.ignore, name):
            return
        if name == HASH_NAME:
            self._send_hash(port)
        elif name in store:
            self._send_soon(port, name)
        else:
            self._error(port, message, name, DOES_NOT_EXIST, index=index if index >= 0 else MEANINGLESS_INDEX)

    def list_all(self, port: PX4Port) -> None:
        """Handle PARAM_REQUEST_LIST: send a hash first, then all; a repeated request starts again, without the hash."""
        if not port.listing:
            port.listing = True
            if self._double.parameters["MAV_HASH_CHK_EN"]:
                self._send_hash(port)
            self._list_from(port, 0)

    def tell_changes(self) -> None:
        """Announce all unsaved values on every port, including the writer's own port."""
        low, high = TELL_AFTER_S
        for number in range(len(self._double.ports)):
            if number not in self._telling:
                self._telling.add(number)
                delay_s = float(self._double.random.uniform(low, high))
                self._double.later(delay_s, functools.partial(self._tell, number))

    def _tell(self, number: int) -> None:
        port = self._double.ports[number]
        if port.listing:
            self._double.later(LIST_PERIOD_S, lambda: self._tell(number))
            return
        self._telling.discard(number)
        for name in sorted(self._double.parameters.unsaved):
            if not names_match(self._double.faults.ignore, name):
                wrong = names_match(self._double.faults.wrong_echo, name)
                self._send(port, name, wrong=wrong)

    def _list_from(self, port: PX4Port, start: int) -> None:
        names = self._double.parameters.names
        if not port.listing:
            return
        for name in names[start : start + LIST_CHUNK]:
            if not names_match(self._double.faults.ignore, name):
                self._send(port, name)
        if start + LIST_CHUNK < len(names):
            self._double.later(LIST_PERIOD_S, lambda: self._list_from(port, start + LIST_CHUNK))
        else:
            port.listing = False

    def _send_soon(self, port: PX4Port, name: str, *, wrong: bool = False) -> None:
        delay_s = float(self._double.random.uniform(*ECHO_S))
        self._double.soon(delay_s, lambda: self._send(port, name, wrong=wrong))

    def _send(self, port: PX4Port, name: str, *, wrong: bool = False) -> None:
        store = self._double.parameters
        value = store.on_the_wire(name)
        if wrong:
            old = store[name]
            value = bytes_as_float(int(old) + 1) if store.is_int(name) else old + max(abs(old), 1.0) * 0.125
        self._double.answer(
            port,
            mavlink.MAVLink_param_value_message(
                name.encode(), value, store.type_of(name), len(store.names), store.index[name]
            ),
        )

    def _send_hash(self, port: PX4Port) -> None:
        store = self._double.parameters
        number = hash(tuple(store.values.values())) & 0x3FFFFFFF
        self._double.answer(
            port,
            mavlink.MAVLink_param_value_message(
                HASH_NAME.encode(),
                bytes_as_float(number),
                mavlink.MAV_PARAM_TYPE_UINT32,
                len(store.names),
                NO_INDEX,
            ),
        )

    def _error(
        self,
        port: PX4Port,
        message: mavlink.MAVLink_param_set_message | mavlink.MAVLink_param_request_read_message,
        name: str,
        error: int,
        *,
        index: int = MEANINGLESS_INDEX,
    ) -> None:
        if self._double.version == "1.16":
            return
        answer = mavlink.MAVLink_param_error_message(
            message.get_srcSystem(), message.get_srcComponent(), name.encode(), index, error
        )
        delay_s = float(self._double.random.uniform(*ECHO_S))
        self._double.soon(delay_s, lambda: self._double.answer(port, answer))
