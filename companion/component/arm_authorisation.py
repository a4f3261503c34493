"""What an autopilot learns before it arms. PX4 asks, and gets its answer in the same pass of the loop.

What PX4 sends and takes was seen on the running firmware (autopilots 9.2) and differs from the message definitions:
the validity goes into result_param2, the reason into progress, and an answer that is not addressed to the vehicle's
own system id is ignored. An attempt brings two requests, and retransmissions of both; each gets an answer, but people
are told once.

ArduPilot's arming script (companion/lua/companion_arming.lua) gets the verdict twice a second, from the working loop
and from nowhere else: it closes the gate when nothing has come for 3 s, so that a loop that hangs closes it too.
Carried by TUNNEL: unlike PARAM_SET it wears no flash, unlike NAMED_VALUE_FLOAT it is addressed to the autopilot alone,
so that no radio link carries it on to the ground, and it has room for the reason as text.
Payload: "CMPA", version 1, verdict (0 wait, 1 accept, 2 refuse, 3 nothing is gated any more), then the reason, ASCII.
"""

from __future__ import annotations

import asyncio
import math
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.service import ArmGate
from companion.component.statustext import Say, Severity, Weight, shortened, to_ascii
from companion.links.mavlink.link import MavlinkLink
from companion.lua import to_script

VALID_S: Final = 10
"""How long the autopilot may arm on an ACCEPTED without asking again; 0 would expire at once."""
TOLD_BY_US: Final = 1
"""MAV_ARM_AUTH_DENIED_REASON_NONE: the autopilot stays silent, since our STATUSTEXT says it better."""
REPEAT_S: Final = 0.05
"""Every answer is given once more so much later. PX4 drops one that carries the very time of its question, as a quick
one does in SITL's lockstep, and then asks no more; and links lose packets. A second answer changes nothing for it."""
ATTEMPT_S: Final = 1.5
"""A request so long after the first of an attempt, and no retransmission, begins a new one."""
_RESULTS: Final = {
    "accept": mavlink.MAV_RESULT_ACCEPTED,
    "wait": mavlink.MAV_RESULT_TEMPORARILY_REJECTED,
    "refuse": mavlink.MAV_RESULT_DENIED,
}


class ArmAuthoriser:
    """Answers MAV_CMD_ARM_AUTHORIZATION_REQUEST of our autopilot; of anybody else it is ignored."""

    def __init__(self, link: MavlinkLink, gate: ArmGate, say: Say) -> None:
        self._link, self._gate, self._say = link, gate, say
        self._attempt_s = -math.inf
        link.subscribe(mavlink.MAVLink_command_long_message, self._on_message)

    def _on_message(self, message: mavlink.MAVLink_command_long_message, now_s: float) -> None:
        if message.command != mavlink.MAV_CMD_ARM_AUTHORIZATION_REQUEST:
            return
        autopilot = self._link.autopilot
        sender = (message.get_srcSystem(), message.get_srcComponent())
        if autopilot is None or sender != (autopilot[0], mavlink.MAV_COMP_ID_AUTOPILOT1):
            return
        target = (message.target_system, message.target_component)
        if target not in ((self._link.system_id, 0), (self._link.system_id, self._link.component_id)):
            return  # PX4 asks on every link; whom it asks is checked with its parameters
        if self._gate.at_arm == "off":
            return
        answer, gate = self._gate.answer(), self._gate.at_arm == "gate"
        result = _RESULTS[answer.verdict] if gate else mavlink.MAV_RESULT_ACCEPTED
        accepted = result == mavlink.MAV_RESULT_ACCEPTED
        progress = TOLD_BY_US if result == mavlink.MAV_RESULT_DENIED else 0
        ack = mavlink.MAVLink_command_ack_message(
            message.command, result, progress, VALID_S if accepted else 0, *sender
        )
        self._link.send(ack)
        asyncio.get_running_loop().call_later(REPEAT_S, self._link.send, ack)
        if self._begins_attempt(message.confirmation, now_s) and answer.verdict != "accept":
            words = f"{'Not armed' if gate else 'Arming uncalibrated'}: {answer.words}"
            self._say(Severity.WARNING, words, Weight.REFUSAL)

    def _begins_attempt(self, confirmation: int, now_s: float) -> bool:
        """Whether people have not been told of this attempt yet."""
        if now_s - self._attempt_s <= ATTEMPT_S or (confirmation > 0 and now_s - self._attempt_s <= 3 * ATTEMPT_S):
            return False
        self._attempt_s = now_s
        return True


PERIOD_S: Final = 0.5
MARK: Final = b"CMPA\x01"
REASON_BYTES: Final = 41 - len("Companion: ")
"""What ArduPilot shows of an auxiliary authorisation's reason (autopilots 5.3), less what the script puts before it."""
VERDICTS: Final = {"wait": 0, "accept": 1, "refuse": 2}
NOT_GATING: Final = 3


class ArmingScript:
    """Speaks to the script while the gate asks for it; `step` must be called at the times it asks for."""

    def __init__(self, link: MavlinkLink, gate: ArmGate) -> None:
        self._link, self._gate = link, gate
        self._next_s = -math.inf

    def step(self, now_s: float) -> float:
        """Send what is due; returns when something is due next (infinity: nobody asks; heartbeats bring us back)."""
        autopilot = self._link.autopilot
        if autopilot is None or not self._link.connected or not self._gate.asks_script:
            return math.inf
        if now_s >= self._next_s:
            self._next_s = now_s + PERIOD_S
            self._link.send(self._message(autopilot[0]))
        return self._next_s

    def _message(self, system_id: int) -> mavlink.MAVLink_tunnel_message:
        answer = self._gate.answer()
        verdict = VERDICTS[answer.verdict] if self._gate.at_arm == "gate" else NOT_GATING
        reason = shortened(to_ascii(answer.words), REASON_BYTES).encode("ascii")
        return to_script(system_id, MARK + bytes([verdict]) + reason)
