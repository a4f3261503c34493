"""The MAVLink codec's wrapper: what comes in never raises, what goes out is numbered, and nobody disturbs another."""

from __future__ import annotations

import logging
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.links.mavlink.link import MavlinkLink

HEARTBEAT = mavlink.MAVLink_heartbeat_message
STATUSTEXT = mavlink.MAVLink_statustext_message


def sender(system_id: int = 1, component_id: int = 1) -> mavlink.MAVLink:
    return mavlink.MAVLink(None, srcSystem=system_id, srcComponent=component_id)


def heartbeats(count: int, codec: mavlink.MAVLink | None = None) -> list[bytes]:
    codec = codec or sender()
    packets: list[bytes] = []
    for i in range(count):
        packets.append(HEARTBEAT(2, 3, 0, i, 4, 3).pack(codec))
        codec.seq = (codec.seq + 1) % 256
    return packets


def listening(link: MavlinkLink) -> list[tuple[int, float]]:
    heard: list[tuple[int, float]] = []
    link.subscribe(HEARTBEAT, lambda message, t_s: heard.append((message.custom_mode, t_s)))
    return heard


@settings(max_examples=200)
@given(st.lists(st.binary(max_size=400) | st.binary(max_size=40).map(lambda data: b"\xfd" + data), max_size=20))
def test_garbage_never_raises_and_good_packets_after_it_are_heard(chunks: list[bytes]) -> None:
    link = MavlinkLink()
    heard = listening(link)
    for chunk in chunks:
        link.receive(chunk, 0.0)
    link.receive(bytes(300), 0.0)  # no frame is longer than 280 bytes
    heard.clear()
    (packet,) = heartbeats(1)
    link.receive(packet, 7.0)
    assert heard == [(0, 7.0)]
    assert link.received["handler error"] == 0


@settings(max_examples=200)
@given(position=st.integers(1, 20), bit=st.integers(0, 7))
def test_a_flipped_bit_is_a_counted_loss_and_never_a_wrong_message(position: int, bit: int) -> None:
    good, broken, *rest = heartbeats(20)
    damaged = bytearray(broken)
    damaged[position] ^= 1 << bit
    link = MavlinkLink()
    heard = listening(link)
    link.receive(good + bytes(damaged) + b"".join(rest), 0.0)
    modes = [mode for mode, _ in heard]
    assert modes[0] == 0
    assert 1 not in modes
    assert modes == sorted(set(modes))
    assert modes[-1] == 19, "a false length may cost what it spans, but not all that follows"
    assert link.received["bad"] + link.received["unknown"] >= 1


def test_both_versions_of_the_protocol_are_understood_and_version_2_is_spoken() -> None:
    link = MavlinkLink()
    heard = listening(link)
    link.receive(HEARTBEAT(2, 3, 0, 5, 4, 3).pack(sender(), force_mavlink1=True), 0.0)
    assert [mode for mode, _ in heard] == [5]
    sent: list[bytes] = []
    link.attach(sent.append)
    link.send(HEARTBEAT(2, 3, 0, 5, 4, 3))
    assert sent[0][0] == 0xFD


def test_sequence_numbers_count_and_wrap() -> None:
    sent: list[bytes] = []
    link = MavlinkLink(system_id=9, component_id=191)
    link.attach(sent.append)
    for _ in range(600):
        assert link.send(HEARTBEAT(18, 8, 0, 0, 4, 3))
    assert [packet[4] for packet in sent] == [i % 256 for i in range(600)]
    assert {(packet[5], packet[6]) for packet in sent} == {(9, 191)}
    assert link.sent == 600
    link.join((42, 1))
    link.send(HEARTBEAT(18, 8, 0, 0, 4, 3))
    assert sent[-1][5] == 42


