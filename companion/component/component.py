"""MAVLink component 191: answers requests to arm, and sends heartbeats, ACKs, texts, tunes and parameters."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Sequence
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.commands import CommandServer, Permission
from companion.component.own_parameters import OwnParameters, Parameter
from companion.component.service import ArmGate, CalibrationService
from companion.component.statustext import Say, Severity, StatusText, Tunes, Weight, shortened, to_ascii
from companion.config.sections import Senders
from companion.links.mavlink.link import MavlinkLink
from companion.lua import to_script

VALID_S: Final = 10
"""Time in seconds for which our answer ACCEPTED allows PX4 to arm; an answer with 0 would expire at once."""
TOLD_BY_US: Final = 1
"""Value of MAV_ARM_AUTH_DENIED_REASON_NONE: the autopilot shows no reason, because our STATUSTEXT does."""
REPEAT_S: Final = 0.05
"""Delay before an answer to an arming request is sent a second time. Links lose packets, and PX4 drops an answer with
the same timestamp as the request. In SITL's lockstep the timestamps can be equal."""
ATTEMPT_S: Final = 1.5
"""Time for which new arming requests count as one attempt to arm; for retransmitted requests it is 4.5 s."""
_RESULTS: Final = {
    "accept": mavlink.MAV_RESULT_ACCEPTED,
    "wait": mavlink.MAV_RESULT_TEMPORARILY_REJECTED,
    "refuse": mavlink.MAV_RESULT_DENIED,
}


class ArmAuthoriser:
    """Answers MAV_CMD_ARM_AUTHORIZATION_REQUEST from our autopilot (PX4) at once; ignores other senders.

    PX4 differs from MAVLink's definitions (docs/reference/autopilots.md section 9.2). It expects the validity in
    `result_param2` and the reason in `progress`, and ignores answers that do not name its system id. One attempt to
    arm sends two requests and retransmissions of both. Each gets an answer, but the pilot gets only one text.
    """

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
            return  # PX4 sends requests on every link; `GateSetup` checks the parameters that name the recipient
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
        if now_s - self._attempt_s <= ATTEMPT_S or (confirmation > 0 and now_s - self._attempt_s <= 3 * ATTEMPT_S):
            return False
        self._attempt_s = now_s
        return True


SCRIPT_PERIOD_S: Final = 0.5
MARK: Final = b"CMPA\x01"
REASON_BYTES: Final = 41 - len("Companion: ")
"""Maximum length of a reason that ArduPilot shows after "Companion: " (docs/reference/autopilots.md section 5.3)."""
VERDICTS: Final = {"wait": 0, "accept": 1, "refuse": 2}
NOT_GATING: Final = 3


class ArmingScript:
    """Sends the arm gate's verdict twice a second to our arming script on ArduPilot (companion/lua).

    The script forbids arming after 3 s without a verdict, so a daemon whose loop hangs prevents arming too. The message
    is TUNNEL: it has room for the reason. PARAM_SET would wear the flash; NAMED_VALUE_FLOAT would reach everybody.
    Payload: "CMPA", a version byte (1), a verdict byte (0 wait, 1 accept, 2 refuse, 3 gate off), the reason in ASCII.
    """

    def __init__(self, link: MavlinkLink, gate: ArmGate) -> None:
        self._link, self._gate = link, gate
        self._next_s = -math.inf

    def step(self, now_s: float) -> float:
        """Send the verdict if due; return the time of the next verdict, or infinity if no script can receive one."""
        autopilot = self._link.autopilot
        if autopilot is None or not self._link.connected or not self._gate.asks_script:
            return math.inf
        if now_s >= self._next_s:
            self._next_s, answer = now_s + SCRIPT_PERIOD_S, self._gate.answer()
            verdict = VERDICTS[answer.verdict] if self._gate.at_arm == "gate" else NOT_GATING
            reason = shortened(to_ascii(answer.words), REASON_BYTES).encode("ascii")
            self._link.send(to_script(autopilot[0], MARK + bytes([verdict]) + reason))
        return self._next_s


