"""README.md and docs/*.md as the tests read them: blocks, prose, headings, and the commands of ours in them."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
DOCUMENTS = [README, *sorted((ROOT / "docs").glob("*.md"))]


class Block(NamedTuple):
    """A block of code: fenced, with what stands behind the fence, or indented (no language)."""

    path: Path
    line: int
    language: str
    text: str


def blocks(path: Path) -> list[Block]:
    found: list[Block] = []
    language: str | None = None
    lines: list[str] = []
    began = 0
    for number, line in enumerate([*path.read_text(encoding="utf-8").splitlines(), ""], 1):
        fence = re.match(r" *```(\w*)", line)
        if language is None and fence:
            language, lines, began = fence[1] or "text", [], number
        elif language is not None and fence:
            found.append(Block(path, began, language, textwrap.dedent("\n".join(lines))))
            language = None
        elif language is not None:
            lines.append(line)
        elif line.startswith("    "):
            found.append(Block(path, number, "", line.strip()))
    return found


def prose(path: Path) -> str:
    text = re.sub(r"^ *```.*?^ *```", "", path.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"^ {4}.*$", "", text, flags=re.MULTILINE)


def headings(path: Path) -> set[str]:
    """The anchors of a document's headings, as GitHub makes them."""
    found = re.findall(r"^#+ (.*)$", prose(path), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", re.sub(r"[`*]", "", heading).lower()).replace(" ", "-") for heading in found}


def commands_in(path: Path) -> Iterator[str]:
    """Command lines of `companion` and `python -m sim`, from blocks and from code spans, as one would type them.

    Not the messages in the page of messages: there the companion speaks of itself.
    """
    text = prose(path)
    if path.name == "messages.md":
        text = re.sub(r"^\[?`.*?: ", "", text, flags=re.MULTILINE)
    texts = [line.removeprefix("$ ") for block in blocks(path) for line in block.text.splitlines()]
    texts += [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", text)]
    for line in texts:
        for part in re.split(r"\s+(?:&&|\||>)\s+", re.sub(r"\s#.*", "", line)):
            command = re.sub(r"^(?:[A-Z0-9_]+=\S+ |sudo |nice -n \S+ |\S*/bin/(?=companion ))*", "", part.strip())
            if re.match(r"(?:companion|python -m sim)(?= \S)", command):
                yield command
