"""The control socket: who may use it, what happens to a stale one, and clients that misbehave."""

from __future__ import annotations

import asyncio
import gc
import grp
import os
import socket
import stat
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from companion.daemon.interfaces import control
from companion.daemon.interfaces.control import ControlServer
from companion.errors import CalibrationRefusedError, LinkError
from companion.formats import Object
from companion.links.system import connection
from companion.links.system.connection import ask

pytestmark = pytest.mark.real_clock


async def _echo(request: Object) -> AsyncIterator[Object]:
    if request.get("command") == "refuse":
        raise CalibrationRefusedError("moved")
    if request.get("command") == "break":
        raise ZeroDivisionError
    yield {"kind": "progress", "n": 1}
    yield {"kind": "result", "request": request}


async def _all(path: Path, request: Object) -> list[Object]:
    return [reply async for reply in ask(path, request)]


async def test_request_progress_result_and_errors(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "control.sock"
    async with ControlServer(path, _echo):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        replies = await _all(path, {"command": "x", "long": "y" * 5000})
        assert [reply["kind"] for reply in replies] == ["progress", "result"]
        assert replies[-1]["request"]["long"] == "y" * 5000
        assert await _all(path, {"command": "refuse"}) == [{"kind": "error", "reason": "moved"}]
        (broken,) = await _all(path, {"command": "break"})
        assert "internal error" in broken["reason"]
    assert not path.exists()


async def test_a_group_may_use_it_too(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    ours = grp.getgrgid(os.getgid()).gr_name
    async with ControlServer(path, _echo, group=ours):
        assert stat.S_IMODE(path.stat().st_mode) == 0o660
        assert path.stat().st_gid == os.getgid()


async def test_a_stale_socket_is_replaced_and_a_live_one_refused(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    stale = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    stale.bind(str(path))
    stale.close()  # what kill -9 leaves
    async with ControlServer(path, _echo):
        assert (await _all(path, {"command": "x"}))[-1]["kind"] == "result"
        with pytest.raises(LinkError, match="another companion is running"):
            async with ControlServer(path, _echo):
                pass
        assert (await _all(path, {"command": "x"}))[-1]["kind"] == "result"


async def test_a_file_in_the_way_is_not_removed(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"
    path.write_text("precious")
    with pytest.raises(LinkError, match="not a socket"):
        async with ControlServer(path, _echo):
            pass
    assert path.read_text() == "precious"


@pytest.mark.parametrize(
    "line",
    [
        b"\n",
        b"{\n",
        b"[1]\n",
        b"\xff\xfe\n",
        b"x" * 70000 + b"\n",
        b"[" * 30000 + b"\n",
        b'{"command": ' + b"[" * 30000 + b"\n",
        b'{"command": "calibrate", "what": {"both": 1}}\n',
        b'{"command": "calibrate", "timeout_s": NaN}\n',
        b'{"command": "record", "file": "a\\u0000b"}\n',
    ],
)
async def test_garbage_is_answered_with_one_error_line(
    tmp_path: Path, line: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "control.sock"
    async with ControlServer(path, _echo):
        reader, writer = await asyncio.open_unix_connection(str(path))
        writer.write(line)
        answer = await reader.read()
        writer.close()
    assert b"request not understood" in answer
    assert answer.count(b"\n") == 1
    assert len(answer) < 300
    assert not caplog.records


async def monitoring(request: Object) -> AsyncIterator[Object]:
    if request.get("command") != "monitor":
        yield {"kind": "result", "command": request["command"]}
    while request.get("command") == "monitor":
        yield {"kind": "progress", "pad": "x" * 4000}
        await asyncio.sleep(0)


async def _connected(path: Path, line: bytes = b"") -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    reader, writer = await asyncio.open_unix_connection(str(path), limit=16)
    writer.write(line)
    return reader, writer


@pytest.mark.parametrize("command", control.URGENT)
async def test_no_crowd_keeps_cancel_and_status_out(tmp_path: Path, command: str) -> None:
    path = tmp_path / "control.sock"
    async with ControlServer(path, monitoring), asyncio.timeout(30.0):
        deaf = [await _connected(path, b'{"command": "monitor"}\n') for _ in range(control.MAX_CLIENTS)]
        for reader, _ in deaf:
            await reader.readexactly(1)
        silent = [await _connected(path) for _ in range(3 * control.MAX_CLIENTS)]
        assert await _all(path, {"command": command}) == [{"kind": "result", "command": command}]
        (full,) = await _all(path, {"command": "monitor"})
        assert full == {"kind": "error", "reason": "the daemon has too many clients at once; try again"}
        for _, writer in deaf + silent:
            writer.transport.abort()


def test_a_burst_of_silent_clients_leaves_no_descriptor_open(tmp_path: Path) -> None:
    path = tmp_path / "control.sock"

    async def main() -> None:
        async with ControlServer(path, _echo), asyncio.timeout(30.0):
            before = len(os.listdir("/proc/self/fd"))
            silent = [socket.socket(socket.AF_UNIX) for _ in range(4 * control.MAX_CLIENTS)]
            for client in silent:  # all are there before the loop turns, so that most are evicted at once
                client.connect(str(path))
            evicted = silent[: -control.MAX_CLIENTS]
            loop = asyncio.get_running_loop()
            for client in evicted:
                client.setblocking(False)
                assert await loop.sock_recv(client, 1) == b""
            served = len(os.listdir("/proc/self/fd")) - before - len(silent)
            assert served <= control.MAX_CLIENTS
            for client in silent:
                client.close()

    gc.disable()  # it would close some of what is left open
    try:
        asyncio.run(main())
    finally:
        gc.enable()


async def test_who_does_not_read_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "READ_TIMEOUT_S", 0.2)
    monkeypatch.setattr(control, "READ_TIMEOUT_S", 0.2)
    path = tmp_path / "control.sock"
    async with ControlServer(path, monitoring), asyncio.timeout(30.0):
        deaf = [await _connected(path, b'{"command": "monitor"}\n') for _ in range(control.MAX_CLIENTS)]
        while "too many clients" in str(await anext(ask(path, {"command": "monitor"}))):
            await asyncio.sleep(0.05)
        for _, writer in deaf:
            writer.transport.abort()
