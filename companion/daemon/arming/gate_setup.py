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
"""How long the script is given to answer: scripting starts some seconds after the first heartbeat."""
SHORTEST_TIMEOUT_S: Final = 0.5
_PX4: Final = ("COM_ARM_AUTH_REQ", "COM_ARM_AUTH_ID", "COM_ARM_AUTH_MET", "COM_ARM_AUTH_TO")
_SCRIPT: Final = "CMPG_ENABLE"


class GateSetup:
    """Reads what decides whether the autopilot asks: at every start of it, and when one of it is changed."""

    def __init__(self, core: Core, readiness: Readiness) -> None:
        self._vehicle, self._parameters, self._say = core.vehicle, core.parameters, core.say
        self._readiness = readiness
        self._stale = asyncio.Event()
        self._said: str | None = None
        self.problem: str | None = None
        """What has to be set, for people; None while all is well or not known yet."""
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
                self.problem = await self.find_missing()
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
        if self.known and (name in _PX4 or name == _SCRIPT):
            self.known = False
            self._stale.set()

    def _tell(self) -> None:
        if self.problem is None:
            self._said = None
        elif self.problem != self._said and self._readiness.at_arm == "gate":
            self._said = self.problem
            logger.warning("arming is not gated: %s", self.problem)
            self._say(Severity.WARNING, f"NO GATE: {self.problem}", Weight.RESULT)

    async def find_missing(self, script_starts_s: float = SCRIPT_STARTS_S) -> str | None:
        """What has to be set so that the autopilot asks, for people; None: nothing.

        ArduPilot's script is waited for where it does not run yet.

        Raises:
            AutopilotError: it does not answer.
        """
        if self._vehicle.firmware == "px4":
            return await self._px4()
        if self._vehicle.firmware == "ardupilot":
            return await self._ardupilot(script_starts_s)
        return "this autopilot has no gate that is known here"

    async def _px4(self) -> str | None:
        required, system, method, timeout_s = [await self._parameters.read_optional(name) for name in _PX4]
        if required is None:
            return "this PX4 has no arm authorisation"
        own = self._vehicle.system_id
        wrong = [
            *(["COM_ARM_AUTH_REQ 1"] if required != 1 else []),
            *([f"COM_ARM_AUTH_ID {own}"] if system != own else []),
            *(["COM_ARM_AUTH_MET 0"] if method not in (None, 0) else []),
            *(["COM_ARM_AUTH_TO 1"] if timeout_s is not None and timeout_s < SHORTEST_TIMEOUT_S else []),
        ]
        return f"set {', '.join(wrong)}" if wrong else None

    async def _ardupilot(self, script_starts_s: float) -> str | None:
        enabled = await self._parameters.read_optional(_SCRIPT)
        if enabled is None and script_starts_s:
            await asyncio.sleep(script_starts_s)
            enabled = await self._parameters.read_optional(_SCRIPT)
        if enabled is None:
            return "the arming script does not run (see: companion lua)"
        return "set CMPG_ENABLE 1" if enabled == 0 else None

    def status(self) -> dict[str, object]:
        """For `companion status` and `check`."""
        return {"known": self.known, "problem": self.problem if self.known else None}
