"""The daemon as the MQTT process sees it: a stream of its status and attitude, and its answers to requests."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections.abc import AsyncGenerator, Callable
from typing import Final

from companion.errors import CompanionError, DaemonUnreachableError
from companion.formats import Object

logger = logging.getLogger(__name__)

SILENT_S: Final = 5.0
"""The stream has five replies a second; a daemon without any for this long stands still."""
AGAIN_S: Final = 1.0
ANSWER_WITHIN_S: Final = 10.0
CLOCKS_AGREE_S: Final = 2.0

MONITOR: Final[Object] = {"command": "monitor", "pose": True}
"""Request for the stream, whose first reply holds the status and the last record."""
Ask = Callable[[Object], AsyncGenerator[Object, None]]
"""Sends a request to the control socket and yields the replies."""


class Daemon:
    """Follows the daemon; `follow` runs until cancelled."""

    def __init__(self, ask: Ask) -> None:
        self.ask = ask
        self.status: Object | None = None
        """The latest status; None before the first."""
        self.pose: Object | None = None
        self.record: Object | None = None
        """The last calibration's record."""
        self.alive = False
        """True while replies come."""
        self.news = asyncio.Event()
        """Set at every reply, and when the stream ends."""
        self.clock_agrees = False
        """True if the autopilot's GNSS time confirms the clock of this computer."""

    @property
    def vehicle(self) -> Object:
        """The vehicle's part of the status; empty before the first."""
        vehicle: Object = {} if self.status is None else self.status["vehicle"]
        return vehicle

    async def follow(self) -> None:
        """Read the stream of states, again after every loss."""
        while True:
            try:
                await self._read()
            except (CompanionError, TimeoutError) as error:
                if self.alive:
                    logger.warning("mqtt: the daemon gives no state: %s", str(error) or "it is silent")
            self.alive, self.pose = False, None
            self.news.set()
            await asyncio.sleep(AGAIN_S)

    async def _read(self) -> None:
        async with contextlib.aclosing(self.ask(MONITOR)) as replies:
            while True:
                async with asyncio.timeout(SILENT_S):
                    reply = await anext(replies, None)
                self._accept(reply)

    async def refresh(self) -> None:
        """Read the status and the last record now; keep the old ones where no answer comes."""
        # Not asyncio.timeout, which cannot expire in a cancelled task before Python 3.11.4: the end reads here.
        reading = asyncio.ensure_future(self._read_once())
        try:
            await asyncio.wait([reading], timeout=SILENT_S)
        finally:
            reading.cancel()

    async def _read_once(self) -> None:
        with contextlib.suppress(CompanionError):
            async with contextlib.aclosing(self.ask(MONITOR)) as replies:
                self._accept(await anext(replies, None))

    def _accept(self, reply: Object | None) -> None:
        if reply is None or reply["kind"] == "error":
            raise DaemonUnreachableError("the stream has ended" if reply is None else str(reply["reason"]))
        self.alive, self.pose = True, reply["pose"]
        self.record = reply.get("record", self.record)
        if "status" in reply:
            self.status = reply["status"]
            unix_s = self.vehicle["unix_time_s"]
            self.clock_agrees = unix_s is not None and abs(unix_s - time.time()) < CLOCKS_AGREE_S
        self.news.set()

    async def result(self, request: Object) -> Object:
        """Return the final reply to a short request.

        Raises:
            CompanionError: the daemon refuses, is gone, or gives no answer within 10 s.
        """
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(ANSWER_WITHIN_S), contextlib.aclosing(self.ask(request)) as replies:
                async for reply in replies:
                    if reply["kind"] == "error":
                        raise CompanionError(str(reply["reason"]))
                    if reply["kind"] == "result":
                        return reply
        raise DaemonUnreachableError("the daemon gives no answer")