def test_what_cannot_be_sent_is_counted() -> None:
    link = MavlinkLink()
    assert not link.connected
    assert not link.send(HEARTBEAT(18, 8, 0, 0, 4, 3))
    link.attach(lambda data: False)
    assert not link.send(HEARTBEAT(18, 8, 0, 0, 4, 3))
    assert (link.sent, link.dropped) == (0, 2)
    link.attach(lambda data: None)
    assert link.send(HEARTBEAT(18, 8, 0, 0, 4, 3))
    link.attach(None)
    assert not link.send(HEARTBEAT(18, 8, 0, 0, 4, 3))
    assert (link.sent, link.dropped) == (1, 3)


def test_a_handler_that_breaks_disturbs_nobody(caplog: pytest.LogCaptureFixture) -> None:
    link = MavlinkLink()
    before = listening(link)

    def breaks(_message: HEARTBEAT, _t_s: float) -> None:
        raise ZeroDivisionError

    link.subscribe(HEARTBEAT, breaks)
    after = listening(link)
    with caplog.at_level(logging.ERROR):
        link.receive(b"".join(heartbeats(3)), 0.0)
    assert [mode for mode, _ in before] == [mode for mode, _ in after] == [0, 1, 2]
    assert link.received["handler error"] == 3
    assert "a listener failed on HEARTBEAT" in caplog.text


def test_each_hears_only_its_kind_until_it_unsubscribes() -> None:
    link = MavlinkLink()
    heard = listening(link)
    texts: list[str] = []
    unsubscribe = link.subscribe(STATUSTEXT, lambda message, _: texts.append(message.text))
    codec = sender()
    link.receive(STATUSTEXT(6, b"one").pack(codec) + heartbeats(1, codec)[0], 0.0)
    unsubscribe()
    unsubscribe()
    link.receive(STATUSTEXT(6, b"two").pack(codec), 0.0)
    assert texts == ["one"]
    assert len(heard) == 1
    assert link.received["STATUSTEXT"] == 2


def test_unsubscribing_in_the_middle_of_a_message_is_allowed() -> None:
    link = MavlinkLink()
    heard: list[int] = []

    def once(message: HEARTBEAT, _t_s: float) -> None:
        heard.append(message.custom_mode)
        unsubscribe()

    unsubscribe = link.subscribe(HEARTBEAT, once)
    also = listening(link)
    link.receive(b"".join(heartbeats(3)), 0.0)
    assert heard == [0]
    assert len(also) == 3


def test_noise_that_looks_like_unknown_messages_does_not_fill_the_statistics() -> None:
    link = MavlinkLink()
    dice = random.Random(5)
    for _ in range(3000):
        message_id = dice.randrange(60000, 1 << 24)
        link.receive(b"\xfd\x01\0\0\0\x01\x01" + message_id.to_bytes(3, "little") + b"\0\0\0", 0.0)
    assert link.received["unknown"] == 3000
    assert len(link.received) < 5


def test_a_stream_whose_reads_never_end_on_a_packets_end_is_not_kept_for_ever() -> None:
    link = MavlinkLink()
    heard = listening(link)
    stream = b"".join(heartbeats(5000))
    size = len(stream) // 5000
    for start in range(-1, len(stream), size):  # each read ends one byte before the end of a packet
        link.receive(stream[max(start, 0) : start + size], 0.0)
        assert len(link._codec.buf) < 5000
    link.receive(stream[-1:], 0.0)
    assert len(heard) == 5000


def test_a_recording_is_told_that_the_rest_of_a_cut_off_datagram_is_not_carried_on() -> None:
    link, taped = MavlinkLink(), list[tuple[str, bytes | None]]()
    link.on_bytes.add(lambda direction, data, _t_s: taped.append((direction, data)))
    whole = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1))
    senders: list[tuple[int, int]] = []
    link.receive_datagram(whole + whole[:5], 0.0, senders.append)
    link.receive_datagram(whole, 0.0, senders.append)
    assert taped == [("in", whole + whole[:5]), ("in", None), ("in", whole)]
    assert senders == [(1, 1), (1, 1)]
    assert (link.received["HEARTBEAT"], link.received["bad"]) == (2, 1)
