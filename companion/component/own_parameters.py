"""Our own parameters: a small server of the MAVLink parameter protocol.

All are REAL32, where the two encodings that autopilots use (the number itself, or its integer's bytes) are the same.
All names begin with CMP_: ArduPilot executes a PARAM_SET for component 191 itself when it cannot forward it, so that
a name of ours must never be one of an autopilot's.

Whoever sends PARAM_SET gets a PARAM_VALUE at once, with the old value where the new one is not allowed. Everything
else is answered from one pending set (each parameter at most once), at a pace that a slow telemetry link bears: a
flood of requests costs neither memory nor bandwidth, and still gets every parameter.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import re
from collections.abc import Callable

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.parameters.wire import float32
from companion.component.commands import Permission
from companion.component.statustext import Say, Severity, Weight
from companion.errors import CompanionError
from companion.links.mavlink.link import MavlinkLink

logger = logging.getLogger(__name__)

VALUES_PER_S = 40.0
_NAME = re.compile(r"CMP_[A-Z0-9_]{1,12}")
_REAL32 = mavlink.MAV_PARAM_TYPE_REAL32


@dataclasses.dataclass(slots=True, kw_only=True)
class _Parameter:
    name: str
    index: int
    value: float
    minimum: float
    maximum: float
    on_set: Callable[[float], None] | None
    read_only: bool

    def allows(self, value: float) -> bool:
        """Whether the value is a number within the limits (all are float32; NaN compares false)."""
        return self.minimum <= value <= self.maximum


class OwnParameters:
    """The parameters of component 191. Define all before the first `step`: their count never changes after that."""

    def __init__(
        self,
        link: MavlinkLink,
        say: Say = lambda severity, text, weight: None,
        wake: Callable[[], None] = lambda: None,
        permission: Permission | None = None,
    ) -> None:
        self._link, self._say, self._wake = link, say, wake
        self._permission = permission or Permission()
        self._all: list[_Parameter] = []
        self._by_name: dict[str, _Parameter] = {}
        self._pending: dict[int, None] = {}
        self._next_s = -math.inf
        self._fixed = False
        self._subscriptions = (
            link.subscribe(mavlink.MAVLink_param_request_list_message, self._on_request_list),
            link.subscribe(mavlink.MAVLink_param_request_read_message, self._on_request_read),
            link.subscribe(mavlink.MAVLink_param_set_message, self._on_set),
        )

    def define(
        self,
        name: str,
        value: float,
        minimum: float,
        maximum: float,
        on_set: Callable[[float], None] | None = None,
        *,
        read_only: bool = False,
    ) -> None:
        """Add a parameter.

        Args:
            name: CMP_ and at most 12 more of A-Z, 0-9 and _ (16 in all, the protocol's limit).
            value: its first value; like every value it is rounded to float32.
            minimum: least allowed value.
            maximum: greatest allowed value.
            on_set: called with a new value that a ground station sets, before it is stored; raises a CompanionError
                to refuse it.
            read_only: ground stations may not set it (results).

        Raises:
            ValueError: the name or the limits are not allowed, or the name is taken.
            RuntimeError: the component runs already.
        """
        if self._fixed:
            raise RuntimeError(f"{name}: parameters cannot be added once the component runs")
        if not _NAME.fullmatch(name) or name in self._by_name:
            raise ValueError(f"{name!r} is not a free name of the form CMP_..., at most 16 characters")
        parameter = _Parameter(
            name=name, index=len(self._all), value=float32(value), minimum=float32(minimum), maximum=float32(maximum),
            on_set=on_set, read_only=read_only,
        )  # fmt: skip
        if not (
            math.isfinite(parameter.minimum) and math.isfinite(parameter.maximum) and parameter.allows(parameter.value)
        ):
            raise ValueError(f"{name}: {value:g} is not within finite limits {minimum:g} .. {maximum:g}")
        self._all.append(parameter)
        self._by_name[name] = parameter

    def get(self, name: str) -> float:
        """The value in force; KeyError when there is no such parameter."""
        return self._by_name[name].value

    def set(self, name: str, value: float) -> None:
        """Change a value from inside and tell everyone, if it is another; `on_set` is not called.

        Raises:
            KeyError: there is no such parameter.
            ValueError: not a number, or out of the limits.
        """
        parameter = self._by_name[name]
        value = float32(value)
        if not parameter.allows(value):
            raise ValueError(f"{name}: {value:g} is not within {parameter.minimum:g} .. {parameter.maximum:g}")
        if value != parameter.value:
            parameter.value = value
            self._request(parameter)

    def change(self, name: str, value: float) -> None:
        """Change what a ground station may change, from inside: `on_set` is called, whatever the limits are.

        Raises:
            ValueError: it is beyond them; ground stations go on seeing the old value.
        """
        on_set = self._by_name[name].on_set
        if on_set is not None:
            on_set(value)
        self.set(name, value)

    def step(self, now_s: float) -> float:
        """Send the values that are due; return when the next one is (infinity: none waits)."""
        self._fixed = True
        if not self._pending or not self._link.connected:
            # Without a transport nobody is there who asked; what changed meanwhile is told once one is back.
            return math.inf
        if now_s >= self._next_s:
            index = next(iter(self._pending))
            if self._send(self._all[index]):
                del self._pending[index]
            self._next_s = now_s + 1.0 / VALUES_PER_S
        return self._next_s if self._pending else math.inf

    def close(self) -> None:
        """Answer nobody any more."""
        for unsubscribe in self._subscriptions:
            unsubscribe()

    def _request(self, parameter: _Parameter) -> None:
        self._pending.setdefault(parameter.index)
        self._wake()

    def _send(self, parameter: _Parameter) -> bool:
        return self._link.send(
            mavlink.MAVLink_param_value_message(
                parameter.name.encode("ascii"), parameter.value, _REAL32, len(self._all), parameter.index
            )
        )

    def _addressed(self, target_system: int, target_component: int) -> bool:
        return target_system in (0, self._link.system_id) and target_component in (0, self._link.component_id)

    def _on_request_list(self, message: mavlink.MAVLink_param_request_list_message, _t_s: float) -> None:
        if self._addressed(message.target_system, message.target_component):
            for parameter in self._all:
                self._request(parameter)

    def _on_request_read(self, message: mavlink.MAVLink_param_request_read_message, _t_s: float) -> None:
        if not self._addressed(message.target_system, message.target_component):
            return
        if message.param_index < 0:
            parameter = self._by_name.get(message.param_id)
        else:
            parameter = self._all[message.param_index] if message.param_index < len(self._all) else None
        if parameter is not None:
            self._request(parameter)
        elif message.target_component == self._link.component_id:
            self._send_unknown(message, message.param_id, message.param_index)

    def _on_set(self, message: mavlink.MAVLink_param_set_message, _t_s: float) -> None:
        if not self._addressed(message.target_system, message.target_component):
            return
        parameter = self._by_name.get(message.param_id)
        if parameter is None:
            # To component 0 the name may be any other component's.
            if message.target_component == self._link.component_id:
                self._send_unknown(message, message.param_id, -1)
            return
        sender = (message.get_srcSystem(), message.get_srcComponent())
        if sender == (self._link.system_id, self._link.component_id):
            return  # an echo, or somebody who pretends to be us
        refusal = self._permission.refuses(sender, f"setting {parameter.name}") or self._apply(parameter, message)
        if refusal:
            self._say(Severity.WARNING, f"{parameter.name} not set: {refusal}", Weight.REFUSAL)
        if self._send(parameter):
            self._pending.pop(parameter.index, None)
        else:
            self._request(parameter)

    def _apply(self, parameter: _Parameter, message: mavlink.MAVLink_param_set_message) -> str:
        """Take over the new value; returns why not, or nothing."""
        value = float32(message.param_value)
        if parameter.read_only:
            return "it is read only"
        if message.param_type != _REAL32:
            # The bytes could be a number or an integer's bits; which one depends on the sender's habits.
            return f"its type is REAL32 (9), not {message.param_type}"
        if not parameter.allows(value):
            return f"{value:g} is not in {parameter.minimum:g} .. {parameter.maximum:g}"
        if value == parameter.value:
            return ""
        if parameter.on_set is not None:
            try:
                parameter.on_set(value)
            except CompanionError as error:
                return str(error)
            except Exception:
                logger.exception("setting %s failed", parameter.name)
                return "an internal error, see the log"
        parameter.value = value
        return ""

    def _send_unknown(self, message: mavlink.MAVLink_message, name: str, index: int) -> None:
        self._link.send(
            mavlink.MAVLink_param_error_message(
                message.get_srcSystem(),
                message.get_srcComponent(),
                name.encode("ascii", "replace")[:16],
                index,
                mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST,
            )
        )
