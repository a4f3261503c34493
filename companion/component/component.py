"""MAVLink component 191: one loop sends heartbeats, ACKs, texts, tunes and parameters."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Sequence
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.arm_authorisation import ArmAuthoriser, ArmingScript
from companion.component.commands import CommandServer, Permission
from companion.component.own_parameters import OwnParameters, Parameter
from companion.component.service import ArmGate, CalibrationService
from companion.component.statustext import StatusText, Tunes
from companion.config.sections import Senders
from companion.links.mavlink.link import MavlinkLink

HEARTBEAT_PERIOD_S = 1.0
_RETRY_S = 0.05
PROGRESS: Final = "CMP_PROG"
"""Progress of the calibration under way in percent; 100 where none is."""
READY: Final = "CMP_READY"
"""1: it may arm; 0: not now."""
IDLE_BEATS: Final = 5


class MavlinkComponent:
    """The companion on the MAVLink network; a loop that stalls stops its heartbeat too."""

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
        self._known_as = link.system_id
        """The system id under which we were heard last."""
        self._next_heartbeat_s = -math.inf
        self._beats = 0
        self.turns = 0
        self.permission = Permission(senders)
        self.parameters = OwnParameters(link, parameters, texts.say, self._woken.set, self.permission)
        self._commands = CommandServer(link, service, texts.say, self._woken.set, self.permission)
        self._script = ArmingScript(link, gate)
        self._authoriser = ArmAuthoriser(link, gate, texts.say)
        link.subscribe(mavlink.MAVLink_heartbeat_message, self._on_heartbeat)

    async def run(self) -> None:
        """Send until cancelled."""
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
            # Be heard under the vehicle's system id as soon as the link belongs to it.
            self._known_as, self._next_heartbeat_s = self._link.system_id, -math.inf
        if now_s >= self._next_heartbeat_s:
            if self._link.connected:
                kind = mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID
                self._link.send(mavlink.MAVLink_heartbeat_message(*kind, 0, 0, self._service.mav_state, 3))
                self._send_values(now_s)
                # The rhythm is kept, but what a stall has missed is not made up for.
                next_s = self._next_heartbeat_s + HEARTBEAT_PERIOD_S
                self._next_heartbeat_s = next_s if next_s > now_s else now_s + HEARTBEAT_PERIOD_S
            else:
                # The first heartbeat on a new connection must not wait for its turn: ArduPilot executes itself
                # what is addressed to a component that it has not heard.
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
        """Send progress and readiness, at every heartbeat of a calibration, else at every fifth.

        Mission Planner shows them in its Quick tab (`propagateNamedFloats`), QGroundControl in its MAVLink inspector.
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
