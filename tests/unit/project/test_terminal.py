"""External text is shown and moves no cursor: every command, with hostile names and texts in all places."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import re
import socketserver
import sys
import threading
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any, cast

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.cli import main, monitor
from companion.daemon.process.check import CheckLine
from companion.errors import LinkError
from companion.formats import printable
from companion.ground.heard import Address, GroundListener
from companion.links.serial.ports import Holder, SerialPort
from companion.links.system.process import JournalFormatter, OneLineFormatter
from tests.support.ground_wire import StationOnTheWire
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

Object = dict[str, Any]

EVIL = "\x1b[2J\x1b]0;owned\x07\n\r\x08\x00\x9b31m\x7f\x85\u202e\u200b\u2028"
SHOWN = r"\x1b[2J\x1b]0;owned\x07\n\r\x08\x00\x9b31m\x7f\x85\u202e\u200b\u2028"
BYTE = "\udcff"
"""Byte of a name that is not UTF-8, as Python decodes it."""
CONFIG = '[mavlink]\nurl = "udpout:127.0.0.1:9"\n[[imu]]\nname = "fc"\nsource = "autopilot"\n'
LOOKED_UP = ("kind", "verdict", "tone", "heading_from")
"""Keys whose values the program itself looks up."""


def poisoned(value: Any, key: str = "") -> Any:
    """Put EVIL before every text and into every name that is not a key of ours."""
    if isinstance(value, str):
        return value if key in LOOKED_UP else EVIL + value
    if isinstance(value, list):
        return [poisoned(item) for item in value]
    if isinstance(value, dict):
        foreign = key in ("written", "refused")
        return {EVIL + name if foreign else name: poisoned(item, name) for name, item in value.items()}
    return value


def clean(words: str) -> str:
    """Output, checked to contain nothing that a terminal obeys."""
    bad = {letter for letter in words if not letter.isprintable() and letter != "\n"}
    assert not bad, f"{bad} in {words!r}"
    return words


@pytest.fixture(scope="module")
def replies(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Object]:
    found: dict[str, Object] = {}

    async def asked() -> None:
        async with Rig(tmp_path_factory.mktemp("rig"), own_imu=True).running() as rig:
            await rig.ready()
            for request in (
                {"command": "calibrate", "what": "both", "wait": True},
                {"command": "history"},
                {"command": "temperature"},
                {"command": "undo"},
                {"command": "cancel"},
                {"command": "status"},
                {"command": "align", "action": "show"},
                {"command": "autopilot-setup"},
            ):
                async for reply in rig.service.faces.answer(request):
                    found[f"{request['command']}{' under way' if reply['kind'] == 'progress' else ''}"] = reply

    run_virtual(asked())
    return cast("dict[str, Object]", json.loads(json.dumps(found, default=msgspec.to_builtins)))


class _Daemon(socketserver.ThreadingUnixStreamServer):
    """Answers what it is told to, on the control socket."""

    replies: list[Object]


class _Answer(socketserver.StreamRequestHandler):
    def handle(self) -> None:
        self.rfile.readline()
        for reply in cast("_Daemon", self.server).replies:
            self.wfile.write(json.dumps(reply).encode() + b"\n")


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "c.toml"
    path.write_text(f'{CONFIG}[control]\nsocket = "{tmp_path}/s"\n[storage]\ndirectory = "{tmp_path}"\n')
    return path


@pytest.fixture
def daemon(config: Path) -> Iterator[_Daemon]:
    with _Daemon(str(config.parent / "s"), _Answer) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,))
        thread.start()
        yield server
        server.shutdown()
        thread.join()


COMMANDS = [
    ["status"],
    ["calibrate"],
    ["cancel"],
    ["undo"],
    ["history"],
    ["autopilot", "temperature"],
    ["align", "show"],
    ["autopilot", "params"],
]


@pytest.mark.parametrize("form", [[], ["--json"]])
@pytest.mark.parametrize("words", COMMANDS)
def test_what_the_daemon_says(
    daemon: _Daemon,
    config: Path,
    replies: dict[str, Object],
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    form: list[str],
) -> None:
    name = {"params": "autopilot-setup", "temperature": "temperature"}.get(words[-1], words[0])
    under_way = [replies[f"{name} under way"]] if f"{name} under way" in replies else []
    daemon.replies = poisoned([*under_way, replies[name]])
    main(["-c", str(config), *form, *words])
    out, said = capsys.readouterr()
    assert "owned" in clean(out + said)
    if form:
        assert EVIL in "".join(texts(json.loads(out)))


def texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, list | dict):
        for item in value.values() if isinstance(value, dict) else value:
            yield from texts(item)


def test_the_monitor_in_a_pipe(replies: dict[str, Object], capsys: pytest.CaptureFixture[str]) -> None:
    view = monitor._Lines()
    view.show(poisoned(replies["status"]["status"]))
    view.gone(EVIL)
    out = clean(capsys.readouterr().out)
    assert f"NO DAEMON: {SHOWN}; waiting for it\n" in out
    assert SHOWN in out.splitlines()[0]


def test_other_figures_are_no_news_in_a_pipe(replies: dict[str, Object], capsys: pytest.CaptureFixture[str]) -> None:
    view, status = monitor._Lines(), dict(replies["status"]["status"])
    for reason, lines in (("still for 3.5 s", None), ("still for 4 s", 0), ("it moves", 1), ("still for 5 s", 1)):
        view.show(status | {"headline": status["headline"] | {"reason": reason}})
        printed = capsys.readouterr().out.splitlines()
        assert lines is None or len(printed) == lines


OURS = re.compile(r"\x1b\[(2J|\?25[lh]|H|K|J|[0-9;]*m)")


def test_the_monitor_on_a_terminal(replies: dict[str, Object], capsys: pytest.CaptureFixture[str]) -> None:
    view = monitor._Screen()
    view.show(poisoned(replies["status"]["status"]))
    view.gone(EVIL)
    view.close()
    out = capsys.readouterr().out
    assert " ".join(SHOWN[:8]) in clean(OURS.sub("", out))
    # One more than ours, at the beginning, would be the one of EVIL.
    assert out.count("\x1b[2J") == 1


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_what_is_on_the_ports(
    config: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, form: list[str]
) -> None:
    async def listen(port: str, first: object = ()) -> object:
        raise LinkError(f"{port}: {EVIL}")

    port = SerialPort(
        device=f"/dev/{EVIL}", stable_name=f"/dev/serial/by-id/{EVIL}", by_id=(), by_path=(), aliases=(EVIL,),
        description=EVIL, driver=EVIL, vendor_id=None, product_id=None, serial_number=EVIL,
        latency_timer_ms=None, is_console=False, holders=(Holder(1, EVIL),),
    )  # fmt: skip
    monkeypatch.setattr("companion.links.serial.ports.list_ports", lambda: [port])
    monkeypatch.setattr("companion.links.serial.listening.listen", listen)
    for more in ([], ["--listen"]):
        assert main([*form, "ports", *more]) == 0
        out, said = capsys.readouterr()
        assert SHOWN in clean(out + said) or EVIL in "".join(texts(json.loads(out)))


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_what_the_check_finds(
    config: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, form: list[str]
) -> None:
    async def run_check(*_: object) -> list[CheckLine]:
        logging.getLogger("companion.links").warning("the autopilot says %s", EVIL)
        return [CheckLine(EVIL, good=False, words=EVIL), CheckLine("fine", good=True, words=f"firmware {EVIL}")]

    monkeypatch.setattr("companion.daemon.process.check.run_check", run_check)
    monkeypatch.setattr(logging.getLogger(), "handlers", [])  # as outside of a test
    assert main(["-c", str(config), *form, "check"]) == 1
    out, said = capsys.readouterr()
    assert "owned" in clean(out)
    assert clean(said) == f"the autopilot says {SHOWN}\n"


@pytest.mark.real_clock
@pytest.mark.parametrize("form", [[], ["--json"]])
def test_what_is_heard_on_the_ground(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, form: list[str]
) -> None:
    @contextlib.asynccontextmanager
    async def open_link(_url: str, heard: GroundListener, _key: bytes | None) -> AsyncIterator[StationOnTheWire]:
        wire, beat = StationOnTheWire(), {"type": 18, "autopilot": 8, "base_mode": 0, "system_status": 3}
        wire.heard = heard
        wire.values = {"CMP_STATE": 1.0, f"CMP_{EVIL}": 1.0}
        heard.update("HEARTBEAT", Address(1, 191), beat, asyncio.get_running_loop().time())
        text = {"severity": mavlink.MAV_SEVERITY_CRITICAL, "text": EVIL, "id": 0, "chunk_seq": 0}
        heard.update("STATUSTEXT", Address(1, 191), text, asyncio.get_running_loop().time())
        yield wire

    monkeypatch.setattr("companion.ground.link.open_link", open_link)
    main(["ground", "status", *form])
    out, said = capsys.readouterr()
    clean(out + said)
    assert not form or "owned" in out


@pytest.mark.parametrize(
    "words",
    [
        ["log", "replay", f"/nowhere/{EVIL}{BYTE}"],
        ["log", "profile", f"/nowhere/{EVIL}{BYTE}"],
        ["report", "--storage", f"/nowhere/{EVIL}{BYTE}"],
        ["history", "-c", f"/nowhere/{EVIL}{BYTE}"],
        ["status", EVIL],
        [EVIL],
        ["history", "-n", EVIL],
        ["ground", "status", "--url", EVIL],
    ],
)
def test_what_a_file_or_an_argument_is_called(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    words = [word.replace("\0", "") for word in words]  # no file and no argument can have one
    with contextlib.suppress(SystemExit):
        assert main(words) in (1, 2)
    out, said = capsys.readouterr()
    assert "owned" in clean(said)
    assert said.count("\n") == 1
    assert out == ""


@pytest.mark.parametrize("formatter", [JournalFormatter, OneLineFormatter])
def test_what_is_logged_is_one_line(formatter: type[logging.Formatter]) -> None:
    try:
        raise ValueError(EVIL)
    except ValueError:
        trouble = sys.exc_info()
    record = logging.LogRecord("a", logging.WARNING, "f", 1, "heard %s", (EVIL,), None)
    said = clean(formatter("%(levelname)s %(message)s").format(record))
    assert said.endswith(f"WARNING heard {SHOWN}")
    assert "\n" not in said
    assert record.getMessage() == f"heard {EVIL}", "others read it as it was"
    record.exc_info = trouble
    assert "Traceback" in clean(formatter("%(message)s").format(record))


@given(st.text())
def test_whatever_the_text_is_it_can_be_printed(text: str) -> None:
    shown = printable(text)
    assert shown.isprintable()
    assert shown == text or not text.isprintable()
    shown.encode("utf-8")
