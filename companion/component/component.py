"""Component 191 as a whole: one working loop that beats the heart, answers commands, speaks and serves parameters."""

from __future__ import annotations

import asyncio
import math
import struct
from collections.abc import Sequence
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.arm_authorisation import ArmAuthoriser, ArmingScript
from companion.component.commands import CommandServer, Permission
from companion.component.own_parameters import OwnParameters, Parameter
from companion.component.service import ArmGate, CalibrationService
from companion.component.statustext import StatusText
from companion.component.tunes import Tunes
from companion.config.sections import Senders
from companion.links.mavlink.link import MavlinkLink

HEARTBEAT_PERIOD_S = 1.0
_RETRY_S = 0.05
PROGRESS: Final = "CMP_PROG"
"""Percent of the calibration under way; 100 where none is."""
READY: Final = "CMP_READY"
"""1: it may arm; 0: not now."""
IDLE_BEATS: Final = 5


class MavlinkComponent:
    """The companion on the MAVLink network.

    Everything is sent from `run`: when that loop stalls, so does the heartbeat, and the network can see it.
    """

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
        """Turns of the working loop, so that it is seen to go on."""
        self.permission = Permission(senders)
        self.parameters = OwnParameters(link, parameters, texts.say, self._woken.set, self.permission)
        self._commands = CommandServer(link, service, texts.say, self._woken.set, self.permission)
        self._script = ArmingScript(link, gate)
        self._authoriser = ArmAuthoriser(link, gate, texts.say)
        refuse_files(link)
        link.subscribe(mavlink.MAVLink_heartbeat_message, self._on_heartbeat)

    async def run(self) -> None:
        """Be the component until cancelled."""
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
        self._follow_vehicle()
        if now_s >= self._next_heartbeat_s:
            if self._link.connected:
                self._link.send(heartbeat(self._service.mav_state))
                self._tell_values(now_s)
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

    def _tell_values(self, now_s: float) -> None:
        """Progress and readiness, with some 12 bytes a second: at every beat while it calibrates, else every fifth.

        Mission Planner shows them in its Quick tab (`propagateNamedFloats`), QGroundControl in its MAVLink inspector.
        """
        self._beats += 1
        if self._service.mav_state != mavlink.MAV_STATE_CALIBRATING and self._beats % IDLE_BEATS:
            return
        ready = self._gate.answer().verdict == "accept"
        for name, value in ((PROGRESS, float(self._service.progress_percent)), (READY, float(ready))):
            boot_ms = int(now_s * 1e3) % 2**32
            self._link.send(mavlink.MAVLink_named_value_float_message(boot_ms, name.encode("ascii"), value))

    def _follow_vehicle(self) -> None:
        """Be heard under the vehicle's system id as soon as the link belongs to it."""
        if self._link.system_id != self._known_as:
            self._known_as = self._link.system_id
            self._next_heartbeat_s = -math.inf

    def _on_heartbeat(self, _message: mavlink.MAVLink_heartbeat_message, _t_s: float) -> None:
        if self._link.system_id != self._known_as:
            self._woken.set()


def heartbeat(mav_state: int) -> mavlink.MAVLink_heartbeat_message:
    """Our heartbeat: an onboard controller that is no autopilot."""
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mav_state, 3
    )


_HEADER: Final = struct.Struct("<HBBBBBBI")
_PAYLOAD_BYTES: Final = 251
_NAK: Final = 129
_ANSWERS: Final = 128
"""Opcodes from here on are answers."""
_OPENS: Final = (4, 6, 11)
"""To read, to create, to write."""
_UNKNOWN_COMMAND, _FILE_NOT_FOUND = 7, 10


def refuse_files(link: MavlinkLink) -> None:
    """Answer requests for files that are addressed to us: MAVProxy would wait through two time-outs for our parameters.

    MAVFTP (FILE_TRANSFER_PROTOCOL, 110), MAVLink developer guide: a request's payload is sequence, session, opcode,
    size, opcode answered to, burst, a byte of padding, offset, data; an answer's sequence is the next one.
    """

    def answer(message: mavlink.MAVLink_file_transfer_protocol_message, _t_s: float) -> None:
        sequence, session, opcode, *_ = _HEADER.unpack_from(bytes(message.payload))
        if (message.target_system, message.target_component) != (link.system_id, link.component_id):
            return
        if opcode >= _ANSWERS:
            return
        why = _FILE_NOT_FOUND if opcode in _OPENS else _UNKNOWN_COMMAND
        header = _HEADER.pack((sequence + 1) % 65536, session, _NAK, 1, opcode, 0, 0, 0)
        payload = list((header + bytes([why])).ljust(_PAYLOAD_BYTES, b"\0"))
        sender = message.get_srcSystem(), message.get_srcComponent()
        link.send(mavlink.MAVLink_file_transfer_protocol_message(0, *sender, payload))

    link.subscribe(mavlink.MAVLink_file_transfer_protocol_message, answer)
