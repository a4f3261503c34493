"""The source set that ArduPilot flies by when our heading ends: gyros and GNSS in flight, set 3 (autopilots 10.4).

The compass, set 2, is for the ground: in flight nobody could compare it. The script on the flight controller selects
(companion/lua); without it the companion asks. PX4 goes back to its magnetometer by itself.
"""

from __future__ import annotations

import asyncio
import logging
import math
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.base import Net
from companion.autopilot.vehicle.vehicle import ArmState, VehicleEvent
from companion.component.statustext import Severity, Weight
from companion.daemon.core import Core
from companion.errors import AutopilotError

logger = logging.getLogger(__name__)

SCRIPT_STARTS_S: Final = 15.0
"""After the first heartbeat: before that nobody knows whether there is one."""
WELL_S: Final = 10.0
"""Time that our heading must have been pushed before its source set is asked for again."""
AGAIN_S: Final = 1.0
_OURS, _COMPASS, _GYROS = 1, 2, 3
_WORDS: Final = {
    _OURS: "Heading: companion",
    _COMPASS: "Heading: compass, companion's is not pushed",
    _GYROS: "Heading: gyros, companion's is not pushed",
}


class Fallback:
    """`run` finds out who sees to it; `step` asks, if that is us."""

    def __init__(self, core: Core) -> None:
        self._vehicle, self._parameters, self._say = core.vehicle, core.parameters, core.say
        self.net: Net | None = None
        self._selected = False
        self._stale = asyncio.Event()
        self._pushed_since_s = math.inf
        self._asked: int | None = None
        self._tried_s = -math.inf
        core.vehicle.on_event.add(self._on_event)

    @property
    def is_all(self) -> bool:
        """Return whether the autopilot has no heading but ours: its yaw means nothing without it."""
        return self._selected and self.net == "none"

    async def run(self) -> None:
        """Look at every start of the autopilot, until cancelled."""
        while True:
            await self._vehicle.found.wait()
            self._stale.clear()
            kind = self._vehicle.kind
            await asyncio.sleep(SCRIPT_STARTS_S)
            if kind.heading_settings:
                try:
                    found = await self._parameters.read_many(kind.heading_names(), optional=True)
                except AutopilotError as error:
                    logger.info("what the autopilot flies by when our heading ends is not known: %s", error)
                    continue
                self.net, self._selected = kind.heading_net(found), kind.takes_only_our_heading(found)
            await self._stale.wait()

    def _on_event(self, event: VehicleEvent) -> None:
        if event in ("found", "rebooted"):
            self.net = self._asked = None
            self._stale.set()

    def step(self, now_s: float, *, pushing: bool) -> None:
        """Ask for the set that is right, if nobody else does."""
        self._pushed_since_s = min(self._pushed_since_s, now_s) if pushing else math.inf
        if self.net != "command" or not self._selected:
            return
        if pushing:
            if now_s - self._pushed_since_s < WELL_S:
                return  # until ours has been well for long enough, what is in use stays
            wanted = _OURS
        else:
            wanted = _COMPASS if self._vehicle.arm_state is ArmState.DISARMED else _GYROS
        if wanted == self._asked or now_s - self._tried_s < AGAIN_S:
            return
        self._tried_s = now_s
        answer = self._vehicle.commands.send(mavlink.MAV_CMD_SET_EKF_SOURCE_SET, wanted)
        answer.add_done_callback(lambda done: self._answered(wanted, done.result()))

    def close(self, now_s: float) -> None:
        """Our heading ends with the daemon."""
        self._tried_s = -math.inf
        self.step(now_s, pushing=False)

    def _answered(self, wanted: int, result: int | None) -> None:
        if result == mavlink.MAV_RESULT_ACCEPTED and self._asked != wanted:
            self._asked = wanted
            self._say(Severity.NOTICE if wanted == _OURS else Severity.WARNING, _WORDS[wanted], Weight.NEWS)
