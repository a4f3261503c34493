"""Streams of the page: one status, read from the companion, for all who look on."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from typing import Final, NoReturn

import msgspec

from companion.errors import CompanionError
from companion.formats import Object
from companion.summary import rows
from companion.web.listener import Connection

logger = logging.getLogger(__name__)

Ask = Callable[[Object], AsyncGenerator[Object, None]]
"""Sends one request of the control socket and yields its replies."""

MAX_VIEWERS: Final = 16
MAX_STRANGERS: Final = 4
"""The most viewers of one address without the token; on the board itself all have the same address."""
MAX_BEHIND: Final = 20
"""Ten seconds of events: a viewer that has so many to read yet is dropped, and begins anew."""
AGAIN_S: Final = 0.5
"""Pause after which a companion that gave no status is asked again."""


class Viewer:
    """One stream of events."""

    def __init__(self, connection: Connection, peer: str, *, has_token: bool) -> None:
        self.connection, self.peer, self.has_token = connection, peer, has_token
        self._events: asyncio.Queue[bytes] = asyncio.Queue(MAX_BEHIND)

    def send(self, event: bytes) -> None:
        """Queue an event; drop the viewer when it reads too slowly."""
        try:
            self._events.put_nowait(event)
        except asyncio.QueueFull:
            self.connection.abort()

    async def events(self) -> AsyncIterator[bytes]:
        """Yield the events."""
        while True:
            yield await self._events.get()


class Viewers:
    """All viewers; `run` it as a task."""

    def __init__(self, ask: Ask, *, local: bool) -> None:
        self._ask, self._local = ask, local
        self._viewers: dict[Viewer, None] = {}
        """The oldest first."""
        self._looked_at = asyncio.Event()

    def __len__(self) -> int:
        return len(self._viewers)

    def refuses(self, viewer: Viewer) -> str | None:
        """Return why there is no room for a viewer, in one line; None: there is. The token makes room."""
        if not viewer.has_token:
            if len(self._viewers) >= MAX_VIEWERS:
                return f"{MAX_VIEWERS} are looking already; the token makes room: companion web-token, on the board"
            alike = sum(other.peer == viewer.peer and not other.has_token for other in self._viewers)
            if not self._local and alike >= MAX_STRANGERS:
                return f"{MAX_STRANGERS} from this address are looking already without the token"
        elif len(self._viewers) >= MAX_VIEWERS:
            strangers = (other for other in self._viewers if not other.has_token)
            oldest = next(strangers, next(iter(self._viewers)))
            del self._viewers[oldest]
            oldest.connection.abort()
        return None

    def add(self, viewer: Viewer) -> None:
        """Let a viewer have every status from now on."""
        self._viewers[viewer] = None
        viewer.connection.keep_open(lambda: self._viewers.pop(viewer, None))
        self._looked_at.set()

    async def refresh(self) -> None:
        """Show the status of now, which an action has changed."""
        with contextlib.suppress(CompanionError):
            await self._show({"command": "status"})

    async def run(self) -> NoReturn:
        """Show the status, twice a second while anybody looks."""
        while True:
            await self._looked_at.wait()
            try:
                await self._show({"command": "monitor"})
            except CompanionError as error:
                logger.debug("no status: %s", error)
            if self._viewers:
                await asyncio.sleep(AGAIN_S)
            else:
                self._looked_at.clear()

    async def _show(self, request: Object) -> None:
        async with contextlib.aclosing(self._ask(request)) as replies:
            async for reply in replies:
                if not self._viewers:
                    return
                if "status" in reply:
                    data = event(_with_rows(reply["status"]))
                    for viewer in tuple(self._viewers):
                        viewer.send(data)


def _with_rows(status: Object) -> Object:
    """Add what the companion is connected to; the first-run set-up has no such rows."""
    return {**status, "rows": rows(status)} if "vehicle" in status else status


def event(value: object, name: str | None = None) -> bytes:
    """Encode a server-sent event."""
    head = f"event: {name}\n".encode() if name else b""
    return head + b"data: " + msgspec.json.encode(value) + b"\n\n"
