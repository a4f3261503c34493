"""The page's server: one static page, the state as server-sent events, the last records, and three actions.

It holds no state but who looks. Everything is bounded, and whatever goes wrong here ends here: the daemon's work is
not to notice that anybody looks at it.
"""

from __future__ import annotations

import asyncio
import hashlib
import logging
import re
import socket
import urllib.parse
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any, Final, NamedTuple, NoReturn

import msgspec

from companion import __version__
from companion.errors import CompanionError
from companion.formats import Object, parse_request
from companion.links.system.connection import Backoff, Reconnection
from companion.links.system.waiting import comes
from companion.web.access import (
    TOKEN_HEADER,
    Access,
    is_loopback,
    kept_token,
    new_token,
    page_url,
    split_address,
)
from companion.web.document import assembled, security_headers
from companion.web.exchange import BadRequestError, Exchange, Request, Response

logger = logging.getLogger(__name__)

Answer = Callable[[Object, str], AsyncIterator[Object]]
"""A request as on the control socket, and which face it came by: its replies."""
Offload = Callable[..., Awaitable[Any]]

EVERY_S: Final = 0.5
LEAST_S: Final = 0.1
"""Between two events, whatever wakes them."""
MAX_CONNECTIONS: Final = 48
MAX_VIEWERS: Final = 16
MAX_STRANGERS: Final = 4
"""The most viewers of one address without the token; on the board itself all have the same address."""
WRONG_TOKEN_S: Final = 2.0
"""How long the answer to a wrong token is held back."""
MAX_WAITING: Final = 16
"""The most answers to wrong tokens that are held back at a time."""
MAX_WAITING_BYTES: Final = 128 * 1024
"""For one viewer, beyond what the kernel holds: ten seconds of events. Who is further behind begins anew."""
KERNEL_BYTES: Final = 64 * 1024
UNHEARD_MS: Final = 10_000
"""How long the kernel waits for a viewer who acknowledges nothing: gone out of range, or asleep."""
ACTION_WITHIN_S: Final = 10.0
WORTH_S: Final = 10.0
"""A page that was there for so long is tried again at once."""
RECORDS: Final = 10
FACE: Final = "the page's"
"""How the page is named as a sender, as in "cancelled by the page's cancel"."""


class _Viewer(NamedTuple):
    peer: str
    has_token: bool


