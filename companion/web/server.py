"""Server of the web page: its HTTP routes, the event streams to its viewers, and its status."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import logging
import re
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from pathlib import Path
from typing import Final, NoReturn

import msgspec
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from companion import __version__
from companion.commands import Interface, commands_for
from companion.errors import CompanionError, StorageError
from companion.formats import Object, parse_request
from companion.links.system.connection import Reconnection
from companion.summary import rows
from companion.web.access import TOKEN_HEADER, Access, is_loopback, new_token, page_url, split_address, stored_token
from companion.web.listener import MAX_BODY_BYTES, Connection, listening

logger = logging.getLogger(__name__)

Ask = Callable[[Object], AsyncGenerator[Object, None]]

WORTH_S: Final = 10.0  # Time for which the page must be open to reset the backoff of its next opening
WRONG_TOKEN_S: Final = 2.0
MAX_WAITING: Final = 16
"""Maximum number of answers to wrong tokens that are delayed at the same time: each occupies a connection."""
ACTION_WITHIN_S: Final = 10.0
RECORDS: Final = 10
MAX_VIEWERS: Final = 16
MAX_STRANGERS: Final = 4
"""Maximum number of viewers without the token per address; no limit if only the board itself can connect."""
MAX_BEHIND: Final = 20
"""Maximum number of events that wait for a slow viewer (10 s). A slower viewer is disconnected, and reconnects."""
AGAIN_S: Final = 0.5  # Pause before the status is requested again after a failure
ACTIONS: Final = commands_for(Interface.PAGE)
_PARTS: Final = Path(__file__).with_name("page")
_STYLE: Final = re.compile(rb'<link rel="stylesheet" href="([\w./]+)">')
_SCRIPT: Final = re.compile(rb'<script src="([\w.]+)"></script>')


class Page:
    """Server of the web page at an address HOST:PORT; the caller runs `run` as a task.

    If other computers can reach the address, actions need the token from the storage folder.
    """

    def __init__(self, bind: str, directory: Path, ask: Ask) -> None:
        self._host, self._port = split_address(bind)
        self._directory, self._ask = directory, ask
        self.local = is_loopback(self._host)
        self.access = Access(new_token(), handed_out=self.local)
        self.problem: str | None = "not open yet"  # Reason why the page is not open, in one line; None: open
        self._html = _assembled()
        self._tag = hashlib.sha256(self._html).hexdigest()[:16]
        self._viewers: dict[Viewer, None] = {}  # The oldest first
        self._looked_at = asyncio.Event()
        self._delayed = self._wrong_tokens = 0
        self._reconnection = Reconnection("page", worth_s=WORTH_S, first_s=1.0, cap_s=30.0, on_state=self._on_state)
        self.app = Starlette(
            routes=[
                Route("/", self._page),
                Route("/register_service", _for_blueos),
                Route("/events", self._events),
                Route("/records.json", self._last_records),
                Route("/records/{name}", self._record),
                Route("/temperature.html", self._temperature),
                *(Route(f"/{command}", self._act, methods=["POST"]) for command in ACTIONS),
            ],
            middleware=[Middleware(_OwnNames, access=self.access)],
            exception_handlers={HTTPException: _refuse, CompanionError: _refuse, ClientDisconnect: _refuse},
            max_body_size=MAX_BODY_BYTES,
        )

    async def run(self) -> None:
        await self._reconnection.keep(self._serve)

    async def _serve(self) -> str:
        try:
            if not self.local:
                self.access.token = stored_token(self._directory)
            async with listening(self.app, self._host, self._port, *_security_headers(self._html)) as self._port:
                self._reconnection.up(self.url)
                await self._show_forever()
        except OSError as error:
            return f"{self._host}:{self._port}: {error.strerror or error}"
        except StorageError as error:
            return f"{self._host}:{self._port}: {error}"

    def _on_state(self, there: bool, words: str) -> None:  # noqa: FBT001 - Reconnection's own signature
        self.problem = None if there else words

    @property
    def url(self) -> str:
        return page_url(self._host, self._port)

    def status(self) -> Object:
        return {
            "good": self.problem is None,
            "summary": self.problem or self.url + ("" if self.local else " (buttons: companion page)"),
            "url": None if self.problem else self.url,
            "viewers": len(self._viewers),
            "wrong_tokens": self._wrong_tokens,
        }

    # --- requests

    async def _page(self, _request: Request) -> Response:
        return Response(self._html, media_type="text/html")

    async def _events(self, request: Request) -> Response:
        self._refuse_stranger(request)
        peer, token = _peer(request), request.query_params.get("token", "")
        # The token is in the query: a browser's EventSource cannot set headers.
        has_token = self.access.token_refusal({TOKEN_HEADER: token}) is None
        viewer = Viewer(request.state.connection, peer, has_token=has_token)
        if (why := self._no_room_for(viewer)) is not None:
            if token:
                await self._delay_guess(peer)
            # Send the reason as an event: a browser does not pass the body of an HTTP error to the page.
            return Response(event({"reason": why}, "refused"), media_type="text/event-stream")
        token_for_page = self.access.token if self.access.handed_out else None
        viewer.send(event({"version": __version__, "page": self._tag, "token": token_for_page}, "hello"))
        self._viewers[viewer] = None
        viewer.connection.keep_open(lambda: self._viewers.pop(viewer, None))
        self._looked_at.set()
        return StreamingResponse(viewer.events(), media_type="text/event-stream")

    async def _last_records(self, request: Request) -> Response:
        self._refuse_stranger(request)
        return _json({"records": [{"file": file_name(one), "record": one} for one in await self._records()]})

    async def _record(self, request: Request) -> Response:
        self._refuse_stranger(request)
        for record in await self._records():
            if (name := file_name(record)) == request.path_params["name"]:
                body = msgspec.json.format(msgspec.json.encode(record), indent=1)
                headers = {"Content-Disposition": f'attachment; filename="{name}"'}
                return Response(body, headers=headers, media_type="application/json")
        raise HTTPException(404, f"not among the last {RECORDS} records")

    async def _temperature(self, request: Request) -> Response:
        self._refuse_stranger(request)
        reply = await self._result({"command": "temperature"})
        return Response(await asyncio.to_thread(_plots, reply.get("imus", [])), media_type="text/html")

    async def _act(self, request: Request) -> Response:
        self._refuse_stranger(request)
        if (why := self.access.token_refusal(request.headers)) is not None:
            if request.headers.get(TOKEN_HEADER):
                await self._delay_guess(_peer(request))
            raise HTTPException(403, why)
        if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
            raise HTTPException(415, "an action is asked for in application/json")
        try:
            wanted = parse_request(await request.body() or b"{}")
        except ValueError as error:
            raise HTTPException(400, f"not a JSON object: {error}") from None
        command = request.url.path.removeprefix("/")
        kind = ACTIONS[command]
        asked: Object = {"command": command} | ({"wait": False} if "wait" in kind.fields() else {})
        asked |= {key: wanted[key] for key in kind.fields(Interface.PAGE) if key in wanted}
        try:
            reply = await self._result(asked)
        finally:
            with contextlib.suppress(CompanionError):
                await self._show({"command": "status"})  # the action has changed it
        return _json({key: value for key, value in reply.items() if key != "kind"})

    async def _result(self, asked: Object) -> Object:
        try:
            async with asyncio.timeout(ACTION_WITHIN_S):
                async for reply in self._ask(asked):
                    if reply.get("kind") == "error":
                        raise HTTPException(409, str(reply["reason"]))
                    if reply.get("kind") == "result":
                        return reply
        except TimeoutError:
            pass
        return {"kind": "result", "reason": "under way"}

    async def _records(self) -> list[Object]:
        reply = await self._result({"command": "history", "limit": RECORDS})
        records: list[Object] = reply.get("records", [])
        return records

    def _refuse_stranger(self, request: Request) -> None:
        if (why := self.access.stranger_refusal(request.headers)) is not None:
            raise HTTPException(403, why)

    async def _delay_guess(self, peer: str) -> None:
        """Delay the answer to a wrong token, against guessing, unless 16 answers are being delayed already."""
        if self.access.handed_out:
            return  # not a guess, but probably the token of this process before its restart
        self._wrong_tokens += 1
        logger.warning("page: wrong token from %s", peer)
        if self._delayed < MAX_WAITING:
            self._delayed += 1
            try:
                await asyncio.sleep(WRONG_TOKEN_S)
            finally:
                self._delayed -= 1

    # --- viewers

    def _no_room_for(self, viewer: Viewer) -> str | None:
        """Return the reason to refuse a viewer; None: accept. If 16 are there, one with the token replaces another."""
        if not viewer.has_token:
            if len(self._viewers) >= MAX_VIEWERS:
                return f"{MAX_VIEWERS} are looking already; the token makes room: companion page, on the board"
            alike = sum(other.peer == viewer.peer and not other.has_token for other in self._viewers)
            if not self.local and alike >= MAX_STRANGERS:
                return f"{MAX_STRANGERS} from this address are looking already without the token"
        elif len(self._viewers) >= MAX_VIEWERS:
            strangers = (other for other in self._viewers if not other.has_token)
            oldest = next(strangers, next(iter(self._viewers)))
            del self._viewers[oldest]
            oldest.connection.abort()
        return None

    async def _show_forever(self) -> NoReturn:
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
                    status = reply["status"]
                    # The status of the first-run set-up has no vehicle: no rows can be made of it.
                    more = {"rows": rows(status)} if "vehicle" in status else {}
                    data = event({**status, **more})
                    for viewer in tuple(self._viewers):
                        viewer.send(data)


class Viewer:
    """One browser that shows the page: its connection, and the queue of events to send to it."""

    def __init__(self, connection: Connection, peer: str, *, has_token: bool) -> None:
        self.connection, self.peer, self.has_token = connection, peer, has_token
        self._events: asyncio.Queue[bytes] = asyncio.Queue(MAX_BEHIND)

    def send(self, event: bytes) -> None:
        try:
            self._events.put_nowait(event)
        except asyncio.QueueFull:
            self.connection.abort()

    async def events(self) -> AsyncIterator[bytes]:
        while True:
            yield await self._events.get()


class _OwnNames:
    """Middleware against DNS rebinding: refuses requests to other host names than the board's own."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        app = self._app
        if (why := self._access.host_refusal(Headers(scope=scope))) is not None:
            app = _json({"reason": why}, 421)
        await app(scope, receive, send)


