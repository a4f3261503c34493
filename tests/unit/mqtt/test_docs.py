"""docs/mqtt.md names every topic and every key, and its examples are understood."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from companion.commands import Interface
from companion.config import parse
from companion.mqtt.daemon import KNOWN, Request
from companion.mqtt.daemon import parse as parse_request
from companion.mqtt.process import Topics

DOCS = (Path(__file__).parents[3] / "docs" / "mqtt.md").read_text(encoding="utf-8")
ROWS = dict(re.findall(r"^\| `([a-z/]+)` \|(.*)\|$", DOCS, re.MULTILINE))


def test_every_topic_has_its_row_and_no_other() -> None:
    topics = Topics("x")
    ours = {topics.status, topics.state, topics.record, topics.progress, topics.attitude}
    ours |= {topics.request + command for command in KNOWN} | {topics.response + command for command in KNOWN}
    assert {f"x/{row}" for row in ROWS} == ours


@pytest.mark.parametrize("command", list(KNOWN))
def test_the_examples_of_requests_are_taken_and_show_every_key(command: str) -> None:
    (example,) = re.findall(r"`(\{.*\})`", ROWS[f"request/{command}"])
    request = parse_request(command, example.encode())
    assert isinstance(request, Request)
    assert set(request.content) == set(KNOWN[command].fields(Interface.MQTT))
    assert request.transaction is not None


SAMPLE = (Path(__file__).parents[3] / "systemd" / "companion.toml").read_text(encoding="utf-8")


def _shown_in_docs() -> str:
    (shown,) = re.findall(r"```toml\n(.*?)```", DOCS, re.DOTALL)
    return re.sub(r"^# ", "", shown, flags=re.MULTILINE)


def _shown_in_sample() -> str:
    (shown,) = re.findall(r"^#\[mqtt\]\n.*?\n$", SAMPLE, re.DOTALL | re.MULTILINE)
    lines = [line[1:] for line in shown.splitlines() if re.match(r"#[\[\w]", line)]
    return "\n".join(lines).replace("tls = false", "tls = true")


@pytest.mark.parametrize("shown", [_shown_in_docs(), _shown_in_sample()], ids=["docs", "sample"])
def test_the_configuration_shown_is_accepted_with_every_key(shown: str) -> None:
    config = parse('[mavlink]\nurl="tcp:h:1"\n[[imu]]\nname="a"\nsource="autopilot"\n' + shown, "shown")
    assert config.mqtt is not None
    assert set(tomllib.loads(shown)["mqtt"]) == set(config.mqtt.__struct_fields__)
