"""The rules of the section [mqtt] that no single key can tell."""

from __future__ import annotations

from typing import Final

from companion.config.sections import Mqtt
from companion.errors import ConfigError

MAX_TOPIC_BYTES: Final = 200
"""Of a topic's beginning; MQTT itself allows 65535."""


def check_mqtt(mqtt: Mqtt, name: str) -> None:
    """Check the section.

    Raises:
        ConfigError: one line that names the file, the key, what was found and what is allowed.
    """
    if mqtt.base_topic is not None:
        _check_topic(mqtt.base_topic, "mqtt.base_topic", name)
    if mqtt.password_file is not None and mqtt.username is None:
        raise ConfigError(f"{name}: 'mqtt.username' is missing; allowed: a text, not empty (needed by password_file)")
    if mqtt.password_file is not None and "/" in mqtt.password_file and not mqtt.password_file.startswith("/"):
        raise ConfigError(
            f"{name}: 'mqtt.password_file': found {mqtt.password_file!r}; allowed: a path that begins with /, or the"
            " bare name of a systemd credential"
        )
    for key in ("ca_file", "cert_file", "key_file"):
        path = getattr(mqtt, key)
        if path is not None and not mqtt.tls:
            raise ConfigError(f"{name}: 'mqtt.{key}': found {path!r}; allowed: only with tls = true")
        if path is not None and not path.startswith("/"):
            raise ConfigError(f"{name}: 'mqtt.{key}': found {path!r}; allowed: a path that begins with /")
    for key, other in (("cert_file", "key_file"), ("key_file", "cert_file")):
        if getattr(mqtt, key) is not None and getattr(mqtt, other) is None:
            raise ConfigError(f"{name}: 'mqtt.{other}' is missing; allowed: a path (needed by {key})")


def _check_topic(topic: str, here: str, name: str) -> None:
    good = (
        len(topic.encode()) <= MAX_TOPIC_BYTES
        and not any(character in topic for character in "+# ")
        and not topic.startswith(("/", "$"))
        and not topic.endswith("/")
        and "//" not in topic
    )
    if not good:
        raise ConfigError(
            f"{name}: {here!r}: found {topic!r}; allowed: words with / between them, such as"
            f' "field/heron", without + # or blanks, at most {MAX_TOPIC_BYTES} bytes'
        )
