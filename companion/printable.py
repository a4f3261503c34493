"""Words from outside as they may be shown: a name, a text of the autopilot or a file's name moves no cursor."""

from __future__ import annotations


def printable(text: str) -> str:
    """The text in one line; what a terminal would obey, or nobody would see, as an escape that can be read."""
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() else letter.encode("unicode_escape").decode() for letter in text)
