"""Who is meant by a list of MAVLink senders: systems, or components of systems."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

EVERYBODY: Final = ("*",)
ALLOWED: Final = '"SYSTEM" or "SYSTEM:COMPONENT", each a number from 0 to 255, a range such as 250-255, or *'
_IDS: Final = re.compile(r"(?:\*|([0-9]{1,3})(?:-([0-9]{1,3}))?)")


class Senders:
    """The senders that a list names.

    Args:
        entries: such as "255", "255:190", "250-255", "*:190", "*". An entry without a component means all of them.

    Raises:
        ValueError: an entry is none; its words say which and why.
    """

    def __init__(self, entries: Iterable[str]) -> None:
        self._pairs = [_pair(entry) for entry in entries]

    def __contains__(self, sender: tuple[int, int]) -> bool:
        """Whether the list names this (system, component)."""
        system, component = sender
        return any(system in systems and component in components for systems, components in self._pairs)


def _pair(entry: str) -> tuple[range, range]:
    system, colon, component = entry.partition(":")
    return _range(system, entry), _range(component, entry) if colon else range(256)


def _range(words: str, entry: str) -> range:
    match = _IDS.fullmatch(words)
    if match is None:
        raise ValueError(entry)
    if match[1] is None:
        return range(256)
    first, last = int(match[1]), int(match[2] or match[1])
    if not first <= last <= 255:
        raise ValueError(entry)
    return range(first, last + 1)
