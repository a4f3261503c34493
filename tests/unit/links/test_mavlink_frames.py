"""Finding MAVLink frames without decoding them: as pymavlink's own parser does, and nothing else."""

from __future__ import annotations

import random
from collections import Counter
from functools import partial
from itertools import pairwise
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.links.mavlink.link import MavlinkLink, kind_at

KINDS: dict[int, Any] = mavlink.mavlink_map
MIXTURE = [
    mavlink.MAVLink_highres_imu_message,
    mavlink.MAVLink_heartbeat_message,
    mavlink.MAVLink_param_value_message,  # with text in it
    mavlink.MAVLink_battery_status_message,  # with an array
    mavlink.MAVLink_raw_imu_message,
    mavlink.MAVLink_statustext_message,
    mavlink.MAVLink_vfr_hud_message,
]


def checksum(data: bytes) -> int:
    """CRC-16/MCRF4XX, bit by bit."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x8408 if crc & 1 else 0)
    return crc


def frame(kind: Any, dice: random.Random, size: int | None = None) -> bytes:
    """A frame with random bytes for values, its payload cut short as trailing zeros are."""
    size = dice.randint(1, kind.unpacker.size) if size is None else size
    flags = bytes((0, dice.randrange(256)))  # what may be ignored may be set
    head = bytes((size,)) + flags + bytes(dice.randrange(256) for _ in range(3)) + kind.id.to_bytes(3, "little")
    body: bytes = head + dice.randbytes(size)
    return b"\xfd" + body + checksum(body + bytes((kind.crc_extra,))).to_bytes(2, "little")


def everything(message: Any) -> str:
    """Content of a message as text, for NaN is not NaN."""
    return repr({**vars(message), "_header": vars(message.get_header())})


def codec() -> Any:
    made = mavlink.MAVLink(None)
    made.robust_parsing = True
    return made


def keep(heard: list[Any], message: Any, _t_s: float) -> None:
    heard.append(message)


def test_a_frame_of_each_message_is_found_and_decoded_as_the_parser_does() -> None:
    for message_id, kind in KINDS.items():
        dice, heard, link = random.Random(message_id), list[Any](), MavlinkLink()
        link.subscribe(kind, partial(keep, heard))
        for size in (1, kind.unpacker.size, min(255, kind.unpacker.size + 3), None):
            data = frame(kind, dice, size)
            (expected,) = codec().parse_buffer(data)
            assert type(expected) is kind
            assert kind_at(b"??" + data + b"!", 2) == (kind, 2 + len(data)), kind.msgname
            link.receive(data, 1.0)
            assert everything(heard.pop()) == everything(expected), kind.msgname


@settings(max_examples=150)
@given(seed=st.integers(0, 2**32), wanted=st.sets(st.sampled_from(MIXTURE)), cuts=st.integers(0, 12))
def test_the_link_hears_what_the_codec_alone_would_in_any_split(seed: int, wanted: set[Any], cuts: int) -> None:
    dice = random.Random(seed)
    pieces = [frame(dice.choice(MIXTURE), dice) for _ in range(20)]
    for _ in range(dice.randrange(3)):
        at = dice.randrange(len(pieces))
        pieces[at] = pieces[at][:-1] + bytes((pieces[at][-1] ^ 1,))  # its checksum is wrong, its length is not
    stream = b"".join(pieces)
    expected = codec().parse_buffer(stream) or []
    names = Counter("bad" if m.get_type() == "BAD_DATA" else m.get_type() for m in expected)
    link, heard = MavlinkLink(), list[str]()
    for kind in wanted:
        link.subscribe(kind, lambda message, t_s: heard.append(everything(message)))
    places = sorted({0, len(stream), *(dice.randrange(len(stream)) for _ in range(cuts))})
    for start, end in pairwise(places):
        link.receive(stream[start:end], float(end))
    assert heard == [everything(message) for message in expected if type(message) in wanted]
    assert link.received == names
    assert link.half_received == b""


def test_a_transport_that_is_changed_by_a_message_leaves_nothing_behind() -> None:
    dice = random.Random(3)
    heartbeat, other = frame(mavlink.MAVLink_heartbeat_message, dice), frame(mavlink.MAVLink_vfr_hud_message, dice)
    link, heard = MavlinkLink(), list[str]()
    link.subscribe(mavlink.MAVLink_heartbeat_message, lambda message, t_s: link.attach(None))
    link.subscribe(mavlink.MAVLink_vfr_hud_message, lambda message, t_s: heard.append(message.get_type()))
    link.receive(heartbeat + other + other[:9], 1.0)
    assert link.half_received == b""
    assert heard == []
    link.receive(other, 2.0)
    assert heard == ["VFR_HUD"]
