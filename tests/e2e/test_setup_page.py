"""`companion setup --page`: the same questions, in a real browser, with simulated devices."""

from __future__ import annotations

import asyncio
import os
import re
from pathlib import Path

import pytest

from tests.e2e.test_setup import bench
from tests.support.browser import PHONE, chromium, find
from tests.support.terminal import Terminal

PICTURES = os.environ.get("PAGE_PICTURES")


@pytest.mark.skipif(find() is None, reason="chromium is not installed: apt-get install chromium")
def test_a_phone_answers_and_there_is_a_configuration(tmp_path: Path) -> None:
    async def main() -> None:
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
                if PICTURES:
                    await tab.picture(Path(PICTURES) / f"setup_{words[:5]}.png")

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
            assert await tab.value("document.documentElement.scrollWidth <= innerWidth")
            assert not await tab.value("document.querySelector('main').offsetParent"), "nothing else is there yet"
            await press("ground")
            await asks("axis, slope or euler")
            # What is typed wrong is said, and asked for again.
            await tab.value("$('words').value = 'round'; $('answer').requestSubmit()")
            await tab.until("$('told').textContent.includes(\"found 'round'; allowed: axis, slope, euler\")")
            await press("euler")
            await asks("gradienter turned")
            await press("180")
            await asks("Write it?")
            assert 'law = "euler"' in await tab.value("$('told').textContent")
            assert not made.file.exists()
            await press("yes")
            await asks("Read all of it?")
            assert "Next:" in await tab.value("$('told').textContent")
            await press("yes")
            assert await terminal.ended() == 0, terminal.screen
            found = made.configuration()
            assert (found["gradienter"]["law"], found["gradienter"]["mounting"]) == ("euler", "ROTATION_YAW_180")
            assert found["web"] == {"bind": "127.0.0.1:0"}, "the daemon's page follows at the same address"
            assert made.told == [], "it only listens"

    asyncio.run(main())


def test_beyond_the_board_it_needs_the_token_that_the_shell_shows(tmp_path: Path) -> None:
    async def main() -> None:
        words = ["-c", str(tmp_path / "companion.toml"), "setup", str(tmp_path / "nobody"), "--udp", "1", "--page"]
        async with Terminal([*words, "0.0.0.0:0", "--mavlink", "udpin:127.0.0.1:14550"], tmp_path) as terminal:
            said = await terminal.says("camera read this")
            (token,) = re.findall(r"token: (\S+)", said)
            (port,) = re.findall(r":(\d+)/#token=", said)
            await terminal.says(r"on a deck.*\n(.*\n)*.*> ")

            async def answer(body: bytes, given: str) -> bytes:
                reader, writer = await asyncio.open_connection("127.0.0.1", int(port))
                head = f"POST /answer HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: {len(body)}\r\n"
                head += f"Content-Type: application/json\r\nX-Companion-Token: {given}\r\n\r\n"
                writer.write(head.encode() + body)
                said = await reader.read()
                writer.close()
                return said

            assert b" 403 " in await answer(b'{"number": 1, "words": "deck"}', "2" * 12)
            assert b"answered already" in await answer(b'{"number": 7, "words": "deck"}', token)
            assert b" 200 " in await answer(b'{"number": 1, "words": "deck"}', token)
            await terminal.says(r"Write it\?")
            assert not (tmp_path / "companion.toml").exists()

    asyncio.run(main())


def test_an_address_that_is_none_is_refused(tmp_path: Path) -> None:
    async def main() -> None:
        words = ["-c", str(tmp_path / "companion.toml"), "setup"]
        for more, why in ((["--page", "pi:80"], "ADDRESS:PORT"), (["--page", "127.0.0.1:0", "--yes"], "asks a person")):
            async with Terminal([*words, *more], tmp_path) as terminal:
                await terminal.says(why)
                assert await terminal.ended() == 2

    asyncio.run(main())
