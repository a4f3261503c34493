"""Sizes are counted as they are, and what is above its budget is named."""

from __future__ import annotations

import runpy
from pathlib import Path

ROOT = Path(__file__).parents[3]
REPORT = runpy.run_path(str(ROOT / "packaging" / "sizes.py"))["report"]
SETTINGS = """
[tool.size]
words = {words}
[tool.size.lines]
"companion/a" = {lines}
[tool.size.files]
"companion/a" = {files}
"""


def complaints(root: Path, *, lines: int = 3, files: int = 1, words: int = 4) -> list[str]:
    package = root / "companion" / "a"
    package.mkdir(parents=True, exist_ok=True)
    (package / "__init__.py").write_text('"""A package."""\n')
    (package / "one.py").write_text("x = 1\n\n")
    (root / "README.md").write_text("one two\nthree four\n")
    (root / "docs").mkdir(exist_ok=True)
    (root / "pyproject.toml").write_text(SETTINGS.format(lines=lines, files=files, words=words))
    found: list[str] = REPORT(root)[1]
    return found


def test_what_is_within_its_budget_is_not_named(tmp_path: Path) -> None:
    assert complaints(tmp_path) == []


def test_what_is_above_its_budget_is_named(tmp_path: Path) -> None:
    assert complaints(tmp_path, lines=2) == ["companion/a: 3 lines; allowed: 2 (pyproject.toml, [tool.size.lines])"]
    assert complaints(tmp_path, files=0) == ["companion/a: 1 files; allowed: 0 (pyproject.toml, [tool.size.files])"]
    assert complaints(tmp_path, words=3) == ["documents: 4 words; allowed: 3 (pyproject.toml, [tool.size])"]


def test_a_package_without_a_budget_is_named(tmp_path: Path) -> None:
    complaints(tmp_path)
    (tmp_path / "companion" / "b").mkdir()
    (tmp_path / "companion" / "b" / "__init__.py").touch()
    assert complaints(tmp_path) == ["companion/b: no budget (pyproject.toml, [tool.size.lines])"]
