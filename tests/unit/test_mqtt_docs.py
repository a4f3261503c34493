"""docs/mqtt.md names every topic and every key, and its examples are understood."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import pytest

from companion.config import parse
from companion.daemon.mqtt.payloads import KEYS, Request
from companion.daemon.mqtt.payloads import parse as parse_request
from companion.daemon.mqtt.topics import Topics

DOCS = (Path(__file__).parents[2] / "docs" / "mqtt.md").read_text(encoding="utf-8")
ROWS = dict(re.findall(r"^\| `([a-z/]+)` \|(.*)\|$", DOCS, re.MULTILINE))


def test_every_topic_has_its_row_and_no_other() -> None:
    topics = Topics("x")
    ours = {topics.status, topics.state, topics.record, topics.progress, topics.attitude}
    ours |= {topics.request(command) for command in KEYS} | {topics.response(command) for command in KEYS}
    assert {f"x/{row}" for row in ROWS} == ours


@pytest.mark.parametrize("command", list(KEYS))
def test_the_examples_of_requests_are_taken_and_show_every_key(command: str) -> None:
    (example,) = re.findall(r"`(\{.*\})`", ROWS[f"request/{command}"])
    request = parse_request(command, example.encode())
    assert isinstance(request, Request)
    assert set(request.content) == set(KEYS[command])
    assert request.transaction is not None


def test_the_examples_are_json() -> None:
    examples = [example for row in ROWS.values() for example in re.findall(r"`(\{[^`]*\})`", row)]
    assert len(examples) > 8
    for example in examples:
        json.loads(example.replace(", ...}", "}").replace("{...}", "{}").replace("[...]", "[]"))


def test_the_configuration_shown_is_accepted_with_every_key() -> None:
    (shown,) = re.findall(r"```toml\n(.*?)```", DOCS, re.DOTALL)
    everything = re.sub(r"^# ", "", shown, flags=re.MULTILINE)
    config = parse('[mavlink]\nurl="tcp:h:1"\n[[imu]]\nname="a"\nsource="autopilot"\n' + everything, "docs")
    assert config.mqtt is not None
    assert set(tomllib.loads(everything)["mqtt"]) == set(config.mqtt.__struct_fields__)
