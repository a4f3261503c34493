"""What the faces are answered: each command by the subsystem whose it is, and the status by all of them together."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Sequence
from typing import Final

from companion.daemon.core import Handler, Subsystem, joined
from companion.daemon.heading.subsystem import PoseNow
from companion.links.system.request import Object

MONITOR_EVERY_S: Final = 0.5


class Answers:
    """The one door for people's requests, whatever face they come by."""

    def __init__(self, subsystems: Sequence[Subsystem], pose: PoseNow) -> None:
        self._subsystems, self._pose = subsystems, pose
        self._handlers: dict[str, Handler] = {"status": self._status, "monitor": self._monitor}
        for subsystem in subsystems:
            self._handlers |= subsystem.commands()

    async def answer(self, request: Object, face: str = "companion") -> AsyncIterator[Object]:
        """Answer one request of the control socket, or of another face that speaks its words.

        Raises:
            CompanionError: it is not taken, and why, or it could not be carried out.
        """
        command = request.get("command")
        handler = self._handlers.get(command) if isinstance(command, str) else None
        if handler is None:
            yield {"kind": "error", "reason": f"unknown command {command!r}"}
            return
        async for reply in handler(request, face):
            yield reply

    async def _status(self, _request: Object, _face: str) -> AsyncIterator[Object]:
        yield {"kind": "result", "status": await self.look()}

    async def _monitor(self, _request: Object, _face: str) -> AsyncIterator[Object]:
        while True:
            yield {"kind": "progress", "status": await self.look()}
            await asyncio.sleep(MONITOR_EVERY_S)

    async def look(self) -> Object:
        """`status`, with the declination of the place looked up when it is time to."""
        await self._pose.look()
        return self.status()

    def status(self) -> Object:
        """What the daemon is doing, as JSON can hold it."""
        return joined([subsystem.status() for subsystem in self._subsystems])
