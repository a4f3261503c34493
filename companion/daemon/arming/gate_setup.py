"""Checks whether the autopilot is set up for the gate: one that never asks must be known before the flight line."""

from __future__ import annotations

import asyncio
import logging
from typing import Final

from companion.autopilot.vehicle.vehicle import VehicleEvent
from companion.component.statustext import Severity, Weight
from companion.daemon.core import Core
from companion.errors import AutopilotError

logger = logging.getLogger(__name__)

POLL_S: Final = 1.0
RETRY_S: Final = 30.0
SCRIPT_STARTS_S: Final = 10.0
"""Time for the script to answer: scripting starts some seconds after the first heartbeat."""


class GateSetup:
    """Reads what decides whether the autopilot asks: at every start of it, and when one of it is changed."""

    def __init__(self, core: Core) -> None:
        self._core, self._vehicle = core, core.vehicle
        self._stale = asyncio.Event()
        self._said: str | None = None
        self.problem: str | None = None
        """Missing settings, for people; None while all is well or not known yet."""
        self.known = False
        core.vehicle.on_event.add(self._on_event)
        core.parameters.on_value.add(self._on_parameter)

    async def run(self) -> None:
        """Check whenever there is something new, until cancelled."""
        while True:
            await self._stale.wait()
            while self._core.wanted.at_arm != "gate":  # may be set at the flight line
                await asyncio.sleep(POLL_S)
            await self._vehicle.found.wait()
            self._stale.clear()
            try:
                self.problem = await self._vehicle.kind.find_gate_problem(
                    self._core.parameters, self._vehicle.system_id, SCRIPT_STARTS_S
                )
            except AutopilotError as error:
                logger.info("whether the gate is set up is not known: %s", error)
                self._stale.set()
                await asyncio.sleep(RETRY_S)
                continue
            self.known = True
            if self.problem not in (None, self._said) and self._core.wanted.at_arm == "gate":
                logger.warning("arming is not gated: %s", self.problem)
                self._core.say(Severity.WARNING, f"NO GATE: {self.problem}", Weight.RESULT)
            self._said = self.problem

    def _on_event(self, event: VehicleEvent) -> None:
        if event in ("found", "rebooted"):
            self.known = False
            self._stale.set()

    def _on_parameter(self, name: str, value: float) -> None:
        if self.known and name in self._vehicle.kind.gate_parameters:
            self.known = False
            self._stale.set()
