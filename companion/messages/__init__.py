"""Catalogue of all messages to people: their texts, causes and remedies.

Each TOML file beside this module has one table per message. The table's name identifies the message; its keys are:

- `text`: the text, with named fields (`"IMU {imu} moves {rate} deg/s"`) that the function `message` fills in. Fields
  have no format specification, as a wrong one would raise an error: the caller formats the values;
- `also`: texts of the arming script, the log or the autopilot with the same meaning; `…` stands for any value;
- `words`: additional words by which a person may search for the message;
- `do`: the kind of remedy, a key of `KINDS`;
- `cause`, `remedy`: one or two sentences each; no remedy if there is nothing to do;
- `see`: a page of the documents, such as `"arming.md#the-gate"`.

`make messages` generates docs/messages.md from the catalogue.
"""

from __future__ import annotations

import difflib
import functools
import math
import re
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final, Literal, get_args

import msgspec

Kind = Literal["act", "wait", "retry", "hardware", "setting", "check", "nothing", "report"]

KINDS: Final[Mapping[Kind, str]] = {
    "act": "Act at once",
    "wait": "Hold still, or wait",
    "retry": "Remove the reason, then ask again",
    "hardware": "Check power, wires and sensors",
    "setting": "Change a setting or a file",
    "check": "Check before flight",
    "nothing": "Nothing to do",
    "report": "Report a fault of the program",
}
ANY: Final = "…"
NO_MATCH: Final = "Type the line from the screen, or find the topic in docs/index.md"
_CERTAIN_LETTERS: Final = 8  # Minimum number of letters in a pattern that can identify a message in a longer line
_LONGEST: Final = 300  # Characters of a line that are searched: the time grows with a power of its length
_SIMILAR: Final = 0.8  # Minimum similarity (difflib's ratio) at which a word counts as misspelt
_LEAST_SCORE: Final = 0.4  # Minimum share of the searched words, by weight, that a found message must contain
_NAMED: Final = 0.1  # Bonus for a message that has one of the searched words in its key `words`
_WORD: Final = re.compile(r"[a-z][a-z_]+")


class Entry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One message of the catalogue, as its TOML table describes it."""

    do: Kind
    cause: str = ""
    remedy: str = ""
    text: str = ""
    also: tuple[str, ...] = ()
    words: tuple[str, ...] = ()
    see: str = ""

    @property
    def patterns(self) -> tuple[str, ...]:
        """All texts of the message, with `…` in place of each value."""
        return (*([re.sub(r"\{[^}]*\}", ANY, self.text)] if self.text else []), *self.also)

    def advice(self) -> str:
        return f"{self.remedy} (docs/{self.see})" if self.remedy and self.see else self.remedy


@functools.cache
def catalogue() -> dict[str, Entry]:
    """Load all messages, by their identifiers; raise ValueError for a duplicate identifier."""
    found: dict[str, Entry] = {}
    for path in sorted(Path(__file__).parent.glob("*.toml")):
        part = msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), dict[str, Entry])
        if twice := found.keys() & part.keys():
            raise ValueError(f"{path.name}: found {', '.join(sorted(twice))} again; allowed: each once")
        found |= part
    return found


def message(identifier: str, **fields: object) -> str:
    """Return the text of a message with its fields replaced by values."""
    return catalogue()[identifier].text.format_map(fields)


@functools.lru_cache(maxsize=256)  # a search takes milliseconds, and the same lines are shown again and again
def explain(line: str) -> tuple[str, Entry] | None:
    """Find the message that a line of text contains, the longest one if it contains several; None: there is none."""
    shown = [(letters, identifier) for letters, identifier, pattern in _patterns() if pattern.search(line[:_LONGEST])]
    return (found := max(shown)[1], catalogue()[found]) if shown else None


def remedy(line: str) -> str:
    """Return the remedy for the message that a line of text contains; empty if the line contains no known message."""
    return "" if (found := explain(line)) is None else found[1].advice()


def search(words: str, most: int = 3) -> list[tuple[str, Entry]]:
    """List the messages that match a search best, the best first.

    `words` may be an identifier, a line of text that contains a message, or words in any order.
    """
    if words in catalogue():
        return [(words, catalogue()[words])]
    exact, index = explain(words), _index()
    weights = _weights()
    wanted = {_known(word, weights) for word in _words(words)}
    whole = sum(weights.get(word, 1.0) for word in wanted) or math.inf
    scores = {
        name: sum(weights[word] for word in wanted & has) / whole + _NAMED * bool(wanted & {*catalogue()[name].words})
        for name, has in index.items()
    }
    best = sorted((name for name, score in scores.items() if score >= _LEAST_SCORE), key=lambda name: -scores[name])
    names = dict.fromkeys([*([exact[0]] if exact else []), *best])
    return [(name, catalogue()[name]) for name in list(names)[:most]]


@functools.cache
def _patterns() -> list[tuple[int, str, re.Pattern[str]]]:
    """List the texts that can identify a message in a longer line: number of letters, identifier, pattern of each."""
    found = []
    for identifier, entry in catalogue().items():
        for pattern in entry.patterns:
            parts = [part.strip() for part in pattern.split(ANY)]
            if (letters := sum(map(len, parts))) >= _CERTAIN_LETTERS:
                found.append((letters, identifier, re.compile(".*?".join(map(re.escape, parts)), re.IGNORECASE)))
    return found


def _words(text: str) -> Iterable[str]:
    return _WORD.findall(text.lower())


@functools.cache
def _index() -> dict[str, frozenset[str]]:
    return {
        name: frozenset(_words(" ".join((name.replace("_", " "), *entry.patterns, entry.cause, *entry.words))))
        for name, entry in catalogue().items()
    }


@functools.cache
def _weights() -> dict[str, float]:
    """Weight each word of the catalogue by its rarity: rare words identify a message better."""
    counts = Counter(word for words in _index().values() for word in words)
    return {word: math.log(1.0 + len(_index()) / count) for word, count in counts.items()}


def _known(word: str, weights: Mapping[str, float]) -> str:
    """Correct a misspelt or abbreviated word to a word of the catalogue; return it unchanged if none is similar."""
    if word in weights:
        return word
    whole = [known for known in weights if len(word) > 3 and known.startswith(word)]
    return next(iter(whole or difflib.get_close_matches(word, weights, 1, _SIMILAR)), word)


assert set(KINDS) == set(get_args(Kind))
