"""Print docs/messages.md, made from the catalogue of messages (`make messages`)."""

from __future__ import annotations

import sys
from typing import Final

from companion.messages import KINDS, Entry, catalogue

_HEAD: Final = """\
# Messages: what the companion says, and what to do

Type `companion explain WORDS` with some words of the line; it knows more phrases than this page. `…` is a name or a
number. `status`, `check`, failed commands and the page show the remedy too.

A line often has a speaker and a reason: in `Not armed: hold still 6 s` look up the part behind the colon. A line
that begins with `... ` continues the one before.
"""


def page() -> str:
    """Return the whole document, sorted by what the pilot has to do."""
    parts = [_HEAD]
    for kind, title in KINDS.items():
        rows = [_row(entry) for entry in catalogue().values() if entry.do == kind]
        parts.append(f"\n## {title}\n" + "".join(rows))
    return "".join(parts)


def _row(entry: Entry) -> str:
    # `companion explain` knows all patterns.
    shown = ", ".join(f"`{pattern}`" for pattern in (entry.patterns[:1] if entry.text else entry.also[:2]))
    words = " ".join(part for part in (entry.cause, entry.remedy) if part)
    return f"\n{f'[{shown}]({entry.see})' if entry.see else shown}: {words}\n"


if __name__ == "__main__":
    sys.stdout.write(page())
