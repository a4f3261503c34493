"""Serves the pages over HTTP: read only, on this computer alone or to whoever has the password."""

from __future__ import annotations

import asyncio
import base64
import logging
import secrets
from pathlib import Path
from typing import Any, Final, NoReturn

import sqlalchemy as sa

from companion.config.rules import bind_problem
from companion.errors import ConfigError
from companion.fleet.certificate import Certificate
from companion.fleet.database import engine_of, why
from companion.fleet.rendering import Renderer
from companion.links.system.connection import Backoff, Reconnection
from companion.storage.state import read_regular
from companion.web.access import Access, is_loopback, page_url, split_address
from companion.web.exchange import BadRequestError, Exchange, Request, Response

logger = logging.getLogger(__name__)

MAX_CONNECTIONS: Final = 48
LEAST_PASSWORD: Final = 12
WRONG_PASSWORD_S: Final = 2.0
AGAIN_S: Final = 30
"""After so long a browser looks again."""
SOON_S: Final = 2
"""The same, where there was nothing to be seen."""
CERTIFICATE_S: Final = 60.0
"""How often its files are looked at."""
HANDSHAKE_S: Final = 10.0
_HTML: Final = "text/html; charset=utf-8"
_ALWAYS: Final = (
    ("X-Content-Type-Options", "nosniff"),
    ("X-Frame-Options", "DENY"),
    ("Referrer-Policy", "no-referrer"),
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("Cache-Control", "no-store"),
)


def read_password(path: Path) -> str:
    """The password of a file.

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


class Server:
    """Server of the pages at HOST:PORT, read only; `run` it as a task.

    Raises:
        ConfigError: the address is none, or others could look without a password.
    """

    def __init__(
        self,
        bind: str,
        database: str,
        password: str | None,
        certificate: Certificate | None = None,
    ) -> None:
        if (wrong := bind_problem(bind, "--page")) is not None:
            raise ConfigError(wrong)
        self._host, self._port = split_address(bind)
        if password is None and not is_loopback(self._host):
            raise ConfigError(
                f"--page: found {bind!r}; allowed without --password-file: this computer alone, as 127.0.0.1:8291"
            )
        if certificate is None and not is_loopback(self._host):
            logger.warning("page: whoever listens on the network can read its password: --cert and --key prevent it")
        self._password, self._certificate = password, certificate
        self._access = Access("", handed_out=True)
        self._engine = engine_of(database, reads_only=True)
        self._pages = Renderer(self._engine)
        self._open = 0
        self._reconnection = Reconnection("page", Backoff(first_s=1.0, cap_s=30.0), worth_s=10.0)

    @property
    def url(self) -> str:
        """Where to look."""
        return page_url(self._host, self._port, "http" if self._certificate is None else "https")

    async def run(self) -> NoReturn:
        """Serve until cancelled; an address that is taken is waited for."""
        await self._reconnection.keep(self._serve)

    async def _serve(self) -> str:
        tls: dict[str, Any] = {}
        if self._certificate is not None:
            tls = {"ssl": self._certificate.context}
            tls |= {"ssl_handshake_timeout": HANDSHAKE_S, "ssl_shutdown_timeout": HANDSHAKE_S}
        try:
            server = await asyncio.start_server(self._accept, self._host, self._port, **tls)
        except OSError as error:
            return f"{self._host}:{self._port}: {error.strerror or error}"
        self._port = server.sockets[0].getsockname()[1]
        self._reconnection.up(self.url)
        try:
            while server.is_serving():
                await asyncio.sleep(CERTIFICATE_S)
                if self._certificate is not None:
                    await asyncio.to_thread(self._certificate.look_again)
        finally:
            server.close()
            self._engine.dispose()
        return "closed"

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._open >= MAX_CONNECTIONS:
            writer.transport.abort()
            return
        self._open += 1
        try:
            await self._exchange(Exchange(reader, writer, _ALWAYS))
            writer.close()
            async with asyncio.timeout(10.0):
                await writer.wait_closed()
        except (OSError, TimeoutError):
            pass  # gone, or too slow
        except Exception:
            logger.exception("a request of the page failed")
        finally:
            self._open -= 1
            writer.transport.abort()

    async def _exchange(self, exchange: Exchange) -> None:
        try:
            request = await exchange.request()
        except BadRequestError as error:
            await exchange.respond(_text(error.status, str(error)))
            return
        if request is not None:
            await exchange.respond(await self.respond(request))

    async def respond(self, request: Request) -> Response:
        """The answer to a request."""
        if self._password is None:
            if (refused := self._access.refuses_host(request.headers)) is not None:
                return _text(421, refused)
        elif not self._knows(request):
            if "authorization" in request.headers:
                await asyncio.sleep(WRONG_PASSWORD_S)
            answer = ("WWW-Authenticate", 'Basic realm="companion fleet", charset="UTF-8"')
            return _text(401, "the page needs its password; any user name will do", answer)
        if request.method not in ("GET", "HEAD"):
            return _text(405, "only GET is known here", ("Allow", "GET, HEAD"))
        try:
            found = await self._pages.get(request.path)
        except sa.exc.SQLAlchemyError as error:
            logger.warning("page: the database cannot be read: %s", why(error))
            words = "the database cannot be read at the moment; the collector's log says why"
            return _text(503, words, ("Refresh", str(SOON_S)))
        if found is None:
            return _text(404, "nothing is here")
        again = (("Refresh", str(AGAIN_S)),) if request.path == "/" else ()
        return Response(200, found, _HTML, again)

    def _knows(self, request: Request) -> bool:
        scheme, _, given = request.headers.get("authorization", "").partition(" ")
        try:
            _, _, password = base64.b64decode(given, validate=True).partition(b":")
        except ValueError:
            return False
        return scheme.lower() == "basic" and secrets.compare_digest(password, (self._password or "").encode())


def _text(status: int, words: str, *headers: tuple[str, str]) -> Response:
    return Response(status, f"{words}\n".encode(), "text/plain; charset=utf-8", headers)
