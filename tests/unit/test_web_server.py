"""The page's server on a real socket: who may look, who may act, and visitors that misbehave."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import gc
import hashlib
import json
import logging
import re
import socket
import stat
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
import zxingcpp

from companion.calibration.noise.allan import PROFILES
from companion.calibration.solution.by_temperature import by_temperature
from companion.calibration.solution.prior import curve_of
from companion.cli import main as companion
from companion.errors import CalibrationRefusedError, StorageError
from companion.report.by_temperature import biases_by_temperature
from companion.web import access, exchange, server
from companion.web.server import Page
from tests.support.histories import windows_of_days

Object = dict[str, Any]
RECORD: Object = {"started_at": "2026-11-21T18:40:00.123+00:00", "state": "done", "reason": "sigma 4 deg/h"}


class Said(NamedTuple):
    status: int
    headers: dict[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


class Daemon:
    """What the page asks, and what it is answered."""

    def __init__(self) -> None:
        self.asked: list[tuple[Object, str]] = []
        self.status: Callable[[], Object] = lambda: {"state": "idle"}
        self.refuses: str | None = None
        self.imus: list[Object] = []

    async def look(self) -> Object:
        return self.status()

    async def answer(self, request: Object, face: str) -> AsyncIterator[Object]:
        self.asked.append((request, face))
        if self.refuses is not None:
            raise CalibrationRefusedError(self.refuses)
        if request["command"] == "history":
            yield {"kind": "result", "records": [RECORD]}
            return
        if request["command"] == "temperature":
            yield {"kind": "result", "imus": self.imus}
            return
        yield {"kind": "progress"}
        yield {"kind": "result", "state": "waiting", "reason": "calibration started"}


async def on_the_spot(function: Callable[..., Any], *arguments: Any) -> Any:
    return function(*arguments)


@pytest.fixture(autouse=True)
def no_fault_in_it(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """Whatever visitors do, the server itself meets nothing that it did not expect."""
    yield
    assert "a request of the page failed" not in caplog.text


@contextlib.asynccontextmanager
async def page(daemon: Daemon, folder: Path, bind: str = "127.0.0.1:0") -> AsyncIterator[Page]:
    served = Page(bind, folder, daemon.answer, daemon.look, on_the_spot)
    task = asyncio.create_task(served.run())
    try:
        async with asyncio.timeout(30.0):
            while served.problem is not None:
                await asyncio.sleep(0.005)
        yield served
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        for writer in _visitors:
            writer.transport.abort()
        _visitors.clear()
        await asyncio.sleep(0)


_visitors: list[asyncio.StreamWriter] = []


async def connect(served: Page) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    reader, writer = await asyncio.open_connection("127.0.0.1", port_of(served))
    _visitors.append(writer)
    return reader, writer


def port_of(served: Page) -> int:
    return int(re.search(r":(\d+)/", served.url)[1])  # type: ignore[index]


async def raw(served: Page, data: bytes, within_s: float = 5.0) -> bytes:
    """Send bytes as they are; everything that comes back until the other side ends it."""
    reader, writer = await connect(served)
    try:
        writer.write(data)
        async with asyncio.timeout(within_s):
            return await reader.read()
    finally:
        writer.close()


async def ask(served: Page, method: str, path: str, body: bytes | None = None, **headers: str | None) -> Said:
    named: dict[str, str | None] = {"Host": f"127.0.0.1:{port_of(served)}"}
    if body is not None:
        named |= {"Content-Length": str(len(body))}
    named |= {name.replace("_", "-"): value for name, value in headers.items()}
    lines = [f"{method} {path} HTTP/1.1", *(f"{name}: {value}" for name, value in named.items() if value is not None)]
    return parsed(await raw(served, "\r\n".join(lines).encode() + b"\r\n\r\n" + (body or b"")))


def parsed(data: bytes) -> Said:
    head, _, body = data.partition(b"\r\n\r\n")
    first, *lines = head.decode().split("\r\n")
    headers = {name.lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
    return Said(int(first.split()[1]), headers, body)


def good_headers(served: Page) -> dict[str, str | None]:
    return {"Content_Type": "application/json", "X_Companion_Token": served.access.token}


def run(folder: Path, visit: Callable[[Page, Daemon], Any], bind: str = "127.0.0.1:0") -> None:
    async def main() -> None:
        daemon = Daemon()
        async with page(daemon, folder, bind) as served:
            await visit(served, daemon)

    asyncio.run(main())


def test_the_page_runs_its_own_style_and_script_and_nothing_else(tmp_path: Path) -> None:
    async def visit(served: Page, daemon: Daemon) -> None:
        said = await ask(served, "GET", "/")
        assert said.status == 200
        assert said.headers["content-type"] == "text/html; charset=utf-8"
        assert int(said.headers["content-length"]) == len(said.body)
        html = said.body.decode()
        policy = dict(part.strip().split(" ", 1) for part in said.headers["content-security-policy"].split(";"))
        assert policy["default-src"] == policy["form-action"] == policy["frame-ancestors"] == "'none'"
        assert policy["connect-src"] == "'self'"
        for tag in ("style", "script"):
            parts = re.findall(f"<{tag}>(.*?)</{tag}>", html, re.DOTALL)
            digests = [base64.b64encode(hashlib.sha256(part.encode()).digest()).decode() for part in parts]
            assert policy[f"{tag}-src"] == " ".join(f"'sha256-{digest}'" for digest in digests)
            assert html.count(f"<{tag}") == len(parts) > 0
        assert '<link rel="stylesheet"' not in html
        # Nothing is fetched from anywhere else: there is no internet on an airfield.
        assert set(re.findall(r"https?://[^\"' ]+", html)) == {"http://www.w3.org/2000/svg"}
        assert "onclick=" not in html
        assert "innerHTML" not in html
        assert said.headers["x-content-type-options"] == "nosniff"
        assert "access-control-allow-origin" not in said.headers

    run(tmp_path, visit)


@pytest.mark.parametrize(
    "host",
    ["127.0.0.1", "localhost:9000", "LOCALHOST", "[::1]:8191", "192.168.4.1:8191", "own", "own.local:8191", "own.lan"],
)
def test_our_own_names_are_answered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, host: str) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "Own.example.org")

    async def visit(served: Page, daemon: Daemon) -> None:
        assert (await ask(served, "GET", "/", Host=host)).status == 200

    run(tmp_path, visit)


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "evil.example:8191",
        "127.0.0.1.evil.example",
        "own.example.org",
        "own.evil",
        "a@127.0.0.1",
        "[x]",
        "",
    ],
)
def test_a_name_that_was_turned_into_our_address_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, host: str
) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "own")

    async def visit(served: Page, daemon: Daemon) -> None:
        for method, path in (("GET", "/"), ("GET", "/events"), ("GET", "/records.json"), ("POST", "/calibrate")):
            said = await ask(served, method, path, b"{}", Host=host, **good_headers(served))
            assert said.status == 421, (method, path)
            assert served.access.token.encode() not in said.body
        assert daemon.asked == []

    run(tmp_path, visit)


def test_a_request_with_two_hosts_or_none_is_refused(tmp_path: Path) -> None:
    async def visit(served: Page, daemon: Daemon) -> None:
        assert parsed(await raw(served, b"GET / HTTP/1.1\r\n\r\n")).status == 400
        twice = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: evil.example\r\n\r\n"
        assert parsed(await raw(served, twice)).status == 400

    run(tmp_path, visit)


def test_an_action_is_asked_for_with_the_token(tmp_path: Path) -> None:
    async def visit(served: Page, daemon: Daemon) -> None:
        own = f"http://127.0.0.1:{port_of(served)}"
        body = b'{"what": "gyros", "wait": true, "timeout_s": 1}'
        said = await ask(served, "POST", "/calibrate", body, Origin=own, **good_headers(served))
        assert (said.status, said.json) == (200, {"state": "waiting", "reason": "calibration started"})
        # Of what was sent only what a button may say goes on.
        assert daemon.asked == [({"command": "calibrate", "what": "gyros"}, "the page's")]
        typed = served.access.token.upper().replace("-", " ")
        assert (
            await ask(served, "POST", "/cancel", b"", **good_headers(served) | {"X_Companion_Token": typed})
        ).status == 200
        assert daemon.asked[1][0] == {"command": "cancel"}
        daemon.refuses = "armed: disarm first"
        refused = await ask(served, "POST", "/undo", b"{}", **good_headers(served))
        assert (refused.status, refused.json) == (409, {"reason": "armed: disarm first"})

    run(tmp_path, visit)


@pytest.mark.parametrize(
    ("status", "changed"),
    [
        (403, {"X_Companion_Token": None}),
        (403, {"X_Companion_Token": "k7xm-p2qd-9rtw"}),
        (403, {"X_Companion_Token": "\xfc"}),
        (403, {"Origin": "http://evil.example"}),
        (403, {"Origin": "http://127.0.0.1:1"}),
        (403, {"Origin": "null"}),
        (403, {"Sec_Fetch_Site": "cross-site"}),
        (403, {"Sec_Fetch_Site": "same-site"}),
        (415, {"Content_Type": "text/plain"}),
        (415, {"Content_Type": None}),
    ],
)
def test_an_action_without_its_papers_is_refused(tmp_path: Path, status: int, changed: dict[str, str | None]) -> None:
    async def visit(served: Page, daemon: Daemon) -> None:
        for path in ("/calibrate", "/cancel", "/undo"):
            said = await ask(served, "POST", path, b"{}", **good_headers(served) | changed)
            assert said.status == status
            assert len(said.json["reason"]) > 10
        assert daemon.asked == []

    run(tmp_path, visit)


def test_no_action_is_ever_a_get(tmp_path: Path) -> None:
    async def visit(served: Page, daemon: Daemon) -> None:
        for method in ("GET", "HEAD", "PUT", "DELETE", "OPTIONS"):
            for path in ("/calibrate", "/cancel", "/undo"):
                said = await ask(served, method, path, None, **good_headers(served))
                assert (said.status, said.headers["allow"]) == (405, "POST")
        assert (await ask(served, "POST", "/", b"{}", **good_headers(served))).status == 405
        assert (await ask(served, "GET", "/etc/passwd")).status == 404
        assert (await ask(served, "GET", "/records/../../web-token")).status == 404
        assert daemon.asked == []

    run(tmp_path, visit)


@pytest.mark.parametrize(
    ("status", "data"),
    [
        (400, b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n"),
        (400, b"GET /\r\n\r\n"),
        (400, b"POST /cancel HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: -1\r\n\r\n"),
        (400, b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nbad header\r\n\r\n"),
        (431, b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: " + b"a" * 20000 + b"\r\n\r\n"),
        (413, b"POST /cancel HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9999\r\n\r\n" + b" " * 9999),
    ],
)
def test_what_is_not_http_or_too_much_ends_with_an_answer(tmp_path: Path, status: int, data: bytes) -> None:
    async def visit(served: Page, daemon: Daemon) -> None:
        reader, writer = await connect(served)
        writer.write(data)
        async with asyncio.timeout(30.0):
            first = await reader.readline()
        assert int(first.split()[1]) == status
        writer.close()
        assert (await ask(served, "GET", "/")).status == 200
        assert daemon.asked == []

    run(tmp_path, visit)


@pytest.mark.parametrize("body", [b"[1]", b"{", b"\xff", b'"calibrate"'])
def test_a_body_that_is_no_object_is_refused(tmp_path: Path, body: bytes) -> None:
    async def visit(served: Page, daemon: Daemon) -> None:
        assert (await ask(served, "POST", "/calibrate", body, **good_headers(served))).status == 400
        assert daemon.asked == []

    run(tmp_path, visit)


def test_who_sends_byte_by_byte_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exchange, "REQUEST_WITHIN_S", 0.3)

    async def visit(served: Page, daemon: Daemon) -> None:
        reader, writer = await connect(served)

        async def drip() -> None:
            for byte in b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n" * 100:
                writer.write(bytes([byte]))
                await asyncio.sleep(0.02)

        dripping = asyncio.create_task(drip())
        async with asyncio.timeout(30.0):
            assert int((await reader.readline()).split()[1]) == 408
        dripping.cancel()
        writer.close()

    run(tmp_path, visit)


def test_whoever_says_nothing_for_longest_makes_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "MAX_CONNECTIONS", 3)

    async def visit(served: Page, daemon: Daemon) -> None:
        silent = [await connect(served) for _ in range(3)]
        assert (await ask(served, "GET", "/")).status == 200
        async with asyncio.timeout(30.0):
            with contextlib.suppress(ConnectionError):
                assert await silent[0][0].read() == b""
        for _, writer in silent:
            writer.close()

    run(tmp_path, visit)


def test_a_burst_of_silent_connections_leaves_no_descriptor_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "MAX_CONNECTIONS", 4)

    async def visit(served: Page, daemon: Daemon) -> None:
        # All are there before the loop turns, so that most are evicted at once.
        silent = [socket.create_connection(("127.0.0.1", port_of(served))) for _ in range(40)]
        evicted = silent[: -server.MAX_CONNECTIONS]
        loop = asyncio.get_running_loop()
        async with asyncio.timeout(30.0):
            for client in evicted:
                client.setblocking(False)
                with contextlib.suppress(ConnectionError):
                    assert await loop.sock_recv(client, 1) == b""
        for client in silent:
            client.close()

    gc.disable()  # it would close some of what is left open
    try:
        run(tmp_path, visit)
    finally:
        gc.enable()


def test_whoever_looks_on_does_not_make_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "MAX_CONNECTIONS", 2)

    async def visit(served: Page, daemon: Daemon) -> None:
        viewer = await Viewer.at(served)
        await viewer.head()
        await viewer.event()
        silent = [await connect(served) for _ in range(4)]
        assert (await ask(served, "POST", "/cancel", b"{}", **good_headers(served))).status == 200
        assert served.status()["viewers"] == 1
        for _ in range(3):
            await viewer.event()
        for _, writer in [*silent, (None, viewer.writer)]:
            writer.close()

    run(tmp_path, visit)


@pytest.mark.parametrize("body", [b'{"what":' + b"[" * 4000, b'{"what": "\\u0000"}', b'{"force": {"a": 1}}', b"[1]"])
def test_a_body_that_is_no_request_is_refused_in_one_line(
    tmp_path: Path, body: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    async def visit(served: Page, daemon: Daemon) -> None:
        assert (await ask(served, "POST", "/undo", body, **good_headers(served))).status == 400

    run(tmp_path, visit)
    assert not [record for record in caplog.records if record.exc_info]


class Viewer:
    """Somebody who looks: the events, unpacked from their chunks."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer
        self._text = b""

    @classmethod
    async def at(cls, served: Page, *, query: str = "", **headers: str) -> Viewer:
        reader, writer = await connect(served)
        lines = "".join(f"{name.replace('_', '-')}: {value}\r\n" for name, value in headers.items())
        writer.write(f"GET /events{query} HTTP/1.1\r\nHost: 127.0.0.1\r\n{lines}\r\n".encode())
        return cls(reader, writer)

    async def head(self) -> Said:
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

    async def is_ended(self) -> bool:
        """Whether the other side ends it, after whatever it still says."""
        with contextlib.suppress(ConnectionError):
            async with asyncio.timeout(30.0):
                await self.reader.read()
        return True


