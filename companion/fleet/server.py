"""The pages over HTTP: read only, for this computer alone or for clients with the password."""

from __future__ import annotations

import asyncio
import base64
import datetime
import logging
import re
import secrets
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final, NoReturn

import sqlalchemy as sa
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from companion.config.rules import bind_problem
from companion.errors import ConfigError
from companion.fleet import page
from companion.fleet.database import engine_of, why
from companion.links.system.connection import Backoff, Reconnection
from companion.storage.state import read_regular
from companion.web.access import Access, is_loopback, page_url, split_address
from companion.web.listener import listening

logger = logging.getLogger(__name__)

LEAST_PASSWORD: Final = 12
WRONG_PASSWORD_S: Final = 2.0
AGAIN_S: Final = 30
"""Period after which a browser loads the first page again."""
SOON_S: Final = 2
"""Period after which a browser tries again when the database could not be read."""
FRESH_S: Final = 2.0
"""Time for which a rendered page is given to further clients."""
_GLANCE: Final = re.compile(r"/(?:page/([1-9][0-9]{0,6}))?")
_AIRCRAFT: Final = re.compile(r"/aircraft/([0-9a-f]{16,36})")
_HEADERS: Final = (
    ("X-Content-Type-Options", "nosniff"),
    ("X-Frame-Options", "DENY"),
    ("Referrer-Policy", "no-referrer"),
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("Cache-Control", "no-store"),
)


def read_password(path: Path) -> str:
    """Read the password from a file.

    Raises:
        ConfigError: it cannot be read, or is too short.
    """
    try:
        found = read_regular(path, 4096).decode().strip()
    except (OSError, UnicodeDecodeError) as error:
        words = error.strerror if isinstance(error, OSError) else "not a text"
        raise ConfigError(f"{path}: cannot be read: {words}") from None
    if len(found) < LEAST_PASSWORD:
        raise ConfigError(f"{path}: found a password of {len(found)} characters; allowed: at least {LEAST_PASSWORD}")
    return found


class Renderer:
    """Pages of one database.

    Rendering is work for the processor: at once, 20 of them would take 20 times as long each, and as much memory.
    """

    def __init__(self, engine: sa.Engine) -> None:
        self._engine = engine
        self._thread = ThreadPoolExecutor(1, "fleet-pages")
        self._pages: dict[str, asyncio.Task[bytes | None]] = {}

    async def get(self, path: str) -> bytes | None:
        """Return a page that is at most `FRESH_S` old, or render it; None: there is none.

        Raises:
            SQLAlchemyError: the database cannot be read.
        """
        if (task := self._pages.get(path)) is None:
            task = self._pages[path] = asyncio.create_task(self._render(path), name=f"fleet page {path}")
        # A client that disconnects does not cancel the rendering for the others.
        return await asyncio.shield(task)

    async def _render(self, path: str) -> bytes | None:
        loop = asyncio.get_running_loop()
        keep_s = 0.0
        try:
            found = await loop.run_in_executor(self._thread, self._rendered, path)
            keep_s = 0.0 if found is None else FRESH_S
            return found
        finally:
            loop.call_later(keep_s, self._pages.pop, path, None)

    def _rendered(self, path: str) -> bytes | None:
        with self._engine.begin() as connection:
            found = _page_at(connection, path, datetime.datetime.now(tz=datetime.UTC))
        return None if found is None else found.encode()


def _page_at(connection: sa.Connection, path: str, now: datetime.datetime) -> str | None:
    if (match := _GLANCE.fullmatch(path)) is not None:
        return page.glance(connection, now, int(match[1] or 1))
    if (match := _AIRCRAFT.fullmatch(path)) is not None:
        return page.aircraft(connection, match[1], now)
    return None


class Server:
    """Server of the pages at HOST:PORT, read only; `run` it as a task.

    Raises:
        ConfigError: the address is none, or others could look without a password.
    """

    def __init__(self, bind: str, database: str, password: str | None) -> None:
        if (wrong := bind_problem(bind, "--page")) is not None:
            raise ConfigError(wrong)
        self._host, self._port = split_address(bind)
        if password is None and not is_loopback(self._host):
            raise ConfigError(
                f"--page: found {bind!r}; allowed without --password-file: this computer alone, as 127.0.0.1:8291"
            )
        if not is_loopback(self._host):
            logger.warning(
                "page: whoever listens on the network can read its password: put a proxy with https before it"
            )
        self._engine = engine_of(database, reads_only=True)
        self._pages = Renderer(self._engine)
        self._app = Starlette(
            routes=[Route("/{path:path}", self._page)], middleware=[Middleware(_Door, password=password)]
        )
        self._reconnection = Reconnection("page", Backoff(first_s=1.0, cap_s=30.0), worth_s=10.0)

    @property
    def url(self) -> str:
        """Address for a browser."""
        return page_url(self._host, self._port)

    async def run(self) -> NoReturn:
        """Serve until cancelled; an address that is taken is waited for."""
        await self._reconnection.keep(self._serve)

    async def _serve(self) -> str:
        try:
            async with listening(self._app, self._host, self._port, _HEADERS) as self._port:
                self._reconnection.up(self.url)
                never: asyncio.Future[str] = asyncio.get_running_loop().create_future()
                return await never
        except OSError as error:
            return f"{self._host}:{self._port}: {error.strerror or error}"
        finally:
            self._engine.dispose()

    async def _page(self, request: Request) -> Response:
        try:
            found = await self._pages.get(request.url.path)
        except sa.exc.SQLAlchemyError as error:
            logger.warning("page: the database cannot be read: %s", why(error))
            words = "the database cannot be read at the moment; the collector's log says why"
            return _text(503, words, {"Refresh": str(SOON_S)})
        if found is None:
            return _text(404, "nothing is here")
        again = {"Refresh": str(AGAIN_S)} if request.url.path == "/" else None
        return Response(found, headers=again, media_type="text/html")


class _Door:
    """Admits requests with the password; without one, those for this computer's own name."""

    def __init__(self, app: ASGIApp, password: str | None) -> None:
        self._app, self._password = app, password
        self._access = Access("", handed_out=True)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers, app = Headers(scope=scope), self._app
        if self._password is None:
            if (refused := self._access.refuses_host(headers)) is not None:
                app = _text(421, refused)
        elif not _knows(headers.get("authorization", ""), self._password):
            if "authorization" in headers:
                await asyncio.sleep(WRONG_PASSWORD_S)
            answer = {"WWW-Authenticate": 'Basic realm="companion fleet", charset="UTF-8"'}
            app = _text(401, "the page needs its password; any user name will do", answer)
        await app(scope, receive, send)


def _knows(authorization: str, password: str) -> bool:
    scheme, _, given = authorization.partition(" ")
    try:
        _, _, found = base64.b64decode(given, validate=True).partition(b":")
    except ValueError:
        return False
    return scheme.lower() == "basic" and secrets.compare_digest(found, password.encode())


def _text(status: int, words: str, headers: Mapping[str, str] | None = None) -> Response:
    return PlainTextResponse(f"{words}\n", status, headers)
