"""docs/security.md: every row of "who may what" and of the threats names tests that there are."""

from __future__ import annotations

import re

import pytest

from tests.support.documents import ROOT

TEXT = (ROOT / "docs/security.md").read_text(encoding="utf-8")


def rows(heading: str) -> list[str]:
    """The last cell of each row of the first table below a heading."""
    section = TEXT.split(f"## {heading}\n", 1)[1].split("\n## ", 1)[0]
    lines = [line for line in section.splitlines() if line.startswith("|")]
    return [line.strip("|").split("|")[-1].strip() for line in lines[2:]]


@pytest.mark.parametrize("heading", ["Who may what", "Threats"])
def test_every_row_names_its_tests(heading: str) -> None:
    found = rows(heading)
    assert len(found) >= 8
    for cell in found:
        named = re.findall(r"`((?:unit|e2e|property)/test_\w+\.py)`", cell)
        assert named, cell
        for name in named:
            assert (ROOT / "tests" / name).is_file(), name