def test_the_state_comes_at_once_and_again_after_every_action(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "EVERY_S", 60.0)

    async def visit(served: Page, daemon: Daemon) -> None:
        looks = 0

        def status() -> Object:
            nonlocal looks
            looks += 1
            return {"looks": looks}

        daemon.status = status
        viewer = await Viewer.at(served)
        head = await viewer.head()
        assert head.headers["content-type"] == "text/event-stream"
        assert head.headers["cache-control"] == "no-store"
        kind, hello = await viewer.event()
        assert (kind, hello["token"]) == ("hello", served.access.token)
        assert await viewer.event() == ("message", {"looks": 1})
        assert served.status()["viewers"] == 1
        await ask(served, "POST", "/calibrate", b"{}", **good_headers(served))
        assert await viewer.event() == ("message", {"looks": 2})
        viewer.writer.close()
        async with asyncio.timeout(30.0):
            while served.status()["viewers"]:
                await asyncio.sleep(0.005)

    run(tmp_path, visit)


def test_a_foreign_site_is_told_no_token(tmp_path: Path) -> None:
    async def visit(served: Page, daemon: Daemon) -> None:
        for headers in ({"Sec_Fetch_Site": "cross-site"}, {"Origin": "http://evil.example"}):
            viewer = await Viewer.at(served, **headers)
            head = await viewer.head()
            assert head.status == 403
            assert "access-control-allow-origin" not in head.headers
            assert served.access.token.encode() not in await viewer.reader.read()

    run(tmp_path, visit)


