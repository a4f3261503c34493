"""Citations of docs/reference (`method` 2.3, `autopilots` 9.3.2, `sensors` 4.4) name sections that exist there."""

from __future__ import annotations

import re
from collections.abc import Iterator

from tests.support.documents import ROOT

REFERENCE = ROOT / "docs" / "reference"
FOLDERS = ("companion", "sim", "tests", "docs")
SUFFIXES = {".py", ".md", ".lua", ".json", ".toml", ".yaml"}
SECTION = r"\d+(?:\.\d+)*"
GAP = r"\s+(?:# )?"
"""A citation may be wrapped, also in a comment."""
CITATION = re.compile(rf"(?i)\b(method|autopilots|sensors){GAP}({SECTION}(?:(?:,| and| to|, and){GAP}{SECTION})*)")


def texts() -> Iterator[tuple[str, str]]:
    """Every file that may cite, with its text."""
    for folder in FOLDERS:
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in SUFFIXES:
                yield path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")


def sections(document: str) -> set[str]:
    """The section numbers of a document; item 6 of the numbered list in section 8 is 8.6."""
    found: set[str] = set()
    section = ""
    for line in (REFERENCE / f"{document}.md").read_text(encoding="utf-8").splitlines():
        if heading := re.match(rf"#+ ({SECTION})\.? ", line):
            section = heading[1]
            found.add(section)
        elif item := re.match(r"(\d+)\. ", line):
            found.add(f"{section}.{item[1]}")
    return found


def place(name: str, text: str, start: int) -> str:
    return f"{name}:{text[:start].count(chr(10)) + 1}"


def citations() -> Iterator[tuple[str, str, str]]:
    """Place, document and section of each citation."""
    for name, text in texts():
        for match in CITATION.finditer(text):
            for section in re.findall(SECTION, match[2]):
                yield place(name, text, match.start()), match[1].lower(), section


def test_every_cited_section_exists() -> None:
    known = {document: sections(document) for document in ("method", "autopilots", "sensors")}
    found = list(citations())
    assert len(found) > 200, "the pattern no longer finds the citations"
    wrong = [f"{where}: {document} {section}" for where, document, section in found if section not in known[document]]
    assert wrong == [], "no such section in docs/reference"
