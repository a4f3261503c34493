"""A visitor of the page: requests over real sockets, unpacked events, and the answers of the page's companion."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
from collections.abc import AsyncGenerator, AsyncIterator, Callable
from pathlib import Path
from typing import Any, NamedTuple

from companion.errors import CalibrationRefusedError
from companion.web.server import Ask, Page

Object = dict[str, Any]
RECORD: Object = {"started_at": "2026-11-21T18:40:00.123+00:00", "state": "done", "reason": "sigma 4 deg/h"}


class Answer(NamedTuple):
    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


class Companion:
    """Stands in for the control socket, and keeps what the page asks."""

    def __init__(self) -> None:
        self.asked: list[Object] = []
        self.status: Callable[[], Object] = lambda: {"state": "idle"}
        self.every_s = 0.5
        self.refuses: str | None = None
        self.imus: list[Object] = []

    async def ask(self, request: Object) -> AsyncGenerator[Object, None]:
        command = request["command"]
        if command == "status":
            yield {"kind": "result", "status": self.status()}
            return
        while command == "monitor":
            yield {"kind": "progress", "status": self.status()}
            await asyncio.sleep(self.every_s)
        self.asked.append(request)
        if self.refuses is not None:
            raise CalibrationRefusedError(self.refuses)
        if command == "history":
            yield {"kind": "result", "records": [RECORD]}
        elif command == "temperature":
            yield {"kind": "result", "imus": self.imus}
        else:
            yield {"kind": "progress"}
            yield {"kind": "result", "state": "waiting", "reason": "calibration started"}


class Visit:
    """A page that is served, and its visitors' connections."""

    def __init__(self, page: Page, companion: Companion) -> None:
        self.page, self.companion = page, companion
        self._writers: list[asyncio.StreamWriter] = []

    @property
    def port(self) -> int:
        found = re.search(r":(\d+)/", self.page.url)
        assert found is not None
        return int(found[1])

    @property
    def good_headers(self) -> dict[str, str | None]:
        return {"Content_Type": "application/json", "X_Companion_Token": self.page.access.token}

    async def connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        reader, writer = await asyncio.open_connection("127.0.0.1", self.port)
        self._writers.append(writer)
        return reader, writer

    async def raw(self, data: bytes, within_s: float = 30.0) -> bytes:
        """Send bytes as they are; everything that comes back until the other side ends it."""
        reader, writer = await self.connect()
        try:
            writer.write(data)
            async with asyncio.timeout(within_s):
                return await reader.read()
        finally:
            writer.close()

    async def ask(self, method: str, path: str, body: bytes | None = None, **headers: str | None) -> Answer:
        named: dict[str, str | None] = {"Host": f"127.0.0.1:{self.port}"}
        if body is not None:
            named |= {"Content-Length": str(len(body))}
        named |= {name.replace("_", "-"): value for name, value in headers.items()}
        lines = [
            f"{method} {path} HTTP/1.1",
            *(f"{name}: {value}" for name, value in named.items() if value is not None),
        ]
        return parsed(await self.raw("\r\n".join(lines).encode() + b"\r\n\r\n" + (body or b"")))

    async def view(self, query: str = "", **headers: str) -> Viewer:
        reader, writer = await self.connect()
        lines = "".join(f"{name.replace('_', '-')}: {value}\r\n" for name, value in headers.items())
        writer.write(f"GET /events{query} HTTP/1.1\r\nHost: 127.0.0.1\r\n{lines}\r\n".encode())
        return Viewer(reader, writer)

    async def refusal(self, query: str = "") -> str:
        answer = await self.ask("GET", f"/events{query}")
        kind, _, data = answer.body.decode().partition("\ndata: ")
        assert kind == "event: refused"
        reason: str = json.loads(data)["reason"]
        return reason

    def close(self) -> None:
        for writer in self._writers:
            writer.transport.abort()


class Viewer:
    """A visitor that watches: the events, unpacked from their chunks."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer
        self._text = b""

    async def head(self) -> Answer:
        async with asyncio.timeout(30.0):
            return parsed(await self.reader.readuntil(b"\r\n\r\n"))

    async def event(self) -> tuple[str, Any]:
        async with asyncio.timeout(30.0):
            while b"\n\n" not in self._text:
                size = int(await self.reader.readline(), 16)
                self._text += (await self.reader.readexactly(size + 2))[:-2]
        event, _, self._text = self._text.partition(b"\n\n")
        fields = dict(line.split(": ", 1) for line in event.decode().split("\n"))
        return fields.get("event", "message"), json.loads(fields["data"])

    async def begin(self) -> Any:
        assert (await self.head()).status == 200
        kind, hello = await self.event()
        assert kind == "hello"
        return hello

    async def is_ended(self) -> bool:
        """Wait for the other side to close the connection, after any rest of its output."""
        with contextlib.suppress(ConnectionError):
            async with asyncio.timeout(30.0):
                await self.reader.read()
        return True


def parsed(data: bytes) -> Answer:
    head, _, body = data.partition(b"\r\n\r\n")
    first, *lines = head.decode().split("\r\n")
    headers = {name.lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    return Answer(int(first.split()[1]), headers, body)


@contextlib.asynccontextmanager
async def page(folder: Path, bind: str = "127.0.0.1:0") -> AsyncIterator[Visit]:
    companion = Companion()
    served = Page(bind, folder, companion.ask)
    task = asyncio.create_task(served.run())
    visit = Visit(served, companion)
    try:
        await until(lambda: served.problem is None)
        yield visit
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        visit.close()
        await asyncio.sleep(0)


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(30.0):
        while not condition():
            await asyncio.sleep(0.005)


async def press(ask: Ask, button: str, **body: Any) -> tuple[int, str]:
    """Press a button and return the answer, without a server: on virtual time too."""
    site = Page("127.0.0.1:0", Path(), ask)
    headers = {"host": "127.0.0.1", "content-type": "application/json", "x-companion-token": site.access.token}
    scope = {
        "type": "http",
        "method": "POST",
        "path": f"/{button}",
        "query_string": b"",
        "headers": [(name.encode(), value.encode()) for name, value in headers.items()],
        "client": ("127.0.0.1", 1),
    }
    sent: list[Any] = []

    async def receive() -> Object:
        return {"type": "http.request", "body": json.dumps(body).encode()}

    async def send(message: Any) -> None:
        sent.append(message)

    await site.app(scope, receive, send)
    start, answer = sent
    return start["status"], json.loads(answer["body"])["reason"]
