"""`companion fleet demo` in one command, and its pages: as HTTP says, and as a phone and a desktop show them."""

from __future__ import annotations

import asyncio
import contextlib
import re
import signal
import sys
from pathlib import Path

import pytest

from companion.fleet.demo import AIRCRAFT
from companion.fleet.simulated import Aircraft
from tests.support import browser
from tests.support.broker import free_port
from tests.support.collecting import NOW, basic, get, served

PASSWORD = "Grus grus grus"  # noqa: S105


@pytest.mark.parametrize("there_is", ["mosquitto", "no mosquitto"])
def test_one_command_shows_a_fleet(tmp_path: Path, there_is: str) -> None:
    port = free_port()
    hidden = "from companion.fleet import demo; demo.find_mosquitto = lambda: None; " * (there_is == "no mosquitto")
    start = (
        f"import sys; {hidden}from companion.cli import main; sys.exit(main(['fleet', 'demo', '--page', sys.argv[1]]))"
    )

    async def main() -> None:
        with (tmp_path / "log").open("wb") as log:
            process = await asyncio.create_subprocess_exec(
                sys.executable, "-c", start, f"127.0.0.1:{port}", stdout=log, stderr=log
            )
        try:
            async with asyncio.timeout(90.0):
                found: set[str] = set()
                while len(found) < AIRCRAFT:
                    assert process.returncode is None, (tmp_path / "log").read_text()
                    with contextlib.suppress(OSError, ConnectionError):
                        found = set(re.findall(r'href="(/aircraft/\w+)"', (await get(port))[1]))
                    await asyncio.sleep(0.2)
            process.send_signal(signal.SIGINT)
            assert await asyncio.wait_for(process.wait(), 60.0) == 0, (tmp_path / "log").read_text()
        finally:
            if process.returncode is None:
                process.kill()
                await process.wait()

    asyncio.run(main())


def test_pages_fit_a_phone_and_a_desktop(tmp_path: Path) -> None:
    if browser.find() is None:
        pytest.skip("no Chromium")
    one, bad = Aircraft(1), Aircraft(2)
    one.live(NOW, 30)
    bad.calibrate(NOW, "not still: " + "gyro_x_" * 30)

    async def main() -> None:
        async with served(tmp_path, one, bad) as port, browser.chromium(tmp_path) as chromium:
            tab = await chromium.tab()
            for size in (browser.PHONE, browser.DESKTOP):
                for path, title in (
                    ("/", "Fleet"),
                    (f"/aircraft/{one.id}", one.name),
                    (f"/aircraft/{bad.id}", bad.name),
                ):
                    await tab.open(f"http://127.0.0.1:{port}{path}", size)
                    await tab.until(f"document.querySelector('h1')?.innerText === {title!r}")
                    assert await tab.value("document.documentElement.scrollWidth") <= size[0], (path, size)

    asyncio.run(main())


def test_an_aircraft_has_all_its_history(tmp_path: Path) -> None:
    one = Aircraft(1)
    one.live(NOW, 12)

    async def main() -> None:
        async with served(tmp_path, one) as port:
            status, page = await get(port, f"/aircraft/{one.id}")
            assert status == 200
            assert page.count("<svg") == 2 * 2 * 3
            # A dot or a mark for each calibration that was done.
            drawn = re.findall(r'd="([^"]*)" class="(?:dot|mark) s[xyz]"', page)
            assert [path.count("M") for path in drawn] == [len(one.biases)] * 12
            assert page.count("<li>") >= 12
            assert (await get(port, f"/aircraft/{'f' * 36}"))[0] == 404
            assert (await get(port, "/../etc/passwd"))[0] == 404

    asyncio.run(main())


def test_names_and_reasons_of_aircraft_are_no_markup(tmp_path: Path) -> None:
    one = Aircraft(1)
    one.name = "<script>alert(1)</script>"
    one.calibrate(NOW, "<b>&\u202e")

    async def main() -> None:
        async with served(tmp_path, one) as port:
            for path in ("/", f"/aircraft/{one.id}"):
                page = (await get(port, path))[1]
                assert "<script" not in page
                assert "<b>" not in page
                assert "\u202e" not in page

    asyncio.run(main())


def test_who_may_look(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.fleet.server.WRONG_PASSWORD_S", 0.01)

    async def main() -> None:
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

    asyncio.run(main())
