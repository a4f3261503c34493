"""Alignments on the page: the daemon's own account of the stands, their pictures, and the buttons."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import Any

import pytest

from companion.web import viewers
from tests.e2e.test_align_faces import rig
from tests.e2e.test_page import headline, press
from tests.support.browser import PHONE, Tab, chromium, find
from tests.support.page import page
from tests.support.virtual_time import run_virtual

Object = dict[str, Any]


def test_who_follows_the_pictures_alone_makes_the_stands_and_a_page_opened_later_knows_them(tmp_path: Path) -> None:
    made, hands = rig(tmp_path)

    def shown() -> Object:
        return made.service.status()["stands"] or {"number": 0}

    async def main() -> None:
        async with made.running():
            await made.ready()
            assert made.service.status()["stands"] is None
            assert await press(made, "align", action="faces") == (200, "measurement on all sides started")
            held = []
            for number in (1, 2, 3):
                await made.until(lambda number=number: shown()["number"] == number, 60.0)  # type: ignore[misc]
                x, y, z = shown()["hold"]["up"]
                pitch, roll = math.degrees(math.asin(x)), math.degrees(math.atan2(-y, -z))
                held.append((x, y, z))
                hands.hold(made.aircraft.time_at(made.now_s), pitch, roll)
                await made.until(lambda: shown()["share"] > 0.5, 60.0)
                assert headline(made)[1].startswith("MEASURING")
            await made.until(lambda: shown()["number"] == 4, 60.0)
            # Three stands leave much open: each figure once, the one that the wish names among them.
            unknown = shown()["unknown"]
            assert 3 <= len(set(unknown)) == len(unknown) <= 6
            assert shown()["wish"].partition(": ")[2] in unknown
            assert len({tuple(round(value) for value in up) for up in held}) == 3
            for up, read in zip(held, shown()["done"], strict=True):
                assert math.dist(up, read) < math.radians(15.0)  # hands, and a scale that is wrong
            # The stand before once more is named, and asked for anew.
            hands.hold(made.aircraft.time_at(made.now_s), pitch + 25.0, roll)
            hands.hold(made.aircraft.time_at(made.now_s) + 10.0, pitch, roll)
            await made.until(lambda: shown()["objection"] is not None, 90.0)
            assert "it stands as in stand" in shown()["objection"]
            assert shown()["outcome"] is None
            assert (await press(made, "align", action="turn"))[0] == 409
            assert (await press(made, "cancel"))[0] == 200
            ended = shown()
            assert (ended["outcome"], len(ended["done"])) == ("cancelled", 3)
            assert ended["words"] == "cancelled by the page's cancel"

            assert await press(made, "align", action="turn") == (200, "turn on the spot started")
            await made.until(lambda: shown()["total"] == 5, 10.0)
            assert shown()["hold"] == {"up": (0.0, 0.0, -1.0), "turn_deg": 0.0}
            assert shown()["done"] == []
            await press(made, "cancel")

    run_virtual(main())


def status(stands: Object | None, **more: Any) -> Object:
    none = {"sigma": None, "wanted": 5.0, "met": None}
    return {
        "headline": {"word": "WAITING", "reason": "as it says", "tone": "wait"},
        "vehicle": {"summary": "ArduPilot", "heartbeat_age_s": 0.1, "bad": 0, "messages": 1},
        "progress": None, "pose": None, "calibration": None, "last": None, "devices": [], "mqtt": None, "warnings": [],
        "arming": {"state": "calibrated", "in_force": "", "setup": None, "quality": {"gyro": none, "accel": none}},
        "ground_stations": {"good": True, "summary": ""}, "recording": {"fault": None}, "automatic": {"stopped": None},
        "why_no_undo": "nothing", "undoable": [], "by_hand": [], "spoken": [], "stands": stands, **more,
    }  # fmt: skip


def stand(up: tuple[float, float, float], **more: Any) -> Object:
    return {
        "kind": "measurement on all sides", "number": 3, "total": 12, "wish": "nose down: z scale uncertain by 0.4 %",
        "hold": {"up": up, "turn_deg": 0.0}, "words": "", "unknown": ["z scale 0.4 %", "x bias 1 mg"],
        "objection": None, "share": 0.25,
        "done": [(0.0, 0.0, -1.0), (1.0, 0.0, 0.0)], "outcome": None, **more,
    }  # fmt: skip


# How far down the picture: the tip of the nose, the tip of the fin, its root.
TIPS = """(() => { const down = name => document.querySelector('#how .' + name).getAttribute('d').slice(1).split('L')
    .map(point => parseFloat(point.split(' ')[1])); return [down('nose')[0], down('fin')[1], down('fin')[0]]; })()"""


@pytest.mark.skipif(find() is None, reason="chromium is not installed: apt-get install chromium")
def test_the_page_shows_how_to_hold_it_and_asks_for_what_is_pressed(tmp_path: Path) -> None:
    async def main() -> None:
        async with page(tmp_path) as visit, chromium(tmp_path / "profile") as browser:

            async def show(tab: Tab, what: Object, until: str) -> None:
                visit.companion.status = lambda: what
                await tab.until(until)

            visit.companion.status = lambda: status(None)
            tab = await browser.tab()
            await tab.open(visit.page.url, PHONE)
            await tab.until("document.querySelector('#word span')?.textContent === 'WAITING'")
            assert await tab.value("$('stands').hidden && $('known').getAttribute('visibility') === 'hidden'")
            assert await tab.value("$('unknown').getAttribute('visibility')") == "visible"
            assert await tab.value("[...document.querySelectorAll('.wants-gradienter')].every(it => it.hidden)")

            await tab.value("$('align').open = true; $('write').checked = true")
            await tab.value("document.querySelector('#align button').scrollIntoView({block: 'center'})")
            await tab.touch("#align button.hold")
            await tab.until("!$('said').hidden && $('said').textContent === 'align faces --write: calibration started'")
            await tab.lift()
            assert visit.companion.asked[-1] == {"command": "align", "action": "faces", "write": True, "wait": False}

            down = stand((-1.0, 0.0, 0.0))
            await show(tab, status(down, progress=20), "!$('stands').hidden")
            nose_y, fin_y, root_y = await tab.value(TIPS)
            assert nose_y > fin_y + 50.0
            assert await tab.value("$('wish').textContent") == "nose down"
            assert await tab.value("$('still').textContent") == "still unknown: z scale 0.4 %, x bias 1 mg"
            assert await tab.value("document.querySelectorAll('#done li').length") == 12
            assert await tab.value("document.querySelectorAll('#done svg.hold').length") == 2
            assert await tab.value("document.querySelector('#align button').disabled && !$('cancel').disabled")
            up = stand((1.0, 0.0, 0.0), wish="nose up: x bias uncertain by 1 mg", share=0.5)
            await show(tab, status(up, progress=20), "$('wish').textContent === 'nose up'")
            nose_y, fin_y, root_y = await tab.value(TIPS)
            assert nose_y < fin_y - 50.0
            # On its back the fin is below the fuselage; level, above.
            for z, sign in ((1.0, 1.0), (-1.0, -1.0)):
                flat = stand((0.0, 0.0, z), wish=f"flat {z}")
                await show(tab, status(flat, progress=20), f"$('wish').textContent === 'flat {z}'")
                nose_y, fin_y, root_y = await tab.value(TIPS)
                assert await tab.value("document.querySelector('#how .arrow')") is None
                assert sign * (fin_y - root_y) > 10.0
            turn = stand((0.0, 0.0, -1.0), hold={"up": (0.0, 0.0, -1.0), "turn_deg": 90.0}, wish="turn it by 90 deg")
            await show(tab, status(turn, progress=20), "document.querySelector('#how .arrow')")
            wrong = turn | {"objection": "it stands 50 deg from where it stood first", "share": 0.0}
            await show(tab, status(wrong, progress=20), "$('still').className === 'objection'")

            # Closed and opened again, it goes on where it was.
            before = await tab.value("$('stands').innerText")
            await tab.open("about:blank", PHONE)
            await tab.open(visit.page.url, PHONE)
            await tab.until("document.querySelector('#stands:not([hidden])')")
            assert await tab.value("$('stands').innerText") == before
            ended = turn | {"outcome": "done", "words": "accel bias known to 0.12 mg: written"}
            await show(tab, status(ended), "$('result').textContent.endsWith('written')")
            assert await tab.value("$('now').offsetParent") is None

    asyncio.run(main())


@pytest.mark.skipif(find() is None, reason="chromium is not installed: apt-get install chromium")
def test_a_page_without_room_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(viewers, "MAX_VIEWERS", 1)

    async def main() -> None:
        async with page(tmp_path) as visit, chromium(tmp_path / "profile") as browser:
            visit.companion.status = lambda: status(None)
            first = await visit.view(f"?token={visit.page.access.token}")
            await first.begin()
            tab = await browser.tab()
            await tab.open(visit.page.url, PHONE)
            await tab.until("document.querySelector('#word span')?.textContent === 'NO LINK'")
            await tab.until("$('reason').textContent.startsWith('1 are looking already; the token makes room')")
            first.writer.close()
            await tab.until("document.querySelector('#word span')?.textContent === 'WAITING'")

    asyncio.run(main())
