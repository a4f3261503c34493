"""`python -m sim fleet` in one command, and the pages: as HTTP says, and as a phone and a desktop show them."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import signal
import sqlite3
import sys
from pathlib import Path

import pytest

from companion.fleet.store import Store
from companion.mqtt.client import Incoming
from sim.fleet.aircraft import Aircraft
from sim.fleet.demo import AIRCRAFT
from tests.support.broker import MOSQUITTO, free_port
from tests.support.collecting import NOW, basic, get, served

pytestmark = pytest.mark.real_clock

PASSWORD = "Grus grus grus"  # noqa: S105


@pytest.mark.skipif(MOSQUITTO is None, reason="no Mosquitto")
async def test_one_command_shows_a_fleet(tmp_path: Path) -> None:
    port = free_port()
    with (tmp_path / "log").open("wb") as log:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "sim", "fleet", "--page", f"127.0.0.1:{port}"),
            stdout=log,
            stderr=log,
            env={**os.environ, "TMPDIR": str(tmp_path)},
        )
    try:
        async with asyncio.timeout(90.0):
            found: set[str] = set()
            while len(found) < AIRCRAFT:
                assert process.returncode is None, (tmp_path / "log").read_text()
                with contextlib.suppress(OSError, ConnectionError):
                    status, text = await get(port)
                    assert status == 200, text
                    found = set(re.findall(r'href="(/aircraft/\w+)"', text))
                await asyncio.sleep(0.2)
        process.send_signal(signal.SIGINT)
        assert await asyncio.wait_for(process.wait(), 60.0) == 0, (tmp_path / "log").read_text()
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()


async def test_names_and_reasons_of_aircraft_are_no_markup(tmp_path: Path) -> None:
    one = Aircraft(1)
    one.name = "<script>alert(1)</script>"
    one.calibrate(NOW, "<b>&\u202e")
    async with served(tmp_path, one) as port:
        for path in ("/", f"/aircraft/{one.id}"):
            page = (await get(port, path))[1]
            assert "<script" not in page
            assert "<b>" not in page
            assert "\u202e" not in page


async def test_who_lies_is_named(tmp_path: Path) -> None:
    liar, other = Aircraft(1), Aircraft(2)
    other.calibrate(NOW)
    async with served(tmp_path, liar, other) as port:
        assert "Not everything could be taken" not in (await get(port))[1]
        store = Store(str(tmp_path / "fleet.sqlite"))
        for _ in range(3):
            store.take([Incoming(f"fleet/{liar.id}/item", other.told[1])])
        store.take([Incoming(f"fleet/{'f' * 36}/item", b"nonsense")])
        store.close()
        page = (await get(port))[1]
        assert f"<strong>{liar.name}: </strong>says that it is {other.id}" in page
        assert "(3 times, last now)" in page
        assert f"<strong>fleet/{'f' * 36}/item: </strong>" in page


async def test_who_may_look(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.fleet.server.WRONG_PASSWORD_S", 0.01)
    async with served(tmp_path) as port:
        assert (await get(port))[0] == 200
        assert (await get(port, "/", "Host: evil.example"))[0] == 421
        assert (await get(port, "/", "Host: localhost", method="POST"))[0] == 405
    async with served(tmp_path, password=PASSWORD) as port:
        host = "Host: fleet.example"
        status, answer = await get(port, "/", host)
        assert status == 401
        assert 'Basic realm="companion fleet"' in answer
        assert (await get(port, "/", host, basic(PASSWORD)))[0] == 200
        for wrong in (basic(PASSWORD + "x"), basic(""), "Authorization: Basic ~", "Authorization: Bearer x"):
            assert (await get(port, "/", host, wrong))[0] == 401


async def test_a_database_that_cannot_be_read_is_said_and_asked_again(tmp_path: Path) -> None:
    async with served(tmp_path, Aircraft(1)) as port:
        with contextlib.closing(sqlite3.connect(tmp_path / "fleet.sqlite")) as connection:
            connection.execute("DROP TABLE aircraft")
        status, answer = await get(port)
        assert status == 503
        assert "refresh: 2\r\n" in answer  # a phone that looked too soon is not left with it
