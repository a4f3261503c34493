"""What is read of the autopilot and may be another after each of its starts: one loop for all who read so."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable

from companion.autopilot.vehicle.vehicle import Vehicle, VehicleEvent
from companion.errors import AutopilotError

logger = logging.getLogger(__name__)


class Rereading:
    """Reads at every start, after `again`, and once more `retry_s` after a failure; `run` it.

    `read` raises an AutopilotError where the autopilot does not answer, which is logged at `level` under `name`.
    """

    def __init__(
        self, vehicle: Vehicle, read: Callable[[], Awaitable[None]], name: str, *, retry_s: float, level: int
    ) -> None:
        self.known = False
        """Whether it was read, and nothing has happened since that may have changed it."""
        self._vehicle, self._read, self._name, self._retry_s, self._level = vehicle, read, name, retry_s, level
        self._stale = asyncio.Event()
        self._stale.set()
        vehicle.on_event.add(self._on_event)

    def again(self) -> None:
        """It may be another now."""
        self.known = False
        self._stale.set()

    async def run(self) -> None:
        """Read until cancelled."""
        while True:
            await self._stale.wait()
            await self._vehicle.found.wait()
            self._stale.clear()
            try:
                await self._read()
            except AutopilotError as error:
                logger.log(self._level, "%s: %s", self._name, error)
                self._stale.set()
                await asyncio.sleep(self._retry_s)
            else:
                self.known = not self._stale.is_set()

    def _on_event(self, event: VehicleEvent) -> None:
        if event in ("found", "rebooted"):
            self.again()
