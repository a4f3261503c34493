"""The collector's configuration: the broker in a TOML file, as the daemon's [mqtt]."""

from __future__ import annotations

import tomllib
from pathlib import Path

import msgspec

from companion.config import MOST_BYTES
from companion.config.rules import broker_complaints
from companion.config.sections import Mqtt
from companion.config.words import brief, explain, refuse_unknown_keys
from companion.errors import ConfigError


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is configured."""

    mqtt: Mqtt


def load(path: Path) -> Settings:
    """Read and check the file.

    Raises:
        ConfigError: one line that names the file, the key, what was found and what is allowed.
    """
    try:
        with path.open("rb") as file:
            raw = tomllib.loads(file.read(MOST_BYTES).decode())
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file: write one with a section [mqtt] that names the broker") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from None
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid TOML: {brief(str(error))}") from None
    refuse_unknown_keys(raw, Settings, "", str(path))
    try:
        settings = msgspec.convert(raw, Settings, strict=True)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path}: {explain(str(error), raw)}") from None
    for wrong in broker_complaints(settings.mqtt):
        raise ConfigError(f"{path}: {wrong}")
    return settings
