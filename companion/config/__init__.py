"""The configuration: what may be set, what it means, and one clear line for every mistake.

A TOML file becomes frozen structures with units in their names. Unknown keys are errors (with the nearest known
key), so that a misspelt limit is never silently a default.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import msgspec

from companion.config.profiles import Saved, none_saved, with_saved_profiles
from companion.config.rules import check_together
from companion.config.sections import (
    AtArm,
    Calibration,
    Compass,
    CompassProtocol,
    Config,
    Control,
    Gradienter,
    GradienterProtocol,
    Imu,
    ImuProtocol,
    Log,
    Mavlink,
    Mounting,
    Mqtt,
    Noise,
    Parity,
    Push,
    Storage,
    Vehicle,
)
from companion.config.words import explain, refuse_unknown_keys
from companion.errors import ConfigError

__all__ = [
    "DEFAULT_PATH",
    "AtArm",
    "Calibration",
    "Compass",
    "CompassProtocol",
    "Config",
    "Control",
    "Gradienter",
    "GradienterProtocol",
    "Imu",
    "ImuProtocol",
    "Log",
    "Mavlink",
    "Mounting",
    "Mqtt",
    "Noise",
    "Parity",
    "Push",
    "Storage",
    "Vehicle",
    "load",
    "parse",
]

DEFAULT_PATH = Path("/etc/companion/companion.toml")


def load(path: Path, saved: Saved = none_saved) -> Config:
    """Read and check a configuration file; `saved` says where saved noise profiles are.

    Raises:
        ConfigError: one line that names the file, the key, what was found and what is allowed.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; give another with -c FILE") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    return parse(text, str(path), saved)


def parse(text: str, name: str, saved: Saved = none_saved) -> Config:
    """Check the text of a configuration file; `name` stands for the file in messages, `saved` as for `load`.

    Raises:
        ConfigError: one line that names the file, the key, what was found and what is allowed.
    """
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{name}: not valid TOML: {error}") from None
    refuse_unknown_keys(raw, Config, "", name)
    try:
        config = msgspec.convert(raw, Config, strict=True)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{name}: {explain(str(error), raw)}") from None
    check_together(config, name)
    return with_saved_profiles(config, name, saved)
