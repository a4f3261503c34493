"""The page's server on a real socket: who may look, who may act, and visitors that misbehave."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import gc
import hashlib
import re
import socket
import stat
import sys
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import zxingcpp

from companion.cli import main as companion
from companion.errors import StorageError
from companion.web import access, listener, server
from tests.support.page import RECORD, Answer, Object, Viewer, Visit, page, parsed, until

pytestmark = pytest.mark.real_clock


@pytest.fixture(autouse=True)
def no_fault_in_it(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """The server logs no unexpected fault, whatever visitors do."""
    yield
    assert not [record for record in caplog.records if record.exc_info]


def run(folder: Path, visitor: Callable[[Visit], Awaitable[None]], bind: str = "127.0.0.1:0") -> None:
    async def main() -> None:
        async with page(folder, bind) as visit:
            await visitor(visit)

    asyncio.run(main())


def test_the_page_runs_its_own_style_and_script_and_nothing_else(tmp_path: Path) -> None:
    async def visitor(visit: Visit) -> None:
        said = await visit.ask("GET", "/")
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

    run(tmp_path, visitor)


def test_blueos_finds_the_page_for_its_menu(tmp_path: Path) -> None:
    async def visitor(visit: Visit) -> None:
        said = await visit.ask("GET", "/register_service", Host="localhost:8191")
        about = said.json
        # What the scanner of BlueOS's helper wants of a service.
        assert {"name", "description", "icon", "company", "version", "webpage", "api"} < about.keys()
        assert about["avoid_iframes"] is True

    run(tmp_path, visitor)


@pytest.mark.parametrize(
    "host",
    ["127.0.0.1", "localhost:9000", "LOCALHOST", "[::1]:8191", "192.168.4.1:8191", "own", "own.local:8191", "own.lan"],
)
def test_our_own_names_are_answered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, host: str) -> None:
    monkeypatch.setattr(socket, "gethostname", lambda: "Own.example.org")

    async def visitor(visit: Visit) -> None:
        assert (await visit.ask("GET", "/", Host=host)).status == 200

    run(tmp_path, visitor)


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

    async def visitor(visit: Visit) -> None:
        for method, path in (("GET", "/"), ("GET", "/events"), ("GET", "/records.json"), ("POST", "/calibrate")):
            said = await visit.ask(method, path, b"{}", Host=host, **visit.good_headers)
            assert said.status == 421, (method, path)
            assert visit.page.access.token.encode() not in said.body
        assert visit.companion.asked == []

    run(tmp_path, visitor)


def test_a_request_with_two_hosts_or_none_is_refused(tmp_path: Path) -> None:
    async def visitor(visit: Visit) -> None:
        assert parsed(await visit.raw(b"GET / HTTP/1.1\r\n\r\n")).status == 400
        twice = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: evil.example\r\n\r\n"
        assert parsed(await visit.raw(twice)).status == 400

    run(tmp_path, visitor)


def test_an_action_is_asked_for_with_the_token(tmp_path: Path) -> None:
    async def visitor(visit: Visit) -> None:
        own = f"http://127.0.0.1:{visit.port}"
        body = b'{"what": "gyros", "wait": true, "timeout_s": 1}'
        said = await visit.ask("POST", "/calibrate", body, Origin=own, **visit.good_headers)
        assert (said.status, said.json) == (200, {"state": "waiting", "reason": "calibration started"})
        # Of what was sent only what a button may say goes on.
        assert visit.companion.asked == [{"command": "calibrate", "what": "gyros", "wait": False}]
        typed = visit.page.access.token.upper().replace("-", " ")
        assert (
            await visit.ask("POST", "/cancel", b"", **visit.good_headers | {"X_Companion_Token": typed})
        ).status == 200
        assert visit.companion.asked[1] == {"command": "cancel"}
        visit.companion.refuses = "armed: disarm first"
        refused = await visit.ask("POST", "/undo", b"{}", **visit.good_headers)
        assert (refused.status, refused.json) == (409, {"reason": "armed: disarm first"})

    run(tmp_path, visitor)


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
    async def visitor(visit: Visit) -> None:
        for path in ("/calibrate", "/cancel", "/undo"):
            said = await visit.ask("POST", path, b"{}", **visit.good_headers | changed)
            assert said.status == status
            assert len(said.json["reason"]) > 10
        assert visit.companion.asked == []

    run(tmp_path, visitor)


def test_no_action_is_ever_a_get(tmp_path: Path) -> None:
    async def visitor(visit: Visit) -> None:
        for method in ("GET", "HEAD", "PUT", "DELETE", "OPTIONS"):
            for path in ("/calibrate", "/cancel", "/undo"):
                said = await visit.ask(method, path, None, **visit.good_headers)
                assert (said.status, said.headers["allow"]) == (405, "POST")
        assert (await visit.ask("POST", "/", b"{}", **visit.good_headers)).status == 405
        assert (await visit.ask("GET", "/etc/passwd")).status == 404
        assert (await visit.ask("GET", "/records/../../web-token")).status == 404
        assert visit.companion.asked == []

    run(tmp_path, visitor)


@pytest.mark.parametrize(
    ("status", "data"),
    [
        (400, b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n"),
        (400, b"GET /\r\n\r\n"),
        (400, b"POST /cancel HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: -1\r\n\r\n"),
        (400, b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nbad header\r\n\r\n"),
        (413, b"POST /cancel HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9999\r\n\r\n" + b" " * 9999),
    ],
)
def test_what_is_not_http_or_too_much_ends_with_an_answer(tmp_path: Path, status: int, data: bytes) -> None:
    async def visitor(visit: Visit) -> None:
        reader, writer = await visit.connect()
        writer.write(data)
        async with asyncio.timeout(30.0):
            first = await reader.readline()
        assert int(first.split()[1]) == status
        writer.close()
        assert (await visit.ask("GET", "/")).status == 200
        assert visit.companion.asked == []

    run(tmp_path, visitor)


@pytest.mark.parametrize(
    "begun",
    [
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nX: ",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 100000000\r\n\r\n",
        b"POST /cancel HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\n5f5e100\r\n",
    ],
    ids=["head", "body", "chunk"],
)
def test_a_hundred_megabytes_are_cut_off(tmp_path: Path, begun: bytes) -> None:
    async def visitor(visit: Visit) -> None:
        _, writer = await visit.connect()
        writer.write(begun)
        sent = 0
        with contextlib.suppress(ConnectionError):
            async with asyncio.timeout(30.0):
                while sent < 100_000_000:
                    writer.write(b"a" * 65536)
                    await writer.drain()
                    sent += 65536
        assert sent < 10_000_000
        assert (await visit.ask("GET", "/")).status == 200
        assert visit.companion.asked == []

    run(tmp_path, visitor)


def test_who_sends_byte_by_byte_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listener, "ANSWERED_WITHIN_S", 0.3)

    async def visitor(visit: Visit) -> None:
        head = f"POST /cancel HTTP/1.1\r\nHost: 127.0.0.1\r\nX-Companion-Token: {visit.page.access.token}\r\n"
        head += "Content-Type: application/json\r\nContent-Length: 900\r\n\r\n"
        for begun in (b"GET / HTTP/1.1\r\n", head.encode()):
            reader, writer = await visit.connect()

            async def drip(begun: bytes = begun, writer: asyncio.StreamWriter = writer) -> None:
                writer.write(begun)
                while True:
                    writer.write(b"a")
                    await asyncio.sleep(0.02)

            dripping = asyncio.create_task(drip())
            async with asyncio.timeout(30.0):
                with contextlib.suppress(ConnectionError):
                    assert await reader.read() == b""
            dripping.cancel()
        assert visit.companion.asked == []

    run(tmp_path, visitor)


def test_a_burst_of_silent_connections_leaves_no_descriptor_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(listener, "MAX_CONNECTIONS", 4)

    async def visitor(visit: Visit) -> None:
        # All are there before the loop turns, so that most are evicted at once.
        silent = [socket.create_connection(("127.0.0.1", visit.port)) for _ in range(40)]
        evicted = silent[: -listener.MAX_CONNECTIONS]
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
        run(tmp_path, visitor)
    finally:
        gc.enable()


@pytest.mark.parametrize(
    "body",
    [b"[1]", b"{", b"\xff", b'"calibrate"', b'{"what":' + b"[" * 4000, b'{"what": "\\u0000"}', b'{"force": {"a": 1}}'],
)
def test_a_body_that_is_no_request_is_refused_in_one_line(tmp_path: Path, body: bytes) -> None:
    async def visitor(visit: Visit) -> None:
        said = await visit.ask("POST", "/undo", body, **visit.good_headers)
        assert (said.status, len(said.json["reason"].splitlines())) == (400, 1)
        assert visit.companion.asked == []

    run(tmp_path, visitor)


def test_the_state_comes_at_once_and_again_after_every_action(tmp_path: Path) -> None:
    async def visitor(visit: Visit) -> None:
        looks = 0

        def status() -> Object:
            nonlocal looks
            looks += 1
            return {"looks": looks}

        visit.companion.status, visit.companion.every_s = status, 3600.0
        viewer = await visit.view()
        head = await viewer.head()
        assert head.headers["content-type"].startswith("text/event-stream")
        assert head.headers["cache-control"] == "no-store"
        kind, hello = await viewer.event()
        assert (kind, hello["token"]) == ("hello", visit.page.access.token)
        assert await viewer.event() == ("message", {"looks": 1})
        assert visit.page.status()["viewers"] == 1
        await visit.ask("POST", "/calibrate", b"{}", **visit.good_headers)
        assert await viewer.event() == ("message", {"looks": 2})
        viewer.writer.close()
        await until(lambda: visit.page.status()["viewers"] == 0)

    run(tmp_path, visitor)


def test_a_foreign_site_is_told_no_token(tmp_path: Path) -> None:
    async def visitor(visit: Visit) -> None:
        for headers in ({"Sec_Fetch_Site": "cross-site"}, {"Origin": "http://evil.example"}):
            viewer = await visit.view(**headers)
            head = await viewer.head()
            assert head.status == 403
            assert "access-control-allow-origin" not in head.headers
            assert visit.page.access.token.encode() not in await viewer.reader.read()

    run(tmp_path, visitor)


def test_the_token_makes_room_among_viewers_without_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "MAX_VIEWERS", 3)
    monkeypatch.setattr(server, "WRONG_TOKEN_S", 0.0)

    async def visitor(visit: Visit) -> None:
        async def looks(query: str = "") -> Viewer:
            viewer = await visit.view(query)
            await viewer.begin()
            return viewer

        token = f"?token={visit.page.access.token}"
        strangers = [await looks() for _ in range(server.MAX_VIEWERS)]
        assert "3 are looking already" in await visit.refusal("?token=222222222222")
        pilots = []
        for displaced in strangers:
            pilots.append(await looks(token))
            assert await displaced.is_ended()
        assert "3 are looking already" in await visit.refusal()
        # Where all have the token the oldest makes way: one phone that reconnects leaves old connections behind.
        pilots.append(await looks(token))
        assert await pilots[0].is_ended()
        for pilot in pilots[1:]:
            await pilot.event()
            await pilot.event()
        assert visit.page.status()["viewers"] == server.MAX_VIEWERS

    run(tmp_path, visitor, bind="0.0.0.0:0")


@pytest.mark.parametrize(("bind", "room"), [("0.0.0.0:0", server.MAX_STRANGERS), ("127.0.0.1:0", server.MAX_VIEWERS)])
def test_one_address_does_not_take_all_room_for_viewers(tmp_path: Path, bind: str, room: int) -> None:
    async def visitor(visit: Visit) -> None:
        for _ in range(room):
            await (await visit.view()).begin()
        assert await visit.refusal()

    run(tmp_path, visitor, bind=bind)


def test_a_viewer_who_does_not_read_is_dropped_and_the_others_see_everything(tmp_path: Path) -> None:
    async def visitor(visit: Visit) -> None:
        number = 0

        def status() -> Object:
            nonlocal number
            number += 1
            return {"number": number, "pad": "x" * 20000}

        visit.companion.status, visit.companion.every_s = status, 0.002
        asleep = await visit.view()
        asleep.writer.transport.pause_reading()  # type: ignore[attr-defined]
        awake = await visit.view()
        await awake.begin()
        seen = [(await awake.event())[1]["number"]]
        async with asyncio.timeout(30.0):
            while visit.page.status()["viewers"] == 2:
                seen.append((await awake.event())[1]["number"])
        for _ in range(5):
            seen.append((await awake.event())[1]["number"])
        assert seen == list(range(seen[0], seen[0] + len(seen)))
        await (await visit.view()).begin()

    run(tmp_path, visitor)


def test_the_last_records_and_a_download(tmp_path: Path) -> None:
    async def visitor(visit: Visit) -> None:
        said = await visit.ask("GET", "/records.json")
        ((file, record),) = [(found["file"], found["record"]) for found in said.json["records"]]
        assert record == RECORD
        assert visit.companion.asked[0] == {"command": "history", "limit": 10}
        download = await visit.ask("GET", f"/records/{file}")
        assert download.json == RECORD
        assert download.headers["content-disposition"] == f'attachment; filename="{file}"'
        assert re.fullmatch(r"[\w.-]+\.json", file)
        assert (await visit.ask("GET", "/records/companion-1970.json")).status == 404

    run(tmp_path, visitor)


def test_beyond_the_board_the_token_is_the_kept_one_and_never_handed_out(tmp_path: Path) -> None:
    async def visitor(visit: Visit) -> None:
        kept = (tmp_path / "web-token").read_text().strip()
        viewer = await visit.view()
        await viewer.head()
        assert (await viewer.event())[1]["token"] is None
        viewer.writer.close()
        wrong = await visit.ask("POST", "/cancel", b"{}", **visit.good_headers | {"X_Companion_Token": "2" * 12})
        assert wrong.status == 403
        assert "companion page" in wrong.json["reason"]
        right = await visit.ask("POST", "/cancel", b"{}", **visit.good_headers | {"X_Companion_Token": kept})
        assert right.status == 200

    run(tmp_path, visitor, bind="0.0.0.0:0")
    assert stat.S_IMODE((tmp_path / "web-token").stat().st_mode) == 0o600


def test_the_kept_token_stays_and_a_useless_one_is_refused(tmp_path: Path) -> None:
    first = access.stored_token(tmp_path)
    assert re.fullmatch(r"([2-9a-hjkmnp-z]{4}-){2}[2-9a-hjkmnp-z]{4}", first)
    assert access.stored_token(tmp_path) == first
    assert access.new_token() != access.new_token()
    for useless in (b"", b"short\n", b"\xff\xfe\n"):
        (tmp_path / "web-token").write_bytes(useless)
        with pytest.raises(StorageError, match="web-token"):
            access.stored_token(tmp_path)


def test_a_token_that_somebody_chose_has_twelve_characters(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, toml = tmp_path / "web-token", tmp_path / "c.toml"
    toml.write_text(
        '[mavlink]\nurl = "udpout:127.0.0.1:9"\n[[imu]]\nname = "fc"\nsource = "autopilot"\n'
        f'[web]\nbind = "192.168.4.1:8191"\n[storage]\ndirectory = "{tmp_path}"\n'
    )
    path.write_text("eleven - chars\n")
    assert companion(["page", "-c", str(toml)]) == 1
    assert capsys.readouterr().err == (
        f"companion: {path}: found a token of 11 characters; allowed: at least 12; remove the file, and a good one is"
        " made\n"
    )
    path.write_text("twelve - chars!\n")
    assert companion(["page", "-c", str(toml)]) == 0
    out = capsys.readouterr().out
    assert out.startswith("token: twelve - chars!\n")
    assert out.endswith("#token=twelve%20-%20chars%21\n")  # no picture into a pipe
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "80")
    assert companion(["page", "-c", str(toml)]) == 0
    shown = capsys.readouterr().out.splitlines()[3:]
    assert [found.text for found in zxingcpp.read_barcodes(seen(shown), try_invert=False)] == [out.split()[-1]]
    assert len(shown) <= 24, "a terminal's height"
    # Where its lines would be broken there is none.
    wide = len(re.sub(r"\x1b\[[\d;]*m", "", shown[0]))
    for columns, words in ((wide, "camera read this"), (wide - 1, f"make this window {wide} columns wide")):
        monkeypatch.setenv("COLUMNS", str(columns))
        assert companion(["page", "-c", str(toml)]) == 0
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

    async def visitor(visit: Visit) -> None:
        def guess() -> asyncio.Task[Answer]:
            headers = visit.good_headers | {"X_Companion_Token": "2" * 12}
            return asyncio.create_task(visit.ask("POST", "/cancel", b"{}", **headers))

        # From one after the other that waits, so many are held back; the next is answered at once.
        waiting = []
        for held in range(1, server.MAX_WAITING + 1):
            waiting.append(guess())
            while visit.page.status()["wrong_tokens"] < held:
                await asyncio.sleep(0)
        beyond = await guess()
        assert beyond.status == 403
        assert not any(task.done() for task in waiting)
        assert (await visit.ask("GET", "/records.json")).status == 200
        right = await visit.ask("POST", "/cancel", b"{}", **visit.good_headers)
        assert right.status == 200
        assert visit.companion.asked[-1] == {"command": "cancel"}
        assert visit.page.status()["wrong_tokens"] == server.MAX_WAITING + 1
        for task in waiting:
            task.cancel()
        await asyncio.gather(*waiting, return_exceptions=True)

    run(tmp_path, visitor, bind="0.0.0.0:0")
    assert caplog.text.count("wrong token from 127.0.0.1") == server.MAX_WAITING + 1
    assert "2" * 12 not in caplog.text


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
