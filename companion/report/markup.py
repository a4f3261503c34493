"""HTML built from parts that are escaped unless they are markup already.

Names, reasons and warnings come from files and from the autopilot: nothing of them may become a tag, and no invisible
character may turn the reading direction of what stands beside it.
"""

from __future__ import annotations

import html
import re
from typing import Final

MAX_TEXT: Final = 600
"""The most characters of one piece of text: a page stays bounded whatever a file holds."""

# Controls (but line breaks and tabs), direction marks and overrides, zero-width characters, lone surrogates.
_INVISIBLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u202a-\u202e\u2060-\u2069\ufeff\ud800-\udfff]")
_VOID: Final = frozenset({"meta", "path", "line", "rect", "circle", "br"})


class Markup(str):
    """Text that is HTML already."""

    __slots__ = ()


Child = str | None
"""A plain `str` is text and is escaped; None is nothing."""


def text(words: str) -> Markup:
    """Text as it may stand between tags and in quoted attributes; None of it becomes a tag."""
    if isinstance(words, Markup):
        return words
    if len(words) > MAX_TEXT:
        words = words[:MAX_TEXT] + "…"
    return Markup(html.escape(_INVISIBLE.sub("\ufffd", words), quote=True))


def join(*children: Child) -> Markup:
    """Parts one after the other."""
    return Markup("".join(text(child) for child in children if child is not None))


def tag(element: str, /, *children: Child, **attributes: str | float | None) -> Markup:
    """An element; `class_` is class, other underscores in attribute names become dashes, None leaves one out."""
    given = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{text(value if isinstance(value, str) else str(value))}"'
        for key, value in attributes.items()
        if value is not None
    )
    if element in _VOID:
        return Markup(f"<{element}{given}>" if element in {"meta", "br"} else f"<{element}{given}/>")
    return Markup(f"<{element}{given}>{join(*children)}</{element}>")


def row(*cells: Child, class_: str | None = None) -> Markup:
    """A row of a table, of cells, and of words to be put into one; None is no cell."""
    return tag("tr", *(one if isinstance(one, Markup | None) else tag("td", one) for one in cells), class_=class_)