def test_too_many_viewers_are_told_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "MAX_VIEWERS", 2)

    async def visit(served: Page, daemon: Daemon) -> None:
        viewers = [await Viewer.at(served) for _ in range(2)]
        for viewer in viewers:
            await viewer.head()
            await viewer.event()
        third = await Viewer.at(served)
        assert (await third.head()).status == 503
        for viewer in viewers:
            viewer.writer.close()

    run(tmp_path, visit)


def test_the_token_makes_room_among_viewers_without_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "MAX_VIEWERS", 3)
    monkeypatch.setattr(server, "WRONG_TOKEN_S", 0.0)

    async def visit(served: Page, daemon: Daemon) -> None:
        async def looks(query: str = "") -> Viewer:
            viewer = await Viewer.at(served, query=query)
            assert (await viewer.head()).status == 200
            await viewer.event()
            return viewer

        token = f"?token={served.access.token}"
        strangers = [await looks() for _ in range(server.MAX_VIEWERS)]
        wrong = await Viewer.at(served, query="?token=222222222222")
        assert (await wrong.head()).status == 503
        pilots = []
        for displaced in strangers:
            pilots.append(await looks(token))
            assert await displaced.is_ended()
        assert (await (await Viewer.at(served)).head()).status == 503
        # Where all have the token the oldest makes way: one phone that reconnects leaves old connections behind.
        pilots.append(await looks(token))
        assert await pilots[0].is_ended()
        for pilot in pilots[1:]:
            await pilot.event()
            await pilot.event()
        assert served.status()["viewers"] == server.MAX_VIEWERS

    run(tmp_path, visit, bind="0.0.0.0:0")


