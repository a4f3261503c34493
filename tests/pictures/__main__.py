"""Draw the documents' pictures from real runs: `python -m tests.pictures [demo] [page] [report]`."""

from __future__ import annotations

import asyncio
import re
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from PIL import Image

from tests.e2e.test_commands import companion, flight_line
from tests.pictures import terminal
from tests.support.browser import Tab, chromium

PICTURES: Final = Path(__file__).parents[2] / "docs/pictures"
PHONE, PAPER = (390, 780), (760, 900)
COLOURS: Final = 64
"""Enough for letters and bars, at a quarter of the bytes."""
NAMES: Final = ("demo", "page", "report")


def main(names: Sequence[str]) -> int:
    """Draw those that are named, or all."""
    if strange := set(names) - set(NAMES):
        print(f"found {', '.join(sorted(strange))}; allowed: {', '.join(NAMES)}", file=sys.stderr)
        return 2
    wanted = names or NAMES
    PICTURES.mkdir(exist_ok=True)
    if "demo" in wanted:
        lines = asyncio.run(terminal.recorded("sim", "demo"))
        (PICTURES / "demo.svg").write_text(terminal.svg("make demo", lines), encoding="utf-8")
    if {"page", "report"} & set(wanted):
        with tempfile.TemporaryDirectory(prefix="companion-pictures-") as folder:
            asyncio.run(_from_daemon(Path(folder), wanted))
    return 0


async def _from_daemon(folder: Path, wanted: Sequence[str]) -> None:
    """The page on a phone after a calibration, and its first IMU in the report."""
    more = '[web]\nbind = "127.0.0.1:0"\n'
    async with flight_line(folder, more=more, still_s=(10.0, 20.0)) as line, chromium(folder / "profile") as browser:
        words = ("-c", str(line.config))
        tab = await browser.tab()
        done = await companion(*words, "calibrate", "--json")
        if done.code:
            raise RuntimeError(done.err)
        if "page" in wanted:
            status = (await companion(*words, "status", "--json")).json
            url = re.search(r"http://\S+:\d+/", status["page"]["url"])
            assert url is not None
            await tab.open(url[0], PHONE)
            await tab.until("document.querySelector('#word span').textContent === 'READY'")
            await _take(tab, PICTURES / "page.png")
        if "report" in wanted:
            made = folder / "report.html"
            await companion(*words, "report", "-o", str(made))
            await tab.open(f"file://{made}", PAPER)
            heading = "[...document.querySelectorAll('h2')].find(it => it.textContent.startsWith('IMU'))"
            await tab.until(f"document.readyState === 'complete' && {heading}")
            await tab.value(f"{heading}.scrollIntoView()")
            await _take(tab, PICTURES / "report.png")


async def _take(tab: Tab, path: Path) -> None:
    await tab.picture(path)
    _lighten(path)


def _lighten(path: Path) -> None:
    with Image.open(path) as taken:
        taken.convert("RGB").quantize(COLOURS).save(path, optimize=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
