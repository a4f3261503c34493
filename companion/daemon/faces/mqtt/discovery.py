"""Home Assistant's discovery message: one device, with what is worth a tile or a button.

Device discovery (Home Assistant 2024.11 and later): one retained message under PREFIX/device/ID/config describes all
entities; availability is that of the status topic.
"""

from __future__ import annotations

import re
from typing import Any

from companion import __version__
from companion.daemon.faces.mqtt.topics import Topics

Object = dict[str, Any]


def discovery_topic(prefix: str, topics: Topics) -> str:
    """Where Home Assistant looks."""
    return f"{prefix}/device/{_identifier(topics)}/config"


def discovery_message(topics: Topics, system_id: int | None) -> Object:
    """The device and its entities."""
    identifier = _identifier(topics)
    return {
        "device": {
            "identifiers": [identifier],
            "name": "Companion" + (f" of vehicle {system_id}" if system_id is not None else ""),
            "model": "Field self-calibration of IMUs",
            "sw_version": __version__,
        },
        "origin": {"name": "companion", "sw_version": __version__},
        "availability_topic": topics.status,
        "payload_available": "online",
        "payload_not_available": "offline",
        "components": {
            name: {"unique_id": f"{identifier}_{name}", **component} for name, component in _components(topics).items()
        },
    }


def _components(topics: Topics) -> dict[str, Object]:
    return {
        "state": _sensor("Calibration", topics.state, "value_json.state"),
        "reason": _sensor("What is going on", topics.state, "value_json.reason[:250]"),
        "armed": _sensor("Armed", topics.state, "value_json.vehicle.armed"),
        "in_force": _sensor("In force", topics.state, "value_json.arming.in_force[:250]"),
        "last": {
            **_sensor("Last calibration", topics.state, "(value_json.last or {}).get('started_at')"),
            "device_class": "timestamp",
        },
        "ready": {
            "platform": "binary_sensor",
            "name": "Ready to arm",
            "state_topic": topics.state,
            "value_template": "{{ 'ON' if value_json.arming.verdict == 'accept' else 'OFF' }}",
        },
        "pitch": _angle("Pitch", topics, "pitch_deg"),
        "roll": _angle("Roll", topics, "roll_deg"),
        "heading": _angle("Heading", topics, "heading_deg"),
        "calibrate": _button("Calibrate", topics, "calibrate"),
        "cancel": _button("Cancel", topics, "cancel"),
        "undo": _button("Old values back", topics, "undo"),
    }


def _sensor(name: str, topic: str, value: str) -> Object:
    return {"platform": "sensor", "name": name, "state_topic": topic, "value_template": f"{{{{ {value} }}}}"}


def _angle(name: str, topics: Topics, key: str) -> Object:
    return {
        **_sensor(name, topics.attitude, f"value_json.{key}"),
        "unit_of_measurement": "°",
        "suggested_display_precision": 1,
        "enabled_by_default": False,  # a few values a second are more than its history wants
    }


def _button(name: str, topics: Topics, command: str) -> Object:
    return {
        "platform": "button",
        "name": name,
        "command_topic": topics.request(command),
        "payload_press": "{}",
        "qos": 1,
        "retain": False,
    }


def _identifier(topics: Topics) -> str:
    """What Home Assistant takes for an id: letters, digits, - and _."""
    name = re.sub(r"[^A-Za-z0-9_-]", "_", topics.base)
    return name if name.startswith("companion") else f"companion_{name}"