@pytest.mark.parametrize(("bind", "room"), [("0.0.0.0:0", server.MAX_STRANGERS), ("127.0.0.1:0", server.MAX_VIEWERS)])
def test_one_address_does_not_take_all_room_for_viewers(tmp_path: Path, bind: str, room: int) -> None:
    async def visit(served: Page, daemon: Daemon) -> None:
        viewers = [await Viewer.at(served) for _ in range(room)]
        for viewer in viewers:
            assert (await viewer.head()).status == 200
            await viewer.event()
        assert (await (await Viewer.at(served)).head()).status == 503

    run(tmp_path, visit, bind=bind)


def test_a_viewer_who_does_not_read_is_dropped_and_the_others_see_everything(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "EVERY_S", 0.002)
    monkeypatch.setattr(server, "LEAST_S", 0.001)

    async def visit(served: Page, daemon: Daemon) -> None:
        number = 0

        def status() -> Object:
            nonlocal number
            number += 1
            return {"number": number, "pad": "x" * 20000}

        daemon.status = status
        asleep = await Viewer.at(served)
        asleep.writer.transport.pause_reading()  # type: ignore[attr-defined]
        awake = await Viewer.at(served)
        await awake.head()
        await awake.event()
        seen = [(await awake.event())[1]["number"]]
        dropped_after = None
        async with asyncio.timeout(30.0):
            while dropped_after is None:
                seen.append((await awake.event())[1]["number"])
                if served.status()["viewers"] == 1:
                    dropped_after = len(seen)
        for _ in range(5):
            seen.append((await awake.event())[1]["number"])
        assert seen == list(range(seen[0], seen[0] + len(seen)))
        again = await Viewer.at(served)
        assert (await again.head()).status == 200
        for viewer in (asleep, awake, again):
            viewer.writer.transport.abort()

    run(tmp_path, visit)


