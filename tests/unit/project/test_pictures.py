"""Pictures of the documents are small and passive, are used, and their wires join a sender with a receiver."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.support.documents import DOCUMENTS

PICTURES = Path(__file__).parents[3] / "docs/pictures"
MOST_BYTES = {".svg": 40_000, ".png": 60_000}


@pytest.mark.parametrize("path", sorted(PICTURES.iterdir()), ids=lambda path: path.name)
def test_each_picture_is_small_and_shown(path: Path) -> None:
    assert path.stat().st_size <= MOST_BYTES[path.suffix]
    assert any(f"pictures/{path.name})" in document.read_text() for document in DOCUMENTS)
    if path.suffix == ".svg":
        found = [element.tag.rpartition("}")[2] for element in ElementTree.parse(path).iter()]  # noqa: S314 - our own
        assert set(found) <= {"svg", "style", "rect", "g", "text", "path", "circle"}
        assert not re.search(r"url\(|@import|href|\son\w+=", path.read_text())


@pytest.mark.parametrize("path", sorted(PICTURES.glob("wiring_*.svg")), ids=lambda path: path.name)
def test_wires_join_a_sender_with_a_receiver_and_ground_with_ground(path: Path) -> None:
    sends, receives = re.compile(r"\bTXD?\b|sends"), re.compile(r"\bRXD?\b|receives")
    elements = list(ElementTree.parse(path).getroot())  # noqa: S314 - our own
    pins = {
        (circle.attrib["cx"], circle.attrib["cy"]): label.text or ""
        for circle, label in itertools.pairwise(elements)
        if circle.tag.endswith("circle")
    }
    wires = [one.attrib["d"] for one in elements if one.tag.endswith("path") and "C" in one.attrib["d"]]
    assert wires
    for wire in wires:
        x, y, to_x, to_y = re.fullmatch(r"M(\d+) (\d+)C.* (\d+) (\d+)", wire).groups()  # type: ignore[union-attr]
        begin, end = pins[x, y], pins[to_x, to_y]
        assert bool(sends.search(begin)) == bool(receives.search(end)), (begin, end)
        assert bool(receives.search(begin)) == bool(sends.search(end)), (begin, end)
        assert ("GND" in begin) == ("GND" in end), (begin, end)
