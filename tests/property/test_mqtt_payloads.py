"""Any published request gets a verdict of one line that can be sent."""

from __future__ import annotations

import json

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from companion.commands import Interface
from companion.mqtt.daemon import KNOWN, MAX_PAYLOAD_BYTES, parse

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=10,
)
keys = st.sampled_from(["transaction", "what", "timeout_s", "reboot", "force"]) | st.text()
objects = st.dictionaries(keys, values, max_size=4).map(lambda found: json.dumps(found).encode())


@given(command=st.sampled_from([*KNOWN, "other"]), payload=st.binary(max_size=200) | objects)
def test_no_payload_raises_and_every_verdict_is_one_short_line(command: str, payload: bytes) -> None:
    verdict = parse(command, payload)
    if verdict.problem:
        assert verdict.problem.isprintable()
        assert len(verdict.problem) < 400
        msgspec.json.encode({"transaction": verdict.transaction, "reason": verdict.problem})
    else:
        assert len(payload) <= MAX_PAYLOAD_BYTES
        assert set(verdict.content) <= set(KNOWN[command].fields(Interface.MQTT))
        sent = json.loads(payload) if payload.strip() else {}
        assert verdict.transaction == sent.get("transaction")
        assert verdict.command == command
        assert verdict.content == {key: value for key, value in sent.items() if key != "transaction"}