def test_a_fault_behind_the_page_ends_neither_page_nor_viewer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(server, "EVERY_S", 0.02)
    monkeypatch.setattr(server, "LEAST_S", 0.01)

    async def visit(served: Page, daemon: Daemon) -> None:
        failed = asyncio.Event()

        def broken() -> Object:
            failed.set()
            raise ZeroDivisionError

        daemon.status = broken
        viewer = await Viewer.at(served)
        await viewer.head()
        await viewer.event()
        async with asyncio.timeout(30.0):
            await failed.wait()
        daemon.status = lambda: {"well": True}
        assert await viewer.event() == ("message", {"well": True})
        viewer.writer.close()

    with caplog.at_level(logging.ERROR):
        run(tmp_path, visit)
    assert "no state to show" in caplog.text


def test_an_address_in_use_is_said_and_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        server, "Backoff", lambda **_: type("", (), {"next_s": lambda _: 0.02, "reset": lambda _: None})()
    )

    async def main() -> None:
        daemon = Daemon()
        other = await asyncio.start_server(lambda _r, w: w.close(), "127.0.0.1", 0)
        port = other.sockets[0].getsockname()[1]
        served = Page(f"127.0.0.1:{port}", tmp_path, daemon.answer, daemon.look, on_the_spot)
        task = asyncio.create_task(served.run())
        async with asyncio.timeout(30.0):
            while "in use" not in (served.problem or ""):
                await asyncio.sleep(0.005)
            assert served.status()["url"] is None
            other.close()
            await other.wait_closed()
            while served.problem is not None:
                await asyncio.sleep(0.005)
        assert (await ask(served, "GET", "/")).status == 200
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    asyncio.run(main())