class Page:
    """Serves the page at HOST:PORT; `run` it as a task of its own.

    The token is kept in the storage when others than this board can reach it.
    """

    def __init__(
        self,
        bind: str,
        directory: Path,
        answer: Answer,
        status: Callable[[], Awaitable[Object]],
        offload: Offload,
    ) -> None:
        self._host, self._port = split_address(bind)
        self._directory, self._answer, self._status, self._offload = directory, answer, status, offload
        self.local = is_loopback(self._host)
        self.access = Access(new_token(), handed_out=self.local)
        self.problem: str | None = "not open yet"
        """Why nobody can look, in one line; None while the page is there."""
        html = assembled()
        self._html, self._tag = html, hashlib.sha256(html).hexdigest()[:16]
        self._always = security_headers(html)
        self._clients: set[asyncio.Task[None]] = set()
        self._brief: dict[asyncio.Task[None], None] = {}
        """Those of them that do not look on, the oldest first."""
        self._viewers: dict[Exchange, _Viewer] = {}
        """The oldest first."""
        self._wrong_tokens = self._waiting = 0
        self._wake = asyncio.Event()
        self._reconnection = Reconnection(
            "page", Backoff(first_s=1.0, cap_s=30.0), worth_s=WORTH_S, on_state=self._on_state
        )

    # --- open, and open again

    async def run(self) -> None:
        """Serve until cancelled; an address that is not there yet is waited for."""
        await self._reconnection.keep(self._serve)

    async def _serve(self) -> str:
        server: asyncio.Server | None = None
        try:
            if not self.local:
                self.access = Access(await self._offload(kept_token, self._directory), handed_out=False)
            server = await asyncio.start_server(self._accept, self._host, self._port, limit=KERNEL_BYTES)
            self._port = server.sockets[0].getsockname()[1]
            self._reconnection.up(self.url)
            await self._broadcast()
        except (OSError, CompanionError) as error:
            words = (error.strerror or str(error)) if isinstance(error, OSError) else str(error)
            return f"{self._host}:{self._port}: {words}"
        except Exception:
            logger.exception("the page met a fault of the program")
            return "internal error; the log has the details"
        finally:
            if server is not None:
                server.close()
            for client in list(self._clients):
                client.cancel()
            await asyncio.gather(*self._clients, return_exceptions=True)

    def _on_state(self, there: bool, words: str) -> None:  # noqa: FBT001 - Reconnection's own signature
        self.problem = None if there else words

    @property
    def url(self) -> str:
        """Where to look."""
        return page_url(self._host, self._port)

    def status(self) -> Object:
        """For `companion status`."""
        return {
            "good": self.problem is None,
            "summary": self.problem or self.url + ("" if self.local else " (buttons: companion web-token)"),
            "url": None if self.problem else self.url,
            "viewers": len(self._viewers),
            "wrong_tokens": self._wrong_tokens,
        }

    # --- one connection

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._clients) >= MAX_CONNECTIONS:
            # Whoever presses a button is done in a moment; who is here for longest says nothing, or hears nothing.
            oldest = next(iter(self._brief), None)
            if oldest is None:
                writer.transport.abort()
                return
            oldest.cancel()
            self._forget(oldest)
        client = asyncio.get_running_loop().create_task(self._connection(reader, writer), name="page client")
        self._clients.add(client)
        self._brief[client] = None
        client.add_done_callback(self._forget)
        # Not a `finally` of the task: one that is cancelled before its first step reaches none.
        client.add_done_callback(lambda _: writer.transport.abort())

    def _forget(self, client: asyncio.Task[None]) -> None:
        self._clients.discard(client)
        self._brief.pop(client, None)

    async def _connection(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        connection = writer.get_extra_info("socket")
        try:
            if connection is not None:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, KERNEL_BYTES)
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, UNHEARD_MS)
            await self._exchange(Exchange(reader, writer, self._always))
            writer.close()
            async with asyncio.timeout(UNHEARD_MS / 1000):
                await writer.wait_closed()
        except (OSError, TimeoutError):
            pass  # gone, or too slow; what was asked for goes on
        except Exception:
            logger.exception("a request of the page failed")

    async def _exchange(self, exchange: Exchange) -> None:
        try:
            request = await exchange.request()
        except BadRequestError as error:
            await exchange.respond(_refusal(error.status, str(error)))
            return
        if request is None:
            return
        response = await self.respond(request)
        if response is None:
            await self._view(exchange, self._viewer(request))
        else:
            await exchange.respond(response)

    # --- what is asked

    async def respond(self, request: Request) -> Response | None:
        """The answer to a request; None: the stream of events."""
        if (why := self.access.refuses_host(request.headers)) is not None:
            return _refusal(421, why)
        if request.path in _ACTIONS:
            if request.method != "POST":
                return _refusal(405, "an action is a POST", ("Allow", "POST"))
            return await self._act(request)
        if request.method != "GET":
            return _refusal(405, "only GET is known here", ("Allow", "GET"))
        if request.path == "/":
            return Response(200, self._html, "text/html; charset=utf-8")
        if (why := self.access.refuses_stranger(request.headers)) is not None:
            return _refusal(403, why)
        if request.path == "/events":
            return await self._refuse_viewer(request)
        if request.path == "/records.json":
            found = await self._records()
            return _json(200, {"records": [{"file": file_name(record), "record": record} for record in found]})
        if request.path == "/temperature.html":
            return await self._temperature()
        if (match := _RECORD.fullmatch(request.path)) is not None:
            return await self._record(match[1])
        return _refusal(404, "nothing is here")

    async def _act(self, request: Request) -> Response:
        if (why := self.access.refuses_stranger(request.headers)) is not None:
            return _refusal(403, why)
        if (why := self.access.refuses_token(request.headers)) is not None:
            if not self.local and request.headers.get(TOKEN_HEADER):
                await self._wait_after_guess(request.peer)
            return _refusal(403, why)
        if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
            return _refusal(415, "an action is asked for in application/json")
        try:
            wanted = parse_request(request.body or b"{}")
        except ValueError as error:
            return _refusal(400, f"not a JSON object: {error}")
        asked: Object = {"command": request.path.removeprefix("/")} | _ALWAYS.get(request.path, {})
        asked |= {key: wanted[key] for key in _ACTIONS[request.path] if key in wanted}
        try:
            reply = await self._result(asked)
        except CompanionError as error:
            return _refusal(409, str(error))
        finally:
            self._wake.set()
        if reply.get("kind") == "error":
            return _refusal(409, str(reply["reason"]))
        return _json(200, {key: value for key, value in reply.items() if key != "kind"})

    async def _wait_after_guess(self, peer: str) -> None:
        """Answers that wait hold connections: beyond some, the others are not to suffer for it."""
        self._wrong_tokens += 1
        logger.warning("page: wrong token from %s", peer)
        if self._waiting < MAX_WAITING:
            self._waiting += 1
            try:
                await asyncio.sleep(WRONG_TOKEN_S)
            finally:
                self._waiting -= 1

    async def _result(self, asked: Object) -> Object:
        """The last reply; an action that takes longer than a person waits goes on, and the events tell of it."""
        try:
            async with asyncio.timeout(ACTION_WITHIN_S):
                async for reply in self._answer(asked, FACE):
                    if reply.get("kind") in ("result", "error"):
                        return reply
        except TimeoutError:
            pass
        return {"kind": "result", "reason": "under way"}

    async def _records(self) -> list[Object]:
        reply = await self._result({"command": "history", "limit": RECORDS})
        records: list[Object] = reply.get("records", [])
        return records

    async def _record(self, name: str) -> Response:
        for record in await self._records():
            if file_name(record) == name:
                body = msgspec.json.format(msgspec.json.encode(record), indent=1)
                return Response(200, body, headers=(("Content-Disposition", f'attachment; filename="{name}"'),))
        return _refusal(404, f"not among the last {RECORDS} records")

    async def _temperature(self) -> Response:
        reply = await self._result({"command": "temperature"})
        return Response(200, await self._offload(_plots, reply.get("imus", [])), "text/html; charset=utf-8")

    # --- those who look

    def _viewer(self, request: Request) -> _Viewer:
        # A browser's EventSource sends no header of ours.
        (token, *_) = urllib.parse.parse_qs(request.query).get("token", [""])
        return _Viewer(request.peer, self.access.refuses_token({TOKEN_HEADER: token}) is None)

    async def _refuse_viewer(self, request: Request) -> Response | None:
        """Refuse one more viewer where there is no room; None: there is, if need be after the oldest has made way."""
        viewer, viewers = self._viewer(request), self._viewers
        if viewer.has_token:
            if len(viewers) >= MAX_VIEWERS:
                oldest = next((each for each, other in viewers.items() if not other.has_token), next(iter(viewers)))
                del viewers[oldest]
                oldest.writer.transport.abort()
            return None
        if len(viewers) >= MAX_VIEWERS:
            reason = f"{MAX_VIEWERS} are looking already; the token makes room: companion web-token, on the board"
        elif not self.local and list(viewers.values()).count(viewer) >= MAX_STRANGERS:
            reason = f"{MAX_STRANGERS} from this address are looking already without the token"
        else:
            return None
        if not self.local and "token=" in request.query:
            await self._wait_after_guess(request.peer)
        return _refusal(503, reason)

    async def _view(self, exchange: Exchange, viewer: _Viewer) -> None:
        exchange.begin_stream("text/event-stream")
        token = self.access.token if self.access.handed_out else None
        exchange.send(_event({"version": __version__, "page": self._tag, "token": token}, "hello"))
        if not self._viewers:
            self._wake.set()
        self._viewers[exchange] = viewer
        if (client := asyncio.current_task()) is not None:
            self._brief.pop(client, None)
        try:
            await exchange.left()
        finally:
            self._viewers.pop(exchange, None)

    async def _broadcast(self) -> NoReturn:
        while True:
            if not self._viewers:
                await self._wake.wait()
            self._wake.clear()
            try:
                event = _event(await self._status())
            except Exception:
                logger.exception("the page has no state to show")
            else:
                for viewer in tuple(self._viewers):
                    self._send(viewer, event)
            await asyncio.sleep(LEAST_S)
            await comes(self._wake, EVERY_S - LEAST_S)

    def _send(self, viewer: Exchange, event: bytes) -> None:
        transport = viewer.writer.transport
        if transport.is_closing():
            return
        if transport.get_write_buffer_size() > MAX_WAITING_BYTES:
            transport.abort()
            return
        viewer.send(event)


