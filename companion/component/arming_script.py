"""The verdict for ArduPilot's arming script, twice a second, from the working loop and from nowhere else.

Carried by TUNNEL: unlike PARAM_SET it wears no flash, unlike NAMED_VALUE_FLOAT it is addressed to the autopilot alone,
so that no radio link carries it on to the ground, and it has room for the reason as text. The script
(companion/lua/companion_arming.lua) closes the gate when nothing has come for 3 s: a loop that hangs closes it too.

Payload: "CMPA", version 1, verdict (0 wait, 1 accept, 2 refuse, 3 nothing is gated any more), then the reason, ASCII.
"""

from __future__ import annotations

import math
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.service import ArmGate, VehicleView
from companion.component.statustext import to_ascii
from companion.links.mavlink.link import MavlinkLink

PERIOD_S: Final = 0.5
PAYLOAD_TYPE: Final = 33191
"""One of the numbers that MAVLink leaves to local use (above 32767); the payload's own mark tells it apart."""
MARK: Final = b"CMPA\x01"
REASON_BYTES: Final = 41
"""What ArduPilot shows of an auxiliary authorisation's reason (autopilots 5.3)."""
VERDICTS: Final = {"wait": 0, "accept": 1, "refuse": 2}
NOT_GATING: Final = 3
_TUNNEL_BYTES: Final = 128


class ArmingScript:
    """Speaks to the script while the gate asks for it; `step` must be called at the times it asks for."""

    def __init__(self, link: MavlinkLink, vehicle: VehicleView, gate: ArmGate) -> None:
        self._link, self._vehicle, self._gate = link, vehicle, gate
        self._next_s = -math.inf

    def step(self, now_s: float) -> float:
        """Send what is due; returns when something is due next (infinity: nobody asks; heartbeats bring us back)."""
        system_id = self._vehicle.system_id
        if system_id is None or not self._link.connected or not self._gate.asks_script:
            return math.inf
        if now_s >= self._next_s:
            self._next_s = now_s + PERIOD_S
            self._link.send(self._message(system_id))
        return self._next_s

    def _message(self, system_id: int) -> mavlink.MAVLink_tunnel_message:
        answer = self._gate.answer()
        verdict = VERDICTS[answer.verdict] if self._gate.at_arm == "gate" else NOT_GATING
        reason = to_ascii(answer.words).encode("ascii")[:REASON_BYTES]
        data = MARK + bytes([verdict]) + reason
        return mavlink.MAVLink_tunnel_message(
            system_id,
            mavlink.MAV_COMP_ID_AUTOPILOT1,
            PAYLOAD_TYPE,
            len(data),
            list(data.ljust(_TUNNEL_BYTES, b"\0")),
        )
