"""HTTP server of the fleet's pages, read only: for this computer alone, or for clients that send the password."""

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
from companion.fleet.schema import engine_of, why
from companion.links.system.connection import Reconnection
from companion.storage.state import read_regular
from companion.web.access import Access, is_loopback, page_url, split_address
from companion.web.listener import listening

logger = logging.getLogger(__name__)

LEAST_PASSWORD: Final = 12
WRONG_PASSWORD_S: Final = 2.0
AGAIN_S: Final = 30
SOON_S: Final = 2  # Time after which a browser reloads the page if the database could not be read
_AIRCRAFT: Final = re.compile(r"/aircraft/([0-9a-f]{16,36})")


def read_password(path: Path) -> str:
    """Read the password of the fleet's pages from a file.

    Raises:
        ConfigError: the file cannot be read, or the password is too short.
    """
    try:
        found = read_regular(path, 4096).decode().strip()
    except (OSError, UnicodeDecodeError) as error:
        words = error.strerror if isinstance(error, OSError) else "not a text"
        raise ConfigError(f"{path}: cannot be read: {words}") from None
    if len(found) < LEAST_PASSWORD:
        raise ConfigError(f"{path}: found a password of {len(found)} characters; allowed: at least {LEAST_PASSWORD}")
    return found


class Server:
    """HTTP server of the fleet's pages at HOST:PORT, read only; start `run` as a task.

    Raises:
        ConfigError: the address is invalid, or other computers could read the pages without a password.
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
        # One thread: rendering is bound by the processor, so 20 pages at once would each take 20 times as long.
        self._thread = ThreadPoolExecutor(1, "fleet-pages")
        self._app = Starlette(
            routes=[Route("/{path:path}", self._page)], middleware=[Middleware(_PasswordFilter, password=password)]
        )
        self._reconnection = Reconnection("page", worth_s=10.0, first_s=1.0, cap_s=30.0)

    @property
    def url(self) -> str:
        return page_url(self._host, self._port)

    async def run(self) -> NoReturn:
        await self._reconnection.keep(self._serve)

    async def _serve(self) -> str:
        try:
            async with listening(self._app, self._host, self._port) as self._port:
                self._reconnection.up(self.url)
                never: asyncio.Future[str] = asyncio.get_running_loop().create_future()
                return await never
        except OSError as error:
            return f"{self._host}:{self._port}: {error.strerror or error}"
        finally:
            self._engine.dispose()

    def _rendered(self, path: str) -> str | None:
        match, now = _AIRCRAFT.fullmatch(path), datetime.datetime.now(tz=datetime.UTC)
        with self._engine.begin() as connection:
            if path == "/":
                return page.glance(connection, now)
            return None if match is None else page.aircraft(connection, match[1], now)

    async def _page(self, request: Request) -> Response:
        try:
            found = await asyncio.get_running_loop().run_in_executor(self._thread, self._rendered, request.url.path)
        except sa.exc.SQLAlchemyError as error:
            logger.warning("page: the database cannot be read: %s", why(error))
            words = "the database cannot be read at the moment; the collector's log says why"
            return _text(503, words, {"Refresh": str(SOON_S)})
        if found is None:
            return _text(404, "nothing is here")
        again = {"Refresh": str(AGAIN_S)} if request.url.path == "/" else None
        return Response(found, headers=again, media_type="text/html")


class _PasswordFilter:
    """HTTP filter: admits requests with the password or, if none is set, requests addressed to this computer."""

    def __init__(self, app: ASGIApp, password: str | None) -> None:
        self._app, self._password = app, password
        self._access = Access("", handed_out=True)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        headers, app = Headers(scope=scope), self._app
        if self._password is None:
            if (refused := self._access.host_refusal(headers)) is not None:
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