def file_name(record: Object) -> str:
    return f"companion-{re.sub(r'[^0-9T]+', '-', str(record.get('started_at')))}.json"


def _plots(imus: object) -> str:
    from companion.estimation.solution.by_temperature import ByTemperature
    from companion.report.page import biases_by_temperature

    return biases_by_temperature(msgspec.convert(imus, list[ByTemperature]))


def _json(value: object, status: int = 200) -> Response:
    return Response(msgspec.json.encode(value), status, media_type="application/json")


async def _for_blueos(_request: Request) -> Response:
    """Describe the page for BlueOS's menu; it opens in a tab of its own, as frames are forbidden."""
    about = {"name": "Companion", "description": "calibrates the IMUs", "icon": "mdi-axis-arrow", "company": ""}
    return _json({**about, "version": __version__, "webpage": "", "api": "", "avoid_iframes": True})


async def _refuse(_request: Request, error: Exception) -> Response:
    if not isinstance(error, HTTPException):
        return _json({"reason": str(error)}, 409)
    answer = _json({"reason": error.detail}, error.status_code)
    answer.headers.update(error.headers or {})
    return answer


def _peer(request: Request) -> str:
    return request.client.host if request.client is not None else "nobody"


def event(value: object, name: str | None = None) -> bytes:
    head = f"event: {name}\n".encode() if name else b""
    return head + b"data: " + msgspec.json.encode(value) + b"\n\n"


def _assembled() -> bytes:
    """Return the page, styles and scripts as one document: a phone at the edge of the hotspot gets all or nothing."""
    html = (_PARTS / "page.html").read_bytes()
    html = _STYLE.sub(lambda found: b"<style>\n" + (_PARTS / found[1].decode("ascii")).read_bytes() + b"</style>", html)
    return _SCRIPT.sub(
        lambda found: b"<script>\n" + (_PARTS / found[1].decode("ascii")).read_bytes() + b"</script>", html
    )


def _security_headers(html: bytes) -> tuple[tuple[str, str], ...]:
    """Return HTTP headers that allow only this page's own styles and scripts, and connections only to this server."""

    def hashes(tag: bytes) -> str:
        found = re.findall(b"<" + tag + b">(.*?)</" + tag + b">", html, re.DOTALL)
        digests = (base64.b64encode(hashlib.sha256(text).digest()).decode() for text in found)
        return " ".join(f"'sha256-{digest}'" for digest in digests)

    policy = (
        f"default-src 'none'; script-src {hashes(b'script')}; style-src {hashes(b'style')}; connect-src 'self'; "
        "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    return ("Content-Security-Policy", policy), ("Cross-Origin-Opener-Policy", "same-origin")