HEARTBEAT_PERIOD_S = 1.0
_RETRY_S = 0.05
PROGRESS: Final = "CMP_PROG"  # Progress of the running calibration in percent; 100: none runs
READY: Final = "CMP_READY"  # 1: the aircraft may arm; 0: not now
IDLE_BEATS: Final = 5


class MavlinkComponent:
    """The companion on the MAVLink network; one loop sends everything, so a stalled loop stops the heartbeat too."""

    def __init__(
        self,
        link: MavlinkLink,
        service: CalibrationService,
        gate: ArmGate,
        texts: StatusText,
        tunes: Tunes,
        parameters: Sequence[Parameter],
        senders: Senders,
    ) -> None:
        self._link, self._service, self._gate, self._texts, self._tunes = link, service, gate, texts, tunes
        self._woken = texts.woken
        self._known_as = link.system_id  # System id of our last heartbeats
        self._next_heartbeat_s = -math.inf
        self._beats = 0
        self.turns = 0
        self.permission = Permission(senders)
        self.parameters = OwnParameters(link, parameters, texts, self.permission)
        self._commands = CommandServer(link, service, texts, self.permission)
        self._script = ArmingScript(link, gate)
        self._authoriser = ArmAuthoriser(link, gate, texts.say)
        link.subscribe(mavlink.MAVLink_heartbeat_message, self._on_heartbeat)

    async def run(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            while True:
                self._woken.clear()
                due_s = self._step(loop.time())
                self.turns += 1
                timer = loop.call_at(due_s, self._woken.set)
                try:
                    await self._woken.wait()
                finally:
                    timer.cancel()
        finally:
            self._commands.close(loop.time())
            self._texts.step(loop.time())

    def _step(self, now_s: float) -> float:
        if self._link.system_id != self._known_as:
            # Announce the vehicle's system id as soon as the link belongs to that vehicle.
            self._known_as, self._next_heartbeat_s = self._link.system_id, -math.inf
        if now_s >= self._next_heartbeat_s:
            if self._link.connected:
                kind = mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID
                self._link.send(mavlink.MAVLink_heartbeat_message(*kind, 0, 0, self._service.mav_state, 3))
                self._send_values(now_s)
                # Keep the rhythm, but skip the heartbeats that a stall of this loop has missed.
                next_s = self._next_heartbeat_s + HEARTBEAT_PERIOD_S
                self._next_heartbeat_s = next_s if next_s > now_s else now_s + HEARTBEAT_PERIOD_S
            else:
                # Retry soon: until ArduPilot has received a heartbeat from a component, it executes commands for
                # that component itself.
                self._next_heartbeat_s = now_s + _RETRY_S
        return min(
            self._next_heartbeat_s,
            self._script.step(now_s),
            self._commands.step(now_s),
            self.parameters.step(now_s),
            self._texts.step(now_s),
            self._tunes.step(now_s),
        )

    def _send_values(self, now_s: float) -> None:
        """Send progress and readiness to arm: at every heartbeat during a calibration, otherwise at every fifth.

        Mission Planner shows both in its Quick tab (`propagateNamedFloats`), QGroundControl in its MAVLink inspector.
        """
        self._beats += 1
        if self._service.mav_state != mavlink.MAV_STATE_CALIBRATING and self._beats % IDLE_BEATS:
            return
        ready = self._gate.answer().verdict == "accept"
        for name, value in ((PROGRESS, float(self._service.progress_percent)), (READY, float(ready))):
            boot_ms = int(now_s * 1e3) % 2**32
            self._link.send(mavlink.MAVLink_named_value_float_message(boot_ms, name.encode("ascii"), value))

    def _on_heartbeat(self, _message: mavlink.MAVLink_heartbeat_message, _t_s: float) -> None:
        if self._link.system_id != self._known_as:
            self._woken.set()
