"""HTTP server for one web application at one address, on uvicorn: for the web page and for the fleet pages.

A connection carries one request, and ends with the answer or after 20 s. If 48 connections are open, a new one replaces
the oldest. Event streams are exempt from both limits: the application limits their number.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator, Callable
from typing import Final

from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.config import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

HEADERS: Final = (
    ("X-Content-Type-Options", "nosniff"),
    ("X-Frame-Options", "DENY"),
    ("Referrer-Policy", "no-referrer"),
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("Cache-Control", "no-store"),
)

ANSWERED_WITHIN_S: Final = 20.0
"""Timeout of an HTTP connection, for request, work and answer together; an action takes at most 10 s."""
MAX_CONNECTIONS: Final = 48
MAX_HEAD_BYTES: Final = 8192
MAX_BODY_BYTES: Final = 4096
KERNEL_BYTES: Final = 64 * 1024
UNHEARD_MS: Final = 10_000
"""TCP_USER_TIMEOUT: the kernel closes the connection of a client that acknowledges no data for this time."""


class Connection(H11Protocol):
    """HTTP connection of one client; request handlers find the connection as `request.state.connection`."""

    def __init__(self, config: Config, state: ServerState, unanswered: dict[Connection, None]) -> None:
        super().__init__(config, state, {"connection": self})
        self._unanswered = unanswered
        self._deadline: asyncio.TimerHandle | None = None
        self._on_lost: Callable[[], object] | None = None
        self._lost = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as in H11Protocol
        super().connection_made(transport)
        endpoint = transport.get_extra_info("socket")
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, KERNEL_BYTES)
        endpoint.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, UNHEARD_MS)
        if len(self._unanswered) >= MAX_CONNECTIONS:
            next(iter(self._unanswered)).abort()
        self._unanswered[self] = None
        self._deadline = self.loop.call_later(ANSWERED_WITHIN_S, self.abort)

    def connection_lost(self, exc: Exception | None) -> None:
        self._exempt()
        self._lost = True
        super().connection_lost(exc)
        if self._on_lost is not None:
            self._on_lost()

    def keep_open(self, on_lost: Callable[[], object]) -> None:
        self._exempt()
        if self._lost:
            on_lost()
        else:
            self._on_lost = on_lost

    def abort(self) -> None:
        self._exempt()
        self.transport.abort()

    def _exempt(self) -> None:
        self._unanswered.pop(self, None)
        if self._deadline is not None:
            self._deadline.cancel()


@contextlib.asynccontextmanager
async def listening(app: ASGIApp, host: str, port: int, *more: tuple[str, str]) -> AsyncIterator[int]:
    """Serve a web application while the context is open, with `more` headers on every answer; yield the port.

    Raises:
        OSError: the address cannot be used.
    """
    config = Config(
        _guarded(app),
        http=Connection,
        ws="none",
        lifespan="off",
        interface="asgi3",
        log_config=None,
        # Log no warnings: clients could fill the log with them.
        log_level="error",
        access_log=False,
        proxy_headers=False,
        server_header=False,
        headers=[("Connection", "close"), *HEADERS, *more],
        h11_max_incomplete_event_size=MAX_HEAD_BYTES,
    )
    config.load()
    state, unanswered = ServerState(), dict[Connection, None]()
    state.default_headers = config.encoded_headers
    # Do not use uvicorn.Server: it replaces the signal handlers, ends the process if the address is in use, and wakes
    # up ten times a second.
    loop = asyncio.get_running_loop()
    server = await loop.create_server(lambda: Connection(config, state, unanswered), host, port)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
        for connection in list(state.connections):
            connection.transport.abort()
        await asyncio.sleep(0)
        for task in list(state.tasks):
            task.cancel()
        await asyncio.gather(*state.tasks, return_exceptions=True)


def _guarded(app: ASGIApp) -> ASGIApp:
    """Wrap an application to handle cancellation and lack of memory: uvicorn would log both as faults and continue."""

    async def guarded(scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await app(scope, receive, send)
        except asyncio.CancelledError:
            pass  # the server is closing
        except MemoryError as error:
            # A child process ends itself on this error (companion.links.system.process).
            asyncio.get_running_loop().call_exception_handler({"message": "out of memory", "exception": error})

    return guarded
