"""Print docs/messages.md, made from the catalogue of messages (`make messages`)."""

from __future__ import annotations

import sys
from typing import Final

from companion.messages import ANY, KINDS, Entry, catalogue

_HEAD: Final = """\
# Messages: what the companion says, and what to do

`companion explain WORDS` finds a line by some of its words; it knows more lines than this page. `…` is a name, a number
or the rest of a long line. For `Not armed: hold still 6 s` look up the part behind the colon. A line that begins with
`... ` continues the one before. Change a setting in companion.toml, then restart the companion.
"""


_LONGEST: Final = 9  # Words of a line that the page shows: a reader finds the line by its beginning


def page() -> str:
    """Return the whole document, sorted by what the pilot has to do."""
    parts = [_HEAD]
    for kind, title in KINDS.items():
        rows: dict[tuple[str, str, str], list[str]] = {}
        for entry in catalogue().values():
            if entry.do == kind:
                rows.setdefault((entry.see, entry.cause, entry.remedy), []).extend(_shown(entry))
        parts.append(f"\n## {title}\n" + "".join(_row(*key, shown) for key, shown in rows.items()))
    return "".join(parts)


def _shown(entry: Entry) -> tuple[str, ...]:
    # `companion explain` knows all patterns, in full.
    words = (entry.patterns if entry.text else entry.also)[0].split(" ")
    return (" ".join(words if len(words) <= _LONGEST else [*words[:_LONGEST], ANY]),)


def _row(see: str, cause: str, remedy: str, patterns: list[str]) -> str:
    shown = ", ".join(f"`{pattern}`" for pattern in patterns)
    words = " ".join(part for part in (cause, remedy) if part)
    return f"\n{f'[{shown}]({see})' if see else shown}: {words}\n"


if __name__ == "__main__":
    sys.stdout.write(page())
