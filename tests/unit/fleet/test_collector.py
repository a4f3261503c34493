"""A collector's configuration is checked, and its queues are bounded in bytes, whatever comes from the broker."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from companion.errors import ConfigError
from companion.fleet.collector import BATCH, BATCH_BYTES, WAITING, WAITING_BYTES, BoundedMessages, load_broker
from companion.fleet.contract import MOST_BYTES
from companion.mqtt.client import Incoming

LARGEST = Incoming("fleet/0/item", bytes(MOST_BYTES))


@pytest.mark.parametrize(("most", "most_bytes"), [(WAITING, WAITING_BYTES), (BATCH, BATCH_BYTES)])
def test_what_waits_is_bounded_in_bytes_and_in_number(most: int, most_bytes: int) -> None:
    waiting = BoundedMessages(most, most_bytes)
    while not waiting.full():
        waiting.put_nowait(LARGEST)
    with pytest.raises(asyncio.QueueFull):
        waiting.put_nowait(LARGEST)
    assert waiting.qsize() * MOST_BYTES == most_bytes
    waiting.get_nowait()
    waiting.put_nowait(LARGEST)
    while not waiting.empty():
        waiting.get_nowait()
    for _ in range(most):
        waiting.put_nowait(Incoming("fleet/0/hello", b"{}"))
    with pytest.raises(asyncio.QueueFull):
        waiting.put_nowait(Incoming("fleet/0/hello", b"{}"))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "no such file: write one with a section [mqtt] that names the broker"),
        ("", "'mqtt' is missing"),
        ('[mqtt]\nhost = "b"\nprot = 1\n', "unknown key 'mqtt.prot'; did you mean 'port'?"),
        ('[mqtt]\nhost = "b"\n[fleet]\n', "unknown section 'fleet'"),
        ('[mqtt]\nhost = "b"\ncert_file = "/c"\ntls = true\n', "key_file"),
    ],
)
def test_a_configuration_that_cannot_be_used_is_refused_in_one_line(
    tmp_path: Path, text: str | None, said: str
) -> None:
    path = tmp_path / "collector.toml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigError) as refused:
        load_broker(path)
    assert str(refused.value).startswith(f"{path}: ")
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)