_ACTIONS: Final[dict[str, tuple[str, ...]]] = {
    "/calibrate": ("what",),
    "/align": ("action", "headings", "write", "level"),
    "/cancel": (),
    "/undo": ("force",),
    "/answer": ("number", "words"),
}
"""By path, what of the body counts."""
_ALWAYS: Final[dict[str, Object]] = {"/align": {"wait": False}}
_RECORD: Final = re.compile(r"/records/([\w.-]{1,80})")


def file_name(record: Object) -> str:
    """Under which a record is downloaded: its time, without what file systems dislike."""
    return f"companion-{re.sub(r'[^0-9T]+', '-', str(record.get('started_at')))}.json"


def _plots(imus: object) -> bytes:
    from companion.calibration.solution.by_temperature import ByTemperature
    from companion.report.by_temperature import biases_by_temperature

    return biases_by_temperature(msgspec.convert(imus, list[ByTemperature])).encode()


def _event(value: Object, name: str | None = None) -> bytes:
    head = f"event: {name}\n".encode() if name else b""
    return head + b"data: " + msgspec.json.encode(value) + b"\n\n"


def _json(status: int, value: Object) -> Response:
    return Response(status, msgspec.json.encode(value))


def _refusal(status: int, reason: str, *headers: tuple[str, str]) -> Response:
    return Response(status, msgspec.json.encode({"reason": reason}), headers=headers)
