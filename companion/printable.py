"""Words from outside as they may be shown: a name, a text of the autopilot or a file's name moves no cursor."""

from __future__ import annotations


def printable(text: str) -> str:
    """Return the text in one line, with an escape for each character that moves the cursor or cannot be seen.

    `ascii` and not a codec: Python loads a codec from a file at its first use, which fails without a free descriptor.
    """
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)
