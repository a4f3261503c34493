"""Routes of the page: the page itself, its events, the last records, plots over temperature, and the actions."""

from __future__ import annotations

import asyncio
import hashlib
import logging
import re
from typing import Final

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
from companion.commands import Interface, asked_by
from companion.errors import CompanionError
from companion.formats import Object, parse_request
from companion.web.access import TOKEN_HEADER, Access
from companion.web.listener import MAX_BODY_BYTES
from companion.web.viewers import Ask, Viewer, Viewers, event

logger = logging.getLogger(__name__)

WRONG_TOKEN_S: Final = 2.0
"""Delay of the answer to a wrong token."""
MAX_WAITING: Final = 16
"""The most answers to wrong tokens that are delayed at a time: each holds a connection."""
ACTION_WITHIN_S: Final = 10.0
RECORDS: Final = 10

ACTIONS: Final = asked_by(Interface.PAGE)


class PageRoutes:
    """Handlers of the page's requests; `app` serves them."""

    def __init__(self, access: Access, ask: Ask, viewers: Viewers, html: bytes) -> None:
        self._access, self._ask, self._viewers, self._html = access, ask, viewers, html
        self._tag = hashlib.sha256(html).hexdigest()[:16]
        self._delayed = 0
        self.wrong_tokens = 0
        self.app = Starlette(
            routes=[
                Route("/", self._page),
                Route("/events", self._events),
                Route("/records.json", self._last_records),
                Route("/records/{name}", self._record),
                Route("/temperature.html", self._temperature),
                *(Route(f"/{command}", self._act, methods=["POST"]) for command in ACTIONS),
            ],
            middleware=[Middleware(_OwnNames, access=access)],
            exception_handlers={HTTPException: _refuse, CompanionError: _refuse, ClientDisconnect: _refuse},
            max_body_size=MAX_BODY_BYTES,
        )

    async def _page(self, _request: Request) -> Response:
        return Response(self._html, media_type="text/html")

    async def _events(self, request: Request) -> Response:
        self._refuse_stranger(request)
        peer, token = _peer(request), request.query_params.get("token", "")
        # A browser's EventSource sends no header of ours.
        has_token = self._access.refuses_token({TOKEN_HEADER: token}) is None
        viewer = Viewer(request.state.connection, peer, has_token=has_token)
        if (why := self._viewers.refuses(viewer)) is not None:
            if token:
                await self._delay_guess(peer)
            # As an event: a browser does not show its page the body of an error.
            return Response(event({"reason": why}, "refused"), media_type="text/event-stream")
        token_for_page = self._access.token if self._access.handed_out else None
        viewer.send(event({"version": __version__, "page": self._tag, "token": token_for_page}, "hello"))
        self._viewers.add(viewer)
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
        if (why := self._access.refuses_token(request.headers)) is not None:
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
            await self._viewers.refresh()
        return _json({key: value for key, value in reply.items() if key != "kind"})

    async def _result(self, asked: Object) -> Object:
        """Return the last reply; an action that takes longer than a person waits goes on, and the events show it."""
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
        if (why := self._access.refuses_stranger(request.headers)) is not None:
            raise HTTPException(403, why)

    async def _delay_guess(self, peer: str) -> None:
        """Delay the answer to a wrong token; beyond some that wait, the others are not to suffer for it."""
        if self._access.handed_out:
            return  # the token of the page before a restart is no guess
        self.wrong_tokens += 1
        logger.warning("page: wrong token from %s", peer)
        if self._delayed < MAX_WAITING:
            self._delayed += 1
            try:
                await asyncio.sleep(WRONG_TOKEN_S)
            finally:
                self._delayed -= 1


class _OwnNames:
    """Refuses requests for another name than the board's: what DNS rebinding needs."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        app = self._app
        if (why := self._access.refuses_host(Headers(scope=scope))) is not None:
            app = _json({"reason": why}, 421)
        await app(scope, receive, send)


def file_name(record: Object) -> str:
    """Name the download of a record by its time, without characters that file systems dislike."""
    return f"companion-{re.sub(r'[^0-9T]+', '-', str(record.get('started_at')))}.json"


def _plots(imus: object) -> str:
    from companion.estimation.solution.by_temperature import ByTemperature
    from companion.report.by_temperature import biases_by_temperature

    return biases_by_temperature(msgspec.convert(imus, list[ByTemperature]))


def _json(value: object, status: int = 200) -> Response:
    return Response(msgspec.json.encode(value), status, media_type="application/json")


async def _refuse(_request: Request, error: Exception) -> Response:
    """Answer an error with its reason: a refusal of the companion is a conflict."""
    if not isinstance(error, HTTPException):
        return _json({"reason": str(error)}, 409)
    answer = _json({"reason": error.detail}, error.status_code)
    answer.headers.update(error.headers or {})
    return answer


def _peer(request: Request) -> str:
    return request.client.host if request.client is not None else "nobody"
