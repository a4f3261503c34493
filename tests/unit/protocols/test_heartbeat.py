"""An autopilot is known by one heartbeat, as pymavlink packs it; nothing else is taken for one."""

from __future__ import annotations

import random
from typing import Any

import pytest
from pymavlink.dialects.v10 import ardupilotmega as first
from pymavlink.dialects.v20 import ardupilotmega as second

from companion.protocols.guess import Heartbeat, heartbeats

NOISE = random.Random(5).randbytes(400)


def packed(dialect: Any, autopilot: int, *, kind: int = 2, system: int = 7, key: bytes | None = None) -> bytes:
    codec = dialect.MAVLink(None, srcSystem=system, srcComponent=1)
    if key is not None:
        codec.signing.secret_key, codec.signing.sign_outgoing, codec.signing.timestamp = key, True, 1
    return bytes(codec.heartbeat_encode(kind, autopilot, 0, 0, 3).pack(codec))


@pytest.mark.parametrize(("autopilot", "words"), [(3, "ArduPilot, system 7"), (12, "PX4, system 7")])
@pytest.mark.parametrize(("dialect", "key"), [(first, None), (second, None), (second, bytes(range(32)))])
def test_one_is_enough_whatever_stands_around_it(dialect: Any, key: bytes | None, autopilot: int, words: str) -> None:
    frame = packed(dialect, autopilot, key=key)
    (found,) = heartbeats(NOISE + frame + NOISE)
    assert found == Heartbeat(7, 1, 2, autopilot)
    assert (str(found), found.is_autopilot) == (words, True)
    assert heartbeats(frame[: len(frame) - (13 if key else 0) - 1]) == []


def test_a_damaged_one_is_none() -> None:
    frame = packed(second, 3)
    for place in range(len(frame)):
        damaged = bytearray(frame)
        damaged[place] ^= 0x10
        # Flags and sequence are under the sum too.
        assert heartbeats(bytes(damaged)) == [], place


def test_noise_and_other_messages_are_none() -> None:
    codec = second.MAVLink(None, srcSystem=1, srcComponent=1)
    other = codec.attitude_encode(1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0).pack(codec)
    assert heartbeats(other * 20) == []
    assert heartbeats(random.Random(6).randbytes(200_000)) == []


def test_autopilots_come_first_and_everybody_once() -> None:
    station = packed(second, 8, kind=6, system=255)
    found = heartbeats(station + packed(second, 3) + station + packed(second, 3))
    assert [str(one) for one in found] == ["ArduPilot, system 7", "ground station, system 255"]
    assert [one.is_autopilot for one in found] == [True, False]
