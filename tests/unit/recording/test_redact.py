"""No signing key in a recording, however the bytes were split; everything else as it came."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.recording.messages import KeyFilter
from tests.unit.links.test_mavlink_signing import KEY, peer

SETUP = mavlink.MAVLink_setup_signing_message(1, 0, list(KEY), 2**40).pack(peer(None))
SIGNED = mavlink.MAVLink_setup_signing_message(1, 0, list(KEY), 2**40).pack(peer(KEY))
OTHERS = [
    mavlink.MAVLink_heartbeat_message(2, 3, 0, number, 4, 3).pack(peer(None)) for number in (0, 1, 256, 65536)
] + [mavlink.MAVLink_param_value_message(b"A\x00\x01\x00", 1.0, 9, 256, 256).pack(peer(None)), b"\x00\x01\x00noise"]


@settings(max_examples=150)
@given(
    st.lists(st.sampled_from([SETUP, SIGNED, *OTHERS]), max_size=6),
    st.lists(st.integers(1, 40), min_size=1, max_size=60),
)
def test_only_the_key_is_taken_out(packets: list[bytes], lengths: list[int]) -> None:
    data, filtered = b"".join(packets), KeyFilter()
    out, place, number = b"", 0, 0
    while place < len(data):
        size = lengths[number % len(lengths)]
        out += filtered(data[place : place + size])
        place, number = place + size, number + 1
    blank = [
        packet[:10] + bytes(packet[1]) + packet[10 + packet[1] :] if packet in (SETUP, SIGNED) else packet
        for packet in packets
    ]
    assert out == b"".join(blank)
    assert not any(KEY[at : at + 4] in out for at in range(29))


def test_what_stands_behind_a_gap_is_another_message() -> None:
    filtered = KeyFilter()
    filtered(SETUP[:20])
    filtered.restart()
    assert filtered(OTHERS[0]) == OTHERS[0]
