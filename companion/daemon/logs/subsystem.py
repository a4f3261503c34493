"""Logs are fetched while the aircraft is disarmed, for as long as somebody waits; no job: calibrations go first."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.vehicle.vehicle import VehicleEvent
from companion.daemon.calibrating.subsystem import Calibrating
from companion.daemon.core import Core, Handler, Subsystem
from companion.errors import AutopilotError, NotDisarmedError
from companion.formats import Object
from companion.links.system.waiting import comes

HEARD_WITHIN_S: Final = 5.0
ENDS_WITHIN_S: Final = 3.0
"""A fetch that nobody waits for any more ends at its next word; who asks anew at once, after Ctrl-C, waits for that."""


class Logs(Subsystem):
    """`companion flight --fetch`."""

    def __init__(self, core: Core, calibrating: Calibrating) -> None:
        self._core, self._calibrating = core, calibrating
        self._one_at_a_time = asyncio.Lock()

    def commands(self) -> Mapping[str, Handler]:  # noqa: D102 - as in the base class
        return {"fetch": self._fetch}

    async def _fetch(self, request: Object, _face: str) -> AsyncIterator[Object]:
        wanted = request.get("log")
        if not (wanted is None or isinstance(wanted, str)):
            raise AutopilotError(f"fetch: 'log': found {wanted!r}; allowed: the name or number of a log")
        try:
            async with asyncio.timeout(ENDS_WITHIN_S):
                await self._one_at_a_time.acquire()
        except TimeoutError:
            raise AutopilotError("a log is being fetched already") from None
        try:
            await self._must_be_grounded()
            # Nobody's start waits for what is needed once a flight.
            from companion.autopilot.logs.ftp import FileClient
            from companion.daemon.logs.transfer import PROGRESS_EVERY_S, Transfer

            files = FileClient(self._core.link, self._core.vehicle)
            transfer = Transfer(self._core, self._calibrating.conductor, files)
            running = asyncio.create_task(transfer.run(wanted), name="fetch a log")

            def stop(event: VehicleEvent) -> None:
                if event == "armed":
                    running.cancel()

            ignore = self._core.vehicle.on_event.add(stop)
            try:
                while not (await asyncio.wait([running], timeout=PROGRESS_EVERY_S))[0]:
                    yield {
                        "kind": "progress", "state": "fetching", "percent": transfer.percent, "text": transfer.words(),
                    }  # fmt: skip
                if running.cancelled():
                    raise NotDisarmedError(f"the aircraft was armed: {transfer.stopped()}")
                path = str(running.result())
                yield {"kind": "result", "state": "done", "reason": "", "file": path, "bytes": transfer.size}
            finally:
                ignore()
                running.cancel()
                await asyncio.gather(running, return_exceptions=True)
                files.close()
        finally:
            self._one_at_a_time.release()

    async def _must_be_grounded(self) -> None:
        vehicle = self._core.vehicle
        await comes(vehicle.found, HEARD_WITHIN_S)  # the daemon may have started just now
        if (why := vehicle.arm_state.why_not_written) is not None:
            raise NotDisarmedError(f"{why}: logs are fetched on the ground, disarmed")
        if vehicle.capabilities is not None and not vehicle.capabilities & mavlink.MAV_PROTOCOL_CAPABILITY_FTP:
            raise AutopilotError(
                "this autopilot has no MAVLink FTP: take the log from its card, then companion flight LOG"
            )
