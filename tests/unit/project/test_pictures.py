"""Pictures of the documents are small and passive, are used, and their wires join a sender with a receiver."""

from __future__ import annotations

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
