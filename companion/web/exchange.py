"""One HTTP exchange on one connection: a request within a deadline and within bounds, one answer, the end.

h11 parses and frames; no connection is kept for a second request.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Mapping
from typing import Final

import h11

REQUEST_WITHIN_S: Final = 5.0
"""Deadline of a whole request, head and body: whoever sends byte by byte is not waited for."""
SENT_WITHIN_S: Final = 20.0
MAX_HEAD: Final = 8192
MAX_BODY: Final = 4096
_READ: Final = 4096


@dataclasses.dataclass(frozen=True, slots=True)
class Request:
    """What was asked; names of headers in small letters."""

    method: str
    path: str
    headers: Mapping[str, str]
    body: bytes = b""
    peer: str = ""
    query: str = ""


@dataclasses.dataclass(frozen=True, slots=True)
class Response:
    """What is answered."""

    status: int
    body: bytes
    content_type: str = "application/json"
    headers: tuple[tuple[str, str], ...] = ()


class BadRequestError(Exception):
    """Not HTTP, or beyond the bounds; `status` is the answer's."""

    def __init__(self, status: int, reason: str) -> None:
        super().__init__(reason)
        self.status = status


class Exchange:
    """The server's side of one connection; `always` are headers of every answer."""

    def __init__(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, always: tuple[tuple[str, str], ...]
    ) -> None:
        self._reader, self.writer, self._always = reader, writer, always
        self._head_only = False
        self._http = h11.Connection(h11.SERVER, max_incomplete_event_size=MAX_HEAD)

    async def request(self) -> Request | None:
        """The request; None when the other side left without one.

        Raises:
            BadRequestError: it cannot be read, and what to answer.
        """
        try:
            async with asyncio.timeout(REQUEST_WITHIN_S):
                return await self._request()
        except TimeoutError:
            raise BadRequestError(408, f"no whole request within {REQUEST_WITHIN_S:g} s") from None
        except h11.RemoteProtocolError as error:
            raise BadRequestError(error.error_status_hint, str(error)) from None

    async def _request(self) -> Request | None:
        head: h11.Request | None = None
        body = b""
        while True:
            event = self._http.next_event()
            if event is h11.NEED_DATA:
                if self._http.they_are_waiting_for_100_continue:
                    self.writer.write(self._http.send(h11.InformationalResponse(status_code=100, headers=[])))
                data = await self._reader.read(_READ)
                if not data and head is None and not self._http.trailing_data[0]:
                    return None
                self._http.receive_data(data)
            elif isinstance(event, h11.Request):
                head = event
                self._head_only = event.method == b"HEAD"
            elif isinstance(event, h11.Data):
                body += event.data
                if len(body) > MAX_BODY:
                    raise BadRequestError(413, f"more than {MAX_BODY} bytes")
            elif isinstance(event, h11.EndOfMessage) and head is not None:
                headers = {name.decode("latin-1"): value.decode("latin-1") for name, value in head.headers}
                path, _, query = head.target.decode("latin-1").partition("?")
                peer = str((self.writer.get_extra_info("peername") or ("nobody",))[0])
                return Request(head.method.decode("latin-1"), path, headers, body, peer, query)
            else:
                return None

    async def respond(self, response: Response) -> None:
        """Send an answer.

        Raises:
            TimeoutError: the other side does not take it.
        """
        self._begin(response.status, response.content_type, len(response.body), response.headers)
        if not self._head_only:
            self.send(response.body)
        self.writer.write(self._http.send(h11.EndOfMessage()) or b"")
        async with asyncio.timeout(SENT_WITHIN_S):
            await self.writer.drain()

    def begin_stream(self, content_type: str) -> None:
        """Begin an answer without an end; `send` goes on with it."""
        self._begin(200, content_type, None, ())

    def send(self, data: bytes) -> None:
        """Hand over more of the answer; bounding what waits is the caller's."""
        self.writer.write(self._http.send(h11.Data(data=data)) or b"")

    async def left(self) -> None:
        """Return when the other side has left, or says something more, which it has no reason to."""
        await self._reader.read(1)

    def _begin(self, status: int, content_type: str, length: int | None, more: tuple[tuple[str, str], ...]) -> None:
        headers = [("Content-Type", content_type), ("Connection", "close"), *self._always, *more]
        if length is not None:
            headers.append(("Content-Length", str(length)))
        if self._http.our_state is h11.MUST_CLOSE or self._http.our_state is h11.ERROR:
            raise ConnectionError("nothing can be answered any more")
        self.writer.write(self._http.send(h11.Response(status_code=status, headers=headers)) or b"")
