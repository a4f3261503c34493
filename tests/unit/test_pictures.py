"""The documents' pictures: small, nothing in them is fetched or run, and the wiring is as its script has it."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.pictures import terminal, wiring
from tests.support.documents import DOCUMENTS

PICTURES = Path(__file__).parents[2] / "docs/pictures"
MOST_BYTES = {".svg": 40_000, ".png": 60_000}


@pytest.mark.parametrize("path", sorted(PICTURES.iterdir()), ids=lambda path: path.name)
def test_each_is_small_and_shown_somewhere(path: Path) -> None:
    assert path.stat().st_size <= MOST_BYTES[path.suffix]
    assert any(f"pictures/{path.name})" in document.read_text() for document in DOCUMENTS)
    if path.suffix == ".svg":
        found = [element.tag.rpartition("}")[2] for element in ElementTree.parse(path).iter()]  # noqa: S314 - our own
        assert set(found) <= {"svg", "style", "rect", "g", "text", "path", "circle"}
        assert not re.search(r"url\(|@import|href|\son\w+=", path.read_text())


@pytest.mark.parametrize("name", wiring.DRAWINGS)
def test_the_wiring_is_as_its_script_has_it(name: str) -> None:
    assert (PICTURES / f"wiring_{name}.svg").read_text() == wiring.DRAWINGS[name](), "make pictures PICTURES=wiring"


def test_data_lines_are_crossed_and_ground_goes_to_ground() -> None:
    """Who sends is wired to who receives, wherever both ends are named."""
    sends, receives = re.compile(r"\bTXD?\b|sends"), re.compile(r"\bRXD?\b|receives")
    for draw in wiring.DRAWINGS.values():
        root = ElementTree.fromstring(draw())  # noqa: S314 - our own
        pins = {}
        circles = [one for one in root if one.tag.endswith("circle")]
        for circle in circles:
            below = list(root)[list(root).index(circle) + 1]
            pins[circle.attrib["cx"], circle.attrib["cy"]] = below.text or ""
        wires = [one.attrib["d"] for one in root if one.tag.endswith("path") and "C" in one.attrib["d"]]
        for wire in wires:
            x, y, to_x, to_y = re.fullmatch(r"M(\d+) (\d+)C.* (\d+) (\d+)", wire).groups()  # type: ignore[union-attr]
            begin, end = pins[x, y], pins[to_x, to_y]
            assert bool(sends.search(begin)) == bool(receives.search(end)), (begin, end)
            assert bool(receives.search(begin)) == bool(sends.search(end)), (begin, end)
            assert ("GND" in begin) == ("GND" in end), (begin, end)


def test_what_a_command_prints_is_played_line_by_line() -> None:
    lines = [terminal.Line(100.0, "a < b & c"), terminal.Line(100.1, ""), terminal.Line(160.0, "x" * 130)]
    drawn = terminal.svg("make demo", lines)
    shown = [element.text for element in ElementTree.fromstring(drawn).iter() if element.tag.endswith("text")]  # noqa: S314
    assert shown == ["$ make demo", "a < b & c", "x" * terminal.COLUMNS, "x" * (130 - terminal.COLUMNS)]
    uncovered = re.findall(r"translateY\((\d+)px\)", drawn.partition("@keyframes u")[2].partition("@media")[0])
    assert [int(px) / terminal.LINE_PX for px in uncovered] == [2, 3, 5], (
        "prompt and first line, the gap, a long line at once"
    )
    (total_s,) = {float(found) for found in re.findall(r"animation:. ([\d.]+)s", drawn)}
    assert total_s == pytest.approx(0.1 + terminal.LONGEST_PAUSE_S + terminal.END_S, abs=0.05), (
        "a minute of waiting is left out"
    )
