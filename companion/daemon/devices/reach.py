"""Whether ground stations reach the companion, and if not, why.

Both firmwares forward a command for component 191 only to a link on which they hear its heartbeat. PX4 forwards only
between links with MAV_n_FORWARD = 1 at its start; no message tells which MAV_n our link is (autopilots 5.4).
"""

from __future__ import annotations

import asyncio
import logging
import math
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.firmwares import port_needs
from companion.autopilot.vehicle.parameter_client import ParameterClient
from companion.autopilot.vehicle.vehicle import Vehicle, VehicleEvent
from companion.configured.models import baud_of
from companion.errors import AutopilotError
from companion.links.mavlink.link import MavlinkLink

logger = logging.getLogger(__name__)

SILENT_S: Final = 5.0
RETRY_S: Final = 10.0


class Reach:
    """Listens for ground stations and reads what the autopilot says about forwarding."""

    def __init__(self, link: MavlinkLink, vehicle: Vehicle, parameters: ParameterClient, url: str) -> None:
        self._vehicle, self._parameters, self._baud = vehicle, parameters, baud_of(url)
        self._heard_s = -math.inf
        self._closed: list[str] = []
        self._stale = asyncio.Event()
        self._stale.set()
        link.subscribe(mavlink.MAVLink_heartbeat_message, self._on_heartbeat)
        vehicle.on_event.add(self._on_event)

    @property
    def answered(self) -> bool:
        """Return whether the autopilot has answered anything, so that it hears us."""
        results = self._vehicle.commands.results
        return self._parameters.answering or any(
            count for word, count in results.items() if word not in ("no answer", "dropped")
        )

    def text(self) -> tuple[bool, str]:
        """For `companion check`: whether all is well, and the facts with the fix."""
        if not self._vehicle.alive:
            return True, "not known: no autopilot"
        if not self.answered:
            needs = "" if self._baud is None else f"; {port_needs(self._vehicle.firmware, self._baud)}"
            return False, (
                "the autopilot is heard but does not answer: it does not hear our heartbeat, so nobody can reach the"
                " companion through it; check the wire to the autopilot's RX, the baud rate and the port's protocol"
                f"{needs}{self._vehicle.why_silent}"
            )
        if asyncio.get_running_loop().time() - self._heard_s < SILENT_S:
            return True, "a ground station is heard; it reaches the companion as component 191 of this vehicle"
        return self._vehicle.kind.forwarding_words(self._closed)

    async def run(self) -> None:
        """Read what there is to know, again after every restart, until cancelled."""
        while True:
            await self._stale.wait()
            self._stale.clear()
            await self._vehicle.found.wait()
            try:
                self._closed = await self._vehicle.kind.read_closed_links(self._parameters)
            except AutopilotError as error:
                logger.debug("forwarding is not known yet: %s", error)
                await asyncio.sleep(RETRY_S)
                self._stale.set()

    def _on_heartbeat(self, message: mavlink.MAVLink_heartbeat_message, t_s: float) -> None:
        if message.type == mavlink.MAV_TYPE_GCS:
            self._heard_s = t_s

    def _on_event(self, event: VehicleEvent) -> None:
        if event in ("found", "rebooted"):
            self._stale.set()
