"""Is the autopilot set up for the gate? A gate that nobody asks is none, and must be known before the flight line."""

from __future__ import annotations

import asyncio
import logging
from typing import Final

from companion.autopilot.vehicle.vehicle import VehicleEvent
from companion.component.statustext import Severity, Weight
from companion.daemon.arming.readiness import Readiness
from companion.daemon.core import Core
from companion.errors import AutopilotError

logger = logging.getLogger(__name__)

POLL_S: Final = 1.0
RETRY_S: Final = 30.0
SCRIPT_STARTS_S: Final = 10.0
"""Time that the script is given to answer: scripting starts some seconds after the first heartbeat."""


class GateSetup:
    """Reads what decides whether the autopilot asks: at every start of it, and when one of it is changed."""

    def __init__(self, core: Core, readiness: Readiness) -> None:
        self._vehicle, self._parameters, self._say = core.vehicle, core.parameters, core.say
        self._readiness = readiness
        self._stale = asyncio.Event()
        self._said: str | None = None
        self.problem: str | None = None
        """Settings that are missing, for people; None while all is well or not known yet."""
        self.known = False
        core.vehicle.on_event.add(self._on_event)
        core.parameters.on_value.add(self._on_parameter)

    async def run(self) -> None:
        """Look whenever there is something new, until cancelled."""
        while True:
            await self._stale.wait()
            while self._readiness.at_arm != "gate":  # may be set at the flight line
                await asyncio.sleep(POLL_S)
            await self._vehicle.found.wait()
            self._stale.clear()
            try:
                self.problem = await self._vehicle.kind.find_gate_problem(
                    self._parameters, self._vehicle.system_id, SCRIPT_STARTS_S
                )
            except AutopilotError as error:
                logger.info("whether the gate is set up is not known: %s", error)
                self._stale.set()
                await asyncio.sleep(RETRY_S)
            else:
                self.known = True
                self._tell()

    def _on_event(self, event: VehicleEvent) -> None:
        if event in ("found", "rebooted"):
            self.known = False
            self._stale.set()

    def _on_parameter(self, name: str, value: float) -> None:
        if self.known and name in self._vehicle.kind.gate_parameters:
            self.known = False
            self._stale.set()

    def _tell(self) -> None:
        if self.problem is None:
            self._said = None
        elif self.problem != self._said and self._readiness.at_arm == "gate":
            self._said = self.problem
            logger.warning("arming is not gated: %s", self.problem)
            self._say(Severity.WARNING, f"NO GATE: {self.problem}", Weight.RESULT)

    def status(self) -> dict[str, object]:
        """For `companion status` and `check`."""
        return {"known": self.known, "problem": self.problem if self.known else None}