def test_the_last_records_and_a_download(tmp_path: Path) -> None:
    async def visit(served: Page, daemon: Daemon) -> None:
        said = await ask(served, "GET", "/records.json")
        ((file, record),) = [(found["file"], found["record"]) for found in said.json["records"]]
        assert record == RECORD
        assert daemon.asked[0][0] == {"command": "history", "limit": 10}
        download = await ask(served, "GET", f"/records/{file}")
        assert download.json == RECORD
        assert download.headers["content-disposition"] == f'attachment; filename="{file}"'
        assert re.fullmatch(r"[\w.-]+\.json", file)
        assert (await ask(served, "GET", "/records/companion-1970.json")).status == 404

    run(tmp_path, visit)


def test_the_plots_over_temperature_are_drawn_for_who_asks(tmp_path: Path) -> None:
    points = windows_of_days(10)
    imu = by_temperature("fc", points, curve_of(points, "gyro", PROFILES["icm42688p"].gyro), power_up=None)

    async def visit(served: Page, daemon: Daemon) -> None:
        daemon.imus = [msgspec.to_builtins(imu)]
        said = await ask(served, "GET", "/temperature.html")
        assert said.status == 200
        assert said.headers["content-type"].startswith("text/html")
        assert said.body.decode() == biases_by_temperature([imu])

    run(tmp_path, visit)


def test_beyond_the_board_the_token_is_the_kept_one_and_never_handed_out(tmp_path: Path) -> None:
    async def visit(served: Page, daemon: Daemon) -> None:
        kept = (tmp_path / "web-token").read_text().strip()
        viewer = await Viewer.at(served)
        await viewer.head()
        assert (await viewer.event())[1]["token"] is None
        viewer.writer.close()
        wrong = await ask(served, "POST", "/cancel", b"{}", **good_headers(served) | {"X_Companion_Token": "2" * 12})
        assert wrong.status == 403
        assert "companion web-token" in wrong.json["reason"]
        right = await ask(served, "POST", "/cancel", b"{}", **good_headers(served) | {"X_Companion_Token": kept})
        assert right.status == 200

    run(tmp_path, visit, bind="0.0.0.0:0")
    assert stat.S_IMODE((tmp_path / "web-token").stat().st_mode) == 0o600


def test_the_kept_token_stays_and_a_useless_one_is_refused(tmp_path: Path) -> None:
    first = access.kept_token(tmp_path)
    assert re.fullmatch(r"([2-9a-hjkmnp-z]{4}-){2}[2-9a-hjkmnp-z]{4}", first)
    assert access.kept_token(tmp_path) == first
    assert access.new_token() != access.new_token()
    for useless in (b"", b"short\n", b"\xff\xfe\n"):
        (tmp_path / "web-token").write_bytes(useless)
        with pytest.raises(StorageError, match="web-token"):
            access.kept_token(tmp_path)


def test_a_token_that_somebody_chose_has_twelve_characters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, toml = tmp_path / "web-token", tmp_path / "c.toml"
    toml.write_text(
        '[mavlink]\nurl = "udpout:127.0.0.1:9"\n[[imu]]\nname = "fc"\nsource = "autopilot"\n'
        f'[web]\nbind = "192.168.4.1:8191"\n[storage]\ndirectory = "{tmp_path}"\n'
    )
    path.write_text("eleven - chars\n")
    assert companion(["web-token", "-c", str(toml)]) == 1
    assert capsys.readouterr().err == (
        f"companion: {path}: found a token of 11 characters; allowed: at least 12; remove the file, and a good one is"
        " made\n"
    )
    path.write_text("twelve - chars!\n")
    assert companion(["web-token", "-c", str(toml)]) == 0
    out = capsys.readouterr().out
    assert out.startswith("token: twelve - chars!\n")
    assert out.endswith("#token=twelve%20-%20chars%21\n")  # no picture into a pipe
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "80")
    assert companion(["web-token", "-c", str(toml)]) == 0
    shown = capsys.readouterr().out.splitlines()[3:]
    assert [found.text for found in zxingcpp.read_barcodes(seen(shown), try_invert=False)] == [out.split()[-1]]
    assert len(shown) <= 24, "a terminal's height"
    # Where its lines would be broken there is none.
    wide = len(re.sub(r"\x1b\[[\d;]*m", "", shown[0]))
    for columns, words in ((wide, "camera read this"), (wide - 1, f"make this window {wide} columns wide")):
        monkeypatch.setenv("COLUMNS", str(columns))
        assert companion(["web-token", "-c", str(toml)]) == 0
        assert words in (told := capsys.readouterr().out)
        assert ("█" in told) == (columns == wide)


