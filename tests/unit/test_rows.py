"""tests/ROWS.md against the tests that there are."""

from __future__ import annotations

import ast
import re
from pathlib import Path

TESTS = Path(__file__).parents[1]
TABLE = TESTS / "ROWS.md"
NAME = re.compile(r"`([a-z0-9_]+/[a-z0-9_]+\.py(?:::\w+)+)`")
SECTIONS = [str(number) for number in range(1, 10)]


def rows() -> list[list[str]]:
    """Section, row, tests on the double, tests on the binary."""
    lines = [line for line in TABLE.read_text().splitlines() if re.match(r"\| \d", line)]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def names_in(path: Path) -> set[str]:
    """Names of tests, with their class if they have one."""
    found = set()
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}::{each.name}" for each in node.body if isinstance(each, ast.FunctionDef)}
        elif isinstance(node, ast.FunctionDef):
            found.add(node.name)
    return found


def test_every_row_has_four_cells_and_every_section_its_rows() -> None:
    assert all(len(row) == 4 for row in rows())
    assert sorted({row[0][0] for row in rows()}) == SECTIONS
    assert len(rows()) > 100


def test_every_row_that_matters_names_a_test_on_the_double() -> None:
    missing = [row[:2] for row in rows() if not NAME.findall(row[2]) and not row[2].startswith("does not matter: ")]
    assert missing == []


def test_every_test_that_is_named_exists() -> None:
    named = {name for row in rows() for cell in row[2:] for name in NAME.findall(cell)}
    files = {name.split("::")[0] for name in named}
    there = {f"{file}::{test}" for file in files for test in names_in(TESTS / file)}
    assert named - there == set()


def test_what_is_named_under_binary_runs_on_the_binary() -> None:
    for row in rows():
        assert all(name.startswith("sitl/") for name in NAME.findall(row[3])), row
        assert NAME.findall(row[3]) or row[3].startswith("-"), row
