"""`companion setup --page`: the same questions, in a real browser, with simulated devices."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.e2e.test_setup import bench
from tests.support.browser import PHONE, chromium, find
from tests.support.first_run import answer
from tests.support.terminal import Terminal

pytestmark = pytest.mark.real_clock


@pytest.mark.skipif(find() is None, reason="chromium is not installed: apt-get install chromium")
async def test_a_phone_answers_and_there_is_a_configuration(tmp_path: Path) -> None:
    async with (
        bench(tmp_path) as made,
        Terminal([*made.words("gradienter"), "--page", "127.0.0.1:0", "--no-check"], tmp_path) as terminal,
        chromium(tmp_path / "profile") as browser,
    ):
        said = await terminal.says(r"http://127\.0\.0\.1:(\d+)/ needs no token")
        port = re.findall(r":(\d+)/ needs", said)[0]
        tab = await browser.tab()
        await tab.open(f"http://127.0.0.1:{port}/", PHONE)

        async def asks(words: str) -> None:
            await tab.until(f"!$('answer').hidden && $('question').textContent.includes({words!r})")

        async def press(words: str) -> None:
            selector = f"#choices button:nth-child({1 + (await choices()).index(words)})"
            await tab.value(f"document.querySelector({selector!r}).scrollIntoView({{block: 'center'}})")
            await tab.touch(selector)
            await tab.lift()

        async def choices() -> list[str]:
            found: list[str] = await tab.value(
                "[...document.querySelectorAll('#choices button')].map(it => it.textContent)"
            )
            return found

        await asks("on the ground, or on a deck")
        assert "inclinometer_xy, a device for gradienter" in await tab.value("$('told').textContent")
        assert await choices() == ["ground", "deck"]
        assert not await tab.value("document.querySelector('main').offsetParent"), "nothing else is there yet"
        await press("ground")
        await asks("axis, slope, euler or test")
        # What is typed wrong is said, and asked for again.
        await tab.value("$('words').value = 'round'; $('answer').requestSubmit()")
        await tab.until("$('told').textContent.includes(\"found 'round'; allowed: axis, slope, euler\")")
        await press("euler")
        await asks("gradienter turned")
        await press("180")
        await asks("IMU 1 of the autopilot")
        assert await choices() == ["icm42688p", "bmi088", "adis16470", "adis16405", "unknown"]
        await press("icm42688p")
        await asks("Write it?")
        assert 'law = "euler"' in await tab.value("$('told').textContent")
        assert not made.file.exists()
        await press("yes")
        await asks("Read all of it?")
        steps = (await tab.value("$('told').textContent")).partition("Next:")[2]
        assert "hold ZERO, below ALIGN" in steps
        assert "hold CALIBRATE" in steps
        then = f"Next, on the board: companion -c {made.file} run. Then this page shows the companion."
        assert await tab.value("$('hint').textContent") == then
        await press("yes")
        assert await terminal.ended() == 0, terminal.screen
        # Its page is gone, and a browser still shows what comes next.
        await tab.until("Date.now() - heardAt > 2 * GONE_MS")
        shown = await tab.value("[$('word').textContent.trim(), $('reason').textContent, document.body.className]")
        assert shown == ["SET-UP DONE", then, "setup"]
        found = made.configuration()
        assert (found["gradienter"]["law"], found["gradienter"]["mounting"]) == ("euler", "ROTATION_YAW_180")
        assert found["imu"] == [{"name": "fc", "source": "autopilot", "profile": "icm42688p"}]
        assert found["web"] == {"bind": "127.0.0.1:0"}, "the daemon's page follows at the same address"
        assert made.told == [], "it only listens"


async def test_beyond_the_board_it_needs_the_token_that_the_shell_shows(tmp_path: Path) -> None:
    words = ["-c", str(tmp_path / "companion.toml"), "setup", str(tmp_path / "nobody"), "--udp", "1", "--no-check"]
    words += ["--page", "0.0.0.0:0", "--mavlink", "udpin:127.0.0.1:14550"]
    async with Terminal(words, tmp_path) as terminal:
        said = await terminal.says("camera read this")
        (token,) = re.findall(r"token: (\S+)", said)
        (port,) = re.findall(r":(\d+)/#token=", said)
        await terminal.says(r"on a deck.*\n(.*\n)*.*> ")

        assert b" 403 " in await answer(int(port), "2" * 12, 1, "deck")
        assert b"answered already" in await answer(int(port), token, 7, "deck")
        assert b" 200 " in await answer(int(port), token, 1, "deck")
        await terminal.says(r"Which part.*\n(.*\n)*.*> ")
        assert b" 200 " in await answer(int(port), token, 2, "unknown")
        await terminal.says(r"Write it\?")
        assert not (tmp_path / "companion.toml").exists()
        assert (tmp_path / "companion-state/web-token").read_text() == f"{token}\n", "the daemon's page takes it too"


async def test_an_address_that_is_none_is_refused(tmp_path: Path) -> None:
    words = ["-c", str(tmp_path / "companion.toml"), "setup"]
    for more, why in ((["--page", "pi:80"], "ADDRESS:PORT"), (["--page", "127.0.0.1:0", "--yes"], "asks a person")):
        async with Terminal([*words, *more], tmp_path) as terminal:
            await terminal.says(why)
            assert await terminal.ended() == 2
