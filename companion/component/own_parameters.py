"""Parameters of component 191: a small server of the MAVLink parameter protocol.

All parameters have the type REAL32, which both encodings (C cast, bytewise) send alike. All names begin with
CMP_, unlike any autopilot's: ArduPilot obeys a PARAM_SET for component 191 itself if it cannot forward the message.

A PARAM_SET is answered at once, with the old value if the new one is not allowed. Reads wait in a set of names and are
answered at a pace that a slow telemetry link can carry, so a flood of requests costs neither memory nor bandwidth.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Callable, Sequence
from typing import Any, Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.parameters.change import float32
from companion.component.commands import Permission
from companion.component.statustext import Severity, StatusText, Weight
from companion.config.sections import AtArm
from companion.errors import CompanionError
from companion.links.mavlink.link import MavlinkLink

logger = logging.getLogger(__name__)

VALUES_PER_S = 40.0
AT_ARM: Final[tuple[AtArm, ...]] = ("off", "warn", "gate")  # Meanings of CMP_AT_ARM 0, 1, 2
RESULTS: Final = ("none", "done", "failed", "cancelled")  # Meanings of CMP_STATE 0 to 3: last outcome since start
_REAL32 = mavlink.MAV_PARAM_TYPE_REAL32


@dataclasses.dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter of this component; values and limits are rounded to float32, as MAVLink sends them."""

    name: str
    """Name: CMP_ and at most 12 more characters from A-Z, 0-9 and _ (MAVLink allows 16 in all)."""
    value: float
    minimum: float
    maximum: float
    on_set: Callable[[float], None] | None = None
    """Callback for a value that a client sets; it raises a CompanionError to refuse the value. None: read only."""

    def allows(self, value: float) -> bool:
        return float32(self.minimum) <= value <= float32(self.maximum)


class OwnParameters:
    """Server of component 191's parameters: answers reads and writes, and sends changed values."""

    def __init__(
        self, link: MavlinkLink, parameters: Sequence[Parameter], texts: StatusText, permission: Permission
    ) -> None:
        self._link, self._texts, self._permission = link, texts, permission
        self._by_name = {parameter.name: parameter for parameter in parameters}
        self._values = {parameter.name: float32(parameter.value) for parameter in parameters}
        self._names = list(self._by_name)
        self._pending: dict[str, None] = {}
        self._next_s = -math.inf
        link.subscribe(mavlink.MAVLink_param_request_list_message, self._on_request_list)
        link.subscribe(mavlink.MAVLink_param_request_read_message, self._on_request_read)
        link.subscribe(mavlink.MAVLink_param_set_message, self._on_set)

    def get(self, name: str) -> float:
        return self._values[name]

    def set(self, name: str, value: float) -> None:
        """Set a parameter for the daemon, and broadcast a changed value; raise ValueError for a value beyond limits."""
        parameter = self._by_name[name]
        value = float32(value)
        if not parameter.allows(value):
            raise ValueError(f"{name}: {value:g} is not within {parameter.minimum:g} .. {parameter.maximum:g}")
        if value != self._values[name]:
            self._values[name] = value
            self._request(name)

    def step(self, now_s: float) -> float:
        if not self._pending or not self._link.connected:
            # Changes stay pending until the link has a transport again.
            return math.inf
        if now_s >= self._next_s:
            name = next(iter(self._pending))
            if self._send(name):
                del self._pending[name]
            self._next_s = now_s + 1.0 / VALUES_PER_S
        return self._next_s if self._pending else math.inf

    def _request(self, name: str) -> None:
        self._pending.setdefault(name)
        self._texts.woken.set()

    def _send(self, name: str) -> bool:
        count, index = len(self._names), self._names.index(name)
        return self._link.send(
            mavlink.MAVLink_param_value_message(name.encode("ascii"), self._values[name], _REAL32, count, index)
        )

    def _on_request_list(self, message: mavlink.MAVLink_param_request_list_message, _t_s: float) -> None:
        if self._link.is_for_us(message):
            for name in self._names:
                self._request(name)

    def _on_request_read(self, message: mavlink.MAVLink_param_request_read_message, _t_s: float) -> None:
        if not self._link.is_for_us(message):
            return
        index = message.param_index
        name = message.param_id if index < 0 else next(iter(self._names[index : index + 1]), "")
        if name in self._by_name:
            self._request(name)
        elif message.target_component == self._link.component_id:
            self._send_unknown(message, message.param_index)

    def _on_set(self, message: mavlink.MAVLink_param_set_message, _t_s: float) -> None:
        if not self._link.is_for_us(message):
            return
        parameter = self._by_name.get(message.param_id)
        if parameter is None:
            # A request to component 0 (everyone) may name another component's parameter: stay silent.
            if message.target_component == self._link.component_id:
                self._send_unknown(message, -1)
            return
        sender = (message.get_srcSystem(), message.get_srcComponent())
        if sender == (self._link.system_id, self._link.component_id):
            return  # an echo of our own message, or a sender that uses our ids
        refusal = self._permission.refuses(sender, f"setting {parameter.name}") or self._apply(parameter, message)
        if refusal:
            self._texts.say(Severity.WARNING, f"{parameter.name} not set: {refusal}", Weight.REFUSAL)
        if self._send(parameter.name):
            self._pending.pop(parameter.name, None)
        else:
            self._request(parameter.name)

    def _apply(self, parameter: Parameter, message: mavlink.MAVLink_param_set_message) -> str:
        value = float32(message.param_value)
        if parameter.on_set is None:
            return "it is read only"
        if message.param_type != _REAL32:
            # The bytes could be a number or an integer's bits, depending on the sender.
            return f"its type is REAL32 (9), not {message.param_type}"
        if not parameter.allows(value):
            return f"{value:g} is not in {parameter.minimum:g} .. {parameter.maximum:g}"
        if value == self._values[parameter.name]:
            return ""
        try:
            parameter.on_set(value)
        except CompanionError as error:
            return str(error)
        except Exception:
            logger.exception("setting %s failed", parameter.name)
            return "an internal error, see the log"
        self._values[parameter.name] = value
        return ""

    def _send_unknown(self, message: Any, index: int) -> None:
        sender = message.get_srcSystem(), message.get_srcComponent()
        name, why = message.param_id.encode("ascii", "replace")[:16], mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST
        self._link.send(mavlink.MAVLink_param_error_message(*sender, name, index, why))
