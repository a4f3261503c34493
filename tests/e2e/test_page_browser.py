"""The page in a real browser, with the real daemon as a process: what a finger in a glove does to it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import re
import stat
import sys
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import pytest

from companion.estimation.records.record import Record, from_json
from companion.storage.records import RecordStore
from sim.ardupilot.double import ArduPilotDouble
from tests.e2e.test_calibration import calibrated
from tests.e2e.test_commands import (
    DONE,
    FAILED,
    FlightLine,
    _end,
    _until_disarmed,
    companion,
    flight_line,
    until_status,
)
from tests.support.browser import DESKTOP, PHONE, Tab, chromium, find
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

pytestmark = [
    pytest.mark.skipif(find() is None, reason="chromium is not installed: apt-get install chromium"),
    pytest.mark.real_clock,
]

WORD = "document.querySelector('#word span').textContent"
SAID = "(document.querySelector('#said').hidden ? '' : document.querySelector('#said').textContent)"


class PageScene(NamedTuple):
    line: FlightLine
    tab: Tab
    url: str

    async def status(self) -> Any:
        said = await companion("-c", str(self.line.config), "status", "--json")
        return said.json


@contextlib.asynccontextmanager
async def scene(
    folder: Path, bind: str, size: tuple[int, int], still_s: tuple[float, float] = (3.0, 4.0)
) -> AsyncIterator[PageScene]:
    async with (
        flight_line(folder, more=f'[web]\nbind = "{bind}"\n', still_s=still_s) as line,
        chromium(folder / "profile") as browser,
    ):
        await until_status(line.config, "where the page is", lambda status: bool(status["page"]["url"]))
        status = await companion("-c", str(line.config), "status", "--json")
        port = re.search(r":(\d+)/$", status.json["page"]["url"])
        assert port is not None
        # The same port again after a restart: the one that the kernel has picked.
        line.config.write_text(line.config.read_text().replace(f'"{bind}"', f'"{bind.removesuffix("0")}{port[1]}"'))
        url = f"http://127.0.0.1:{port[1]}/"
        tab = await browser.tab()
        await tab.open(url, size)
        await tab.until(f"{WORD} === 'NOT CALIBRATED'")
        yield PageScene(line, tab, url)


async def pixels_needed(tab: Tab) -> int:
    """Excess width of the page over the screen."""
    return int(await tab.value("document.documentElement.scrollWidth - document.documentElement.clientWidth"))


async def read_the_record(here: PageScene, record: Record) -> None:
    """Bars of the last calibration, and its download."""
    tab = here.tab
    await tab.until("document.querySelectorAll('#records details').length === 1")
    assert await tab.value("document.querySelectorAll('.scale').length") == 12
    assert "before this start" in await tab.value("document.querySelector('#age').textContent")
    shown = await tab.value("document.querySelector('.axis b:last-child').textContent")
    gyro = [record.imus[0].gyro_bias_rad_s, record.imus[0].gyro_sigma_use_rad_s]
    x_deg_h, sigma_deg_h = (math.degrees(axes[0]) * 3600.0 for axes in gyro if axes is not None)
    assert shown == f"{x_deg_h:+.1f} ± {sigma_deg_h:.1f}"
    # What was held back is not to be taken for what is in force.
    titles = await tab.value("[...document.querySelectorAll('#imus h3')].map(it => it.textContent)")
    marked = [title.endswith(", held back") for title in titles if "bias" in title]
    assert marked == [triad in imu.held_back for imu in record.imus for triad in ("gyro", "accel")]
    words = await tab.value("[...document.querySelectorAll('#imus .note')].map(it => it.textContent)")
    assert words == ["held back: measured, not written; what was in force before still is"]
    assert await tab.value("document.querySelectorAll('.axis.held').length") == 3
    await tab.value("document.querySelector('#imus .held').scrollIntoView({block: 'center'})")
    await tab.value("document.querySelector('#records details').open = true")
    await tab.value("document.querySelector('#records').scrollIntoView()")
    told = await tab.value("document.querySelector('#records details').textContent")
    assert told.count("(held back, not written)") == 1
    assert "accelerometer (held back, not written) " in told
    assert await pixels_needed(tab) == 0
    link = await tab.value("document.querySelector('#records details a').href")
    text = await tab.value(f"fetch({link!r}).then(answer => answer.text())")
    assert from_json(text.encode()) == record
    await tab.value("scrollTo(0, 0)")


def test_a_phone_on_the_field(tmp_path: Path) -> None:
    async def on_the_bench() -> Record:
        async with Rig(tmp_path / "bench", own_imu=True, max_s=12.0).running() as rig:
            await rig.ready()
            return (await calibrated(rig))[1]

    record = run_virtual(on_the_bench())
    fc, own = record.imus
    fc = msgspec.structs.replace(
        fc, held_back=("accel",), written={name: what for name, what in fc.written.items() if "GYR" in name}
    )
    record = msgspec.structs.replace(record, imus=(fc, own), reason=f"{record.reason}; accelerometers of fc held back")
    (tmp_path / "state").mkdir()
    RecordStore(tmp_path / "state").save(record)

    async def main() -> None:
        async with scene(tmp_path, "127.0.0.1:0", PHONE) as here:
            tab = here.tab
            # On a busy computer the first reason can be a pause in the telemetry.
            await tab.until("document.querySelector('#reason').textContent === 'not confirmed since start: calibrate'")
            assert await pixels_needed(tab) == 0
            for button in ("calibrate", "cancel", "undo"):
                box = f"document.querySelector('#{button}').getBoundingClientRect()"
                assert await tab.value(f"{box}.height >= 80 && {box}.width >= 90 && {box}.bottom <= innerHeight")
            await read_the_record(here, record)
            # An offset left unchanged is shown as it is active: the new measurement less its residual.
            kept = json.dumps({"name": "fc", "unchanged": ["gyro"], "gyro_bias_deg_h": [150.0, 0.0, 0.0]})
            residual = {"name": "fc", "residual_gyro_rad_s": [math.radians(1 / 360), 0.0, 0.0]}
            found = json.dumps({"started_at": "now", "imus": [residual]})
            await tab.value(f"recordsRead = [{{record: {found}}}]")
            assert await tab.value(f"active({found}, {kept}, 'gyro')[0].toFixed(2)") == "140.00"
            # Without a gradienter there is no place for an attitude; a silent one is a fault.
            status = await here.status() | {"pose": None, "rows": []}
            for devices, hidden in (
                ([], True),
                ([one for one in status["devices"] if one["name"] == "gradienter"], False),
            ):
                shown = json.dumps(status | {"devices": devices})
                assert await tab.value(f"show({shown}); $('attitude').hidden") is hidden
            # An unmet goal shows what would help.
            for imu, wanted in (
                ({"warm_up": 8.0, "stat": 2.0}, "calibrate again when warm"),
                ({"warm_up": 2.0, "stat": 8.0}, "set a larger calibration.max_s"),
                ({"warm_up": 2.0, "stat": 2.0}, ""),
                ({"warm_up": 8.0, "stat": 2.0, "in_force": 20.0}, ""),
            ):
                one = {f"gyro_sigma_{kind}_rad_s": [1.0, sigma, 1.0] for kind, sigma in ({"use": 10.0} | imu).items()}
                made = json.dumps({"imus": [{"gyro_sigma_use_rad_s": [40.0] * 3}, one]})
                assert await tab.value(f"helps({made}, 'gyro', 'rad_s', 10, [])") == wanted

            remedy = "document.querySelector('#remedy').textContent"
            await tab.until(f"{remedy} === 'Hold CALIBRATE, and keep still.'")
            # A short tap is no order, and says why.
            await tab.touch("#calibrate")
            await tab.lift()
            assert await tab.until(SAID) == "hold CALIBRATE for 1.5 s"
            # Neither is a finger that goes away before the time.
            await tab.touch("#calibrate")
            await tab.roll("#calibrate", 200.0)
            assert await tab.value("document.querySelectorAll('button.held').length") == 0
            await tab.lift()
            assert (await here.status())["state"] == "idle"

            # Held for 1.5 s, with a glove that rolls a little.
            await tab.touch("#calibrate")
            await tab.roll("#calibrate", 25.0)
            await tab.until("document.querySelector('#calibrate.held')")
            began_s = asyncio.get_running_loop().time()
            await tab.until(f"{WORD}.startsWith('MEASURING') || {WORD}.startsWith('HOLD STILL')")
            assert asyncio.get_running_loop().time() - began_s > 1.2
            await tab.lift()
            assert await tab.value("document.querySelector('#calibrate').disabled")
            await tab.touch("#cancel")
            await tab.lift()
            await tab.until(f'{SAID} === "CANCEL: cancelled by the page; nothing written"')
            await tab.until("document.querySelector('#last').textContent.includes('cancelled by the page')")
            assert (await here.status())["last"]["state"] == "cancelled"

            # An alignment is asked for in the same way, shown with its picture, and its end stays on the page.
            await tab.value("$('align').open = true")
            button = "#align button[data-name='align turn']"
            end = f"document.querySelector({button!r}).getBoundingClientRect().bottom"
            await tab.value(f"document.querySelector({button!r}).scrollIntoView({{block: 'end'}})")
            assert await tab.value(f"{end} <= $('bar').getBoundingClientRect().top"), "the bar covers it"
            await tab.touch(button)
            await tab.until("$('standing').textContent === 'TURN: 1 of 5' && $('wish').textContent")
            assert await tab.value("$('writes').textContent") == "will be written to the autopilot"
            status = await here.status()
            objected = json.dumps(status["stands"] | {"objection": "it leaned", "share": 0})
            shown = await tab.value(f"stands({objected}, {json.dumps(status)}); $('now').innerText")
            assert shown.count("it leaned") == 1
            await tab.lift()
            assert await tab.value("document.querySelectorAll('#how .nose').length") == 4
            await tab.value("scrollTo(0, 0)")
            await tab.touch("#cancel")
            await tab.lift()
            await tab.until("$('result').textContent === \"TURN: cancelled by the page; nothing written\"")
            assert await tab.value("$('standing').textContent") == "CANCELLED"
            await tab.value("$('dismiss').click()")
            await asyncio.sleep(1.0)
            assert await tab.value("$('stands').hidden")

            # A page that the browser has stopped for a while has not lost the companion.
            await tab.value(
                "const seen = []; new MutationObserver(() => seen.push($('word').innerText))"
                ".observe($('word'), {subtree: true, childList: true}); source.close();"
                "const woken = Date.now() + 5000; while (Date.now() < woken);"
            )
            await tab.until(f"seen.length && {WORD} === 'NOT CALIBRATED'")
            assert "NO LINK" not in await tab.value("seen.join()")

            # The daemon goes away, is noticed, and comes back; the page's old token is none any more.
            assert here.line.daemon is not None
            old = await tab.value("token")
            here.line.daemon.kill()
            await here.line.daemon.communicate()
            await tab.until(f"{WORD} === 'NO LINK'")
            assert await tab.value("document.querySelectorAll('#keys button:disabled').length") == 3
            again = await asyncio.create_subprocess_exec(
                sys.executable, "-m", "companion", "-c", str(here.line.config), "run", stderr=asyncio.subprocess.PIPE
            )
            try:
                await _until_disarmed(here.line.config)
                # The page's process of before, at its low priority, may serve the new daemon for a moment, then end.
                await tab.until(f"token !== {old!r} && {WORD} === 'NOT CALIBRATED'")
                await tab.touch("#calibrate")
                await tab.until(f"{WORD}.startsWith('MEASURING')")
                await tab.lift()
            finally:
                await _end(again)

    asyncio.run(main())


def test_a_laptop_beyond_the_board_needs_the_token(tmp_path: Path) -> None:
    async def main() -> None:
        # It is not done before it has been cancelled.
        async with scene(tmp_path, "0.0.0.0:0", DESKTOP, still_s=(600.0, 600.0)) as here:
            tab = here.tab
            kept = await companion("-c", str(here.line.config), "page", "--json")
            token = kept.json["token"]
            assert kept.json["url"].endswith(here.url.rpartition(":")[2])
            (file,) = tmp_path.rglob("web-token")  # noqa: ASYNC240 - a local folder
            assert stat.S_IMODE(file.stat().st_mode) == 0o600
            shown = await companion("-c", str(here.line.config), "page")
            assert f"#token={token}" in shown.out
            check = await companion("-c", str(here.line.config), "check", "--json")
            (page,) = (one for one in check.json["findings"] if one["name"] == "page")
            assert page["good"]
            assert page["words"].endswith(" (buttons: companion page)")
            assert await pixels_needed(tab) == 0

            async def hold() -> None:
                await tab.mouse("#calibrate", "mousePressed")
                await asyncio.sleep(1.6)
                await tab.mouse("#calibrate", "mouseReleased")

            await hold()
            await tab.until("!document.querySelector('#ask').hidden")
            assert "companion page" in await tab.value(SAID)
            for typed in ("2222-2222-2222", token):
                await tab.value("document.querySelector('#token').value = ''; document.querySelector('#token').focus()")
                await tab.call("Input.insertText", text=typed)
                await tab.value("document.querySelector('#ask').requestSubmit()")
                await tab.until(f"{SAID} === 'now press again'")
                await hold()
                await tab.until(f"{SAID} !== 'now press again' && !{SAID}.endsWith('asked for')")
                said = await tab.value(SAID)
                if typed != token:
                    assert said == "CALIBRATE: wrong token: companion page, on the board, shows the right one"
                    assert (await here.status())["state"] == "idle"
            assert said == "CALIBRATE: calibration started"
            assert (await here.status())["state"] != "idle"
            await tab.mouse("#cancel", "mousePressed")
            await tab.mouse("#cancel", "mouseReleased")
            await tab.until(f'{SAID} === "CANCEL: cancelled by the page; nothing written"')

            # An address that brings the token along: nothing has to be typed.
            await tab.value("localStorage.clear()")
            await tab.open("about:blank", DESKTOP)
            await tab.open(f"{here.url}#token={token}", DESKTOP)
            await tab.until(f"{WORD} === 'NOT CALIBRATED'")
            assert await tab.value("location.hash") == ""
            assert await tab.value("token") == await tab.value("localStorage.getItem('token')") == token

    asyncio.run(main())


def test_without_a_page_there_is_no_token_and_the_board_itself_needs_none(tmp_path: Path) -> None:
    config = tmp_path / "companion.toml"
    text = '[mavlink]\nurl = "udpin:127.0.0.1:1"\n[[imu]]\nname = "fc"\nsource = "autopilot"\n'
    text += f'[storage]\ndirectory = "{tmp_path}"\n'

    async def main() -> None:
        config.write_text(text)
        none = await companion("-c", str(config), "page", "--json")
        assert none.code == FAILED
        assert "[web]" in none.json["reason"]
        config.write_text(text + '[web]\nbind = "127.0.0.1:8191"\n')
        local = await companion("-c", str(config), "page")
        assert (local.code, local.out) == (
            DONE,
            "http://127.0.0.1:8191/ needs no token: only this board can reach it\n",
        )
        assert not (tmp_path / "web-token").exists()

    asyncio.run(main())


def test_the_reasons_against_arming_come_first_and_fix_mends_one(tmp_path: Path) -> None:
    async def main() -> None:
        async with scene(tmp_path, "127.0.0.1:0", PHONE) as here:
            tab, autopilot = here.tab, here.line.scenario.autopilot
            assert isinstance(autopilot, ArduPilotDouble)
            real = autopilot.prearm_failures
            reasons = ["heater temp low (21.5 < 45)"]
            autopilot.prearm_failures = lambda loop_s: [*real(loop_s), *reasons]  # type: ignore[method-assign]
            here.line.scenario.flight_controller_imus[0].turn_on((0.0, 0.0, math.radians(6.5)), (0.0, 0.0, 0.0))
            autopilot.repeats_failures = True
            await tab.until(f"{WORD} === 'WILL NOT ARM'", 20.0)
            reason = "document.querySelector('#reason').textContent"
            assert "IMU 1 z is" in await tab.until(f"{reason}.includes('IMU 1') && {reason}", 20.0)
            assert "heater" in await tab.value("document.querySelector('#refusals').textContent")
            assert "hold FIX" in await tab.value("document.querySelector('#remedy').textContent")
            assert await pixels_needed(tab) == 0
            box = "document.querySelector('#fix small').getBoundingClientRect()"
            assert await tab.value(f"{box}.left >= 0 && {box}.right <= innerWidth")
            await tab.touch("#fix")
            refusals = "document.querySelector('#refusals').textContent"
            await tab.until(f"document.querySelector('#fix').hidden && !{refusals}.includes('Gyros')", 30.0)
            await tab.lift()

    asyncio.run(main())
