"""Configuration keys, commands and options that former versions had, each with its remedy."""

from __future__ import annotations

import re
from typing import Final

KEYS: Final[dict[str, str]] = {}
"""Removed configuration keys without list indexes ("imu.port"), each with its version and its remedy."""

COMMAND_LINE: Final[dict[str, str]] = {
    "companion flight --fetch": "0.2: download the log with your ground station, then companion flight LOG",
}
"""Removed commands ("companion NAME") and options ("companion NAME --option"), each with its version and its remedy."""


def refusal_of_key(path: str) -> str | None:
    """Give the refusal of a removed configuration key or section such as `imu[0].port`, or None."""
    remedy = KEYS.get(re.sub(r"\[\d+\]", "", path))
    return None if remedy is None else f"{path} was removed in {remedy}; see CHANGELOG"


def refusal_of_words(command: str, word: str) -> str | None:
    """Give the refusal of a removed command or option behind a command such as `companion flight`, or None."""
    remedy = COMMAND_LINE.get(f"{command} {word}")
    return None if remedy is None else f"{word} was removed in {remedy}"