def seen(lines: list[str], size: int = 4) -> npt.NDArray[np.uint8]:
    """A black terminal as a camera sees it: cells twice as high as wide, blocks in the colours that are asked for."""
    light = {"37": 229, "97": 255, "30": 0, "40": 0, "47": 229, "107": 255}
    halves = {" ": (0, 0), "▀": (1, 0), "▄": (0, 1), "█": (1, 1)}
    rows: list[list[int]] = []
    for line in lines:
        top: list[int] = []
        bottom: list[int] = []
        front, back = 229, 0
        for codes, character in re.findall(r"\x1b\[([\d;]*)m|(.)", line):
            if character:
                up, down = halves[character]
                top.append(front if up else back)
                bottom.append(front if down else back)
            elif codes in ("", "0"):
                front, back = 229, 0
            else:
                front, back = (light[code] for code in codes.split(";"))
        rows += [top, bottom]
    picture = np.kron(np.array(rows, np.uint8), np.ones((size, size), np.uint8))
    return np.pad(picture, 8 * size)


def test_who_has_the_token_is_let_in_whoever_guesses_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(server, "WRONG_TOKEN_S", 3600.0)

    async def visit(served: Page, daemon: Daemon) -> None:
        def guess() -> asyncio.Task[Said]:
            headers = good_headers(served) | {"X_Companion_Token": "2" * 12}
            return asyncio.create_task(ask(served, "POST", "/cancel", b"{}", **headers))

        # From one after the other that waits, so many are held back; the next is answered at once.
        waiting = []
        for held in range(1, server.MAX_WAITING + 1):
            waiting.append(guess())
            while served.status()["wrong_tokens"] < held:
                await asyncio.sleep(0)
        beyond = await guess()
        assert beyond.status == 403
        assert not any(task.done() for task in waiting)
        assert (await ask(served, "GET", "/records.json")).status == 200
        right = await ask(served, "POST", "/cancel", b"{}", **good_headers(served))
        assert right.status == 200
        assert daemon.asked[-1][0] == {"command": "cancel"}
        assert served.status()["wrong_tokens"] == server.MAX_WAITING + 1
        for task in waiting:
            task.cancel()
        await asyncio.gather(*waiting, return_exceptions=True)

    run(tmp_path, visit, bind="0.0.0.0:0")
    assert caplog.text.count("wrong token from 127.0.0.1") == server.MAX_WAITING + 1
    assert "2" * 12 not in caplog.text


def test_on_the_board_itself_an_old_token_is_no_guess(tmp_path: Path) -> None:
    async def visit(served: Page, _daemon: Daemon) -> None:
        old = await ask(served, "POST", "/cancel", b"{}", **good_headers(served) | {"X_Companion_Token": "2" * 12})
        assert (old.status, old.json["reason"]) == (403, "the companion was restarted: try again")
        none = await ask(served, "POST", "/cancel", b"{}", **good_headers(served) | {"X_Companion_Token": None})
        assert none.status == 403
        assert served.status()["wrong_tokens"] == 0

    run(tmp_path, visit)


@pytest.mark.parametrize(
    ("bind", "host", "port", "local"),
    [
        ("127.0.0.1:8191", "127.0.0.1", 8191, True),
        ("[::1]:80", "::1", 80, True),
        ("localhost:1", "localhost", 1, True),
        ("0.0.0.0:8191", "0.0.0.0", 8191, False),
        ("192.168.4.1:8191", "192.168.4.1", 8191, False),
        ("[::]:8191", "::", 8191, False),
    ],
)
def test_which_addresses_only_the_board_can_reach(bind: str, host: str, port: int, local: bool) -> None:
    assert access.split_address(bind) == (host, port)
    assert access.is_loopback(host) is local
