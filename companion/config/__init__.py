"""The configuration: what may be set, what it means, and one clear line for every mistake.

A TOML file becomes frozen structures with units in their names. Unknown keys are errors (with the nearest known
key), so that a misspelt limit is never silently a default.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Final

import msgspec

from companion.config.profiles import Saved, with_saved_profiles
from companion.config.rules import check_together
from companion.config.sections import Config
from companion.config.words import brief, explain, refuse_unknown_keys
from companion.errors import ConfigError

DEFAULT_PATH = Path("/etc/companion/companion.toml")
MOST_BYTES: Final = 64 * 1024
"""The longest configuration file; the sample, which has every key, is a ninth of that."""
MOST_LINE: Final = 4096
"""The most characters of a line: the time that TOML takes for a key grows with the square of its dots."""


def load(path: Path, saved: Saved | None = None) -> Config:
    """Read and check a configuration file; `saved` says where saved noise profiles are.

    Raises:
        ConfigError: one line that names the file, the key, what was found and what is allowed.
    """
    try:
        with path.open("rb") as file:
            text = file.read(MOST_BYTES + 1).decode()
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; give another with -c FILE") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    return parse(text, str(path), saved)


def parse(text: str, name: str, saved: Saved | None = None) -> Config:
    """Check the text of a configuration file; `name` stands for the file in messages, `saved` as for `load`.

    Raises:
        ConfigError: one line that names the file, the key, what was found and what is allowed.
    """
    if len(text) > MOST_BYTES:
        raise ConfigError(f"{name}: found more than {MOST_BYTES} bytes; allowed: a configuration file")
    for number, line in enumerate(text.split("\n"), 1):
        if len(line) > MOST_LINE:
            raise ConfigError(f"{name}: line {number}: found {len(line)} characters; allowed: {MOST_LINE}")
    try:
        raw = tomllib.loads(text)
    except RecursionError:
        raise ConfigError(f"{name}: not valid TOML: brackets within brackets, too deep") from None
    except ValueError as error:  # TOML's own errors, and what Python says of a number with thousands of digits
        raise ConfigError(f"{name}: not valid TOML: {brief(str(error))}") from None
    refuse_unknown_keys(raw, Config, "", name)
    try:
        config = msgspec.convert(raw, Config, strict=True)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{name}: {explain(str(error), raw)}") from None
    check_together(config, name)
    return with_saved_profiles(config, name, saved)
