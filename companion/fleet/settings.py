"""The collector's configuration: the broker in a TOML file, as the daemon's [mqtt]."""

from __future__ import annotations

from pathlib import Path

import msgspec

from companion.config import converted, read
from companion.config.rules import broker_complaints
from companion.config.sections import Mqtt
from companion.errors import ConfigError


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is configured."""

    mqtt: Mqtt


def load(path: Path) -> Settings:
    """Read and check the file.

    Raises:
        ConfigError: one line that names the file, the key, what was found and what is allowed.
    """
    text = read(path, "write one with a section [mqtt] that names the broker")
    settings = converted(text, str(path), Settings)
    for wrong in broker_complaints(settings.mqtt):
        raise ConfigError(f"{path}: {wrong}")
    return settings
