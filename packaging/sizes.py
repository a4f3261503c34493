"""Print the size of each package, and fail where one is above its budget: `[tool.size]` in pyproject.toml.

Lines of Python are counted as they stand in the files, comments and blank lines too. `__init__.py` counts as a file
only where it holds code. Raising a budget is a line in a diff that somebody sees.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]


class Size(NamedTuple):
    """Lines and files of Python below a folder."""

    lines: int
    files: int


def size_of(folder: Path) -> Size:
    """Count the Python files of a folder, or a single file."""
    paths = [folder] if folder.is_file() else sorted(folder.rglob("*.py"))
    counts = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in paths}
    small = sum(path.name == "__init__.py" and count <= 1 for path, count in counts.items())
    return Size(sum(counts.values()), len(counts) - small)


def words_of(root: Path) -> int:
    """Count the words of all documents."""
    documents = [*root.glob("*.md"), *(root / "docs").rglob("*.md"), *(root / "tests").glob("*.md")]
    return sum(len(document.read_text(encoding="utf-8").split()) for document in documents)


def report(root: Path) -> tuple[list[str], list[str]]:
    """Return the table and the complaints, line by line."""
    settings = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["size"]
    lines: dict[str, int] = settings["lines"]
    files: dict[str, int] = settings["files"]
    table, complaints = [f"{'package':<26}{'lines':>8}{'budget':>8}{'files':>7}{'budget':>8}"], []
    for name, budget in lines.items():
        size, most_files = size_of(root / name), files.get(name)
        table.append(f"{name:<26}{size.lines:>8}{budget:>8}{size.files:>7}{most_files or '':>8}")
        if size.lines > budget:
            complaints.append(f"{name}: {size.lines} lines; allowed: {budget} (pyproject.toml, [tool.size.lines])")
        if most_files is not None and size.files > most_files:
            complaints.append(f"{name}: {size.files} files; allowed: {most_files} (pyproject.toml, [tool.size.files])")
    without = {f"companion/{each.name}" for each in (root / "companion").iterdir() if (each / "__init__.py").exists()}
    complaints += [f"{name}: no budget (pyproject.toml, [tool.size.lines])" for name in sorted(without - lines.keys())]
    words, most_words = words_of(root), settings["words"]
    table.append(f"{'documents, words':<26}{words:>8}{most_words:>8}")
    if words > most_words:
        complaints.append(f"documents: {words} words; allowed: {most_words} (pyproject.toml, [tool.size])")
    return table, complaints


def main() -> int:
    """Print the table; 1: something is above its budget."""
    table, complaints = report(ROOT)
    print(*table, sep="\n")
    if complaints:
        print(*complaints, sep="\n", file=sys.stderr)
    return bool(complaints)


if __name__ == "__main__":
    sys.exit(main())
