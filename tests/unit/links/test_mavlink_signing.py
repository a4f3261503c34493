"""Signing of MAVLink 2, judged by pymavlink's own signing; the key file; the time that never goes back."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.errors import LinkError
from companion.links.mavlink.link import MavlinkLink
from companion.links.mavlink.signing import (
    EPOCH_S,
    LAST,
    MAX_STREAMS,
    TICKS_PER_S,
    Signing,
    SigningClock,
    read_key,
    sign,
)

KEY, OTHER = bytes(range(32)), bytes(32 * [7])
NOW_S = 1790000000.0
NOW = int((NOW_S - EPOCH_S) * 1e5)
HEARTBEAT = mavlink.MAVLink_heartbeat_message
MESSAGE = HEARTBEAT(2, 3, 0, 5, 4, 3)


YEAR_S = 365.25 * 86400.0


class Clocks:
    """A board's clocks that stand still until told."""

    def __init__(self, wall_s: float = NOW_S) -> None:
        self.wall_s, self.up_s = wall_s, 10.0

    def pass_(self, seconds: float) -> None:
        self.wall_s += seconds
        self.up_s += seconds

    def clock(self, start: int = 0) -> SigningClock:
        return SigningClock(start, wall_s=lambda: self.wall_s, uptime=lambda: self.up_s)


def signing(*, required: bool = True, key: bytes | None = KEY, clocks: Clocks | None = None) -> Signing:
    return Signing(required=required, key=key, clock=(clocks or Clocks()).clock())


def peer(
    key: bytes | None = KEY, ticks: int = NOW, *, system: int = 1, component: int = 1, link_id: int = 3
) -> mavlink.MAVLink:
    """pymavlink's own signing."""
    codec = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    codec.robust_parsing = True
    if key is not None:
        codec.signing.secret_key, codec.signing.timestamp, codec.signing.link_id = key, ticks, link_id
        codec.signing.sign_outgoing = True
    return codec


def parsed(codec: mavlink.MAVLink, data: bytes) -> mavlink.MAVLink_message:
    messages = codec.parse_buffer(data)
    assert messages is not None
    (message,) = messages
    return message


def hears(link: MavlinkLink) -> list[int]:
    heard: list[int] = []
    link.subscribe(HEARTBEAT, lambda message, _t: heard.append(message.custom_mode))
    return heard


@settings(max_examples=40)
@given(st.integers(0, 2**48 - 1), st.integers(0, 255), st.binary(min_size=32, max_size=32), st.binary(max_size=50))
def test_what_we_sign_is_what_pymavlink_signs(ticks: int, link_id: int, key: bytes, words: bytes) -> None:
    theirs = mavlink.MAVLink_statustext_message(6, words).pack(peer(key, ticks, link_id=link_id))
    bare = mavlink.MAVLink_statustext_message(6, words).pack(peer(None))
    assert sign(bare, mavlink.MAVLink_statustext_message.crc_extra, key, link_id, ticks) == theirs


def test_pymavlink_takes_ours_with_the_same_key_and_only_then() -> None:
    link, sent = MavlinkLink(), list[bytes]()
    link.signing = signing()
    link.attach(sent.append)
    for _ in range(3):
        link.send(MESSAGE)
    right, wrong = peer(KEY, NOW), peer(OTHER, NOW)
    for data in sent:
        message = parsed(right, data)
        assert message.get_type() == "HEARTBEAT"
        assert message.get_signed()
        message = parsed(wrong, data)
        assert message.get_type() == "BAD_DATA"
    assert right.signing.goodsig_count == 3


@pytest.mark.parametrize("required", [True, False])
def test_only_what_is_signed_with_our_key_has_an_effect(required: bool) -> None:
    link = MavlinkLink()
    link.signing = signing(required=required)
    refused = list[tuple[str, int, int]]()
    link.signing.on_refused = lambda *what: refused.append(what)
    heard = hears(link)
    link.receive(HEARTBEAT(2, 3, 0, 1, 4, 3).pack(peer()), 0.0)
    link.receive(HEARTBEAT(2, 3, 0, 2, 4, 3).pack(peer(None)), 0.0)
    link.receive(HEARTBEAT(2, 3, 0, 3, 4, 3).pack(peer(OTHER)), 0.0)
    link.receive(HEARTBEAT(2, 3, 0, 4, 4, 3).pack(peer(None), force_mavlink1=True), 0.0)
    assert heard == ([1] if required else [1, 2, 3, 4])
    assert link.received["HEARTBEAT"] == len(heard)
    assert link.signing.verified == 1
    assert link.signing.doubted == {"unsigned": 2, "other key": 1}
    assert refused[1] == ("other key", 1, 1)


def test_a_radio_has_no_key() -> None:
    link, heard = MavlinkLink(), list[int]()
    link.signing = signing()
    link.subscribe(mavlink.MAVLink_radio_status_message, lambda message, _t: heard.append(message.rssi))
    link.receive(mavlink.MAVLink_radio_status_message(7, 0, 0, 0, 0, 0, 0).pack(peer(None), force_mavlink1=True), 0.0)
    assert heard == [7]


def test_without_the_key_nothing_is_believed_and_nothing_signed() -> None:
    link, sent = MavlinkLink(), list[bytes]()
    link.signing = signing(key=None)
    heard = hears(link)
    link.attach(sent.append)
    link.receive(MESSAGE.pack(peer()), 0.0)
    link.send(MESSAGE)
    assert heard == []
    assert link.signing.doubted == {"no key": 1}
    assert sent[0][2] == 0


def test_a_message_heard_before_is_not_heard_again() -> None:
    link = MavlinkLink()
    link.signing = signing()
    heard, codec = hears(link), peer()
    packets = [HEARTBEAT(2, 3, 0, number, 4, 3).pack(codec) for number in range(3)]
    for data in [*packets, *packets]:
        link.receive(data, 0.0)
    assert heard == [0, 1, 2]
    assert link.signing.doubted == {"old": 3}
    # Another link of the same sender counts for itself.
    link.receive(HEARTBEAT(2, 3, 0, 9, 4, 3).pack(peer(link_id=4)), 0.0)
    assert heard == [0, 1, 2, 9]


@pytest.mark.parametrize(("late_s", "believed"), [(59.9, True), (60.1, False)])
def test_who_is_heard_first_may_be_a_minute_behind(late_s: float, believed: bool) -> None:
    judge = signing()
    assert judge.admits(MESSAGE.pack(peer(KEY, NOW - int(late_s * TICKS_PER_S)))) is believed


def test_what_was_held_back_on_another_link_of_the_sender_is_old() -> None:
    """Each link id has a time of its own; that of the sender goes on with the newest of them."""
    clocks = Clocks()
    link = MavlinkLink()
    link.signing = signing(clocks=clocks)
    heard = hears(link)
    held_back = [HEARTBEAT(2, 3, 0, 100 + n, 4, 3).pack(peer(ticks=NOW + n, link_id=4)) for n in range(480)]
    for second in range(8):
        link.receive(HEARTBEAT(2, 3, 0, second, 4, 3).pack(peer(ticks=NOW + second * 100_000)), 0.0)
        clocks.pass_(1.0)
    for data in held_back:
        link.receive(data, 0.0)
    assert heard == list(range(8))
    assert link.signing.doubted == {"old": 480}


def test_what_was_held_back_for_more_than_a_minute_is_old_though_nothing_came_since() -> None:
    clocks = Clocks()
    link = MavlinkLink()
    link.signing = signing(clocks=clocks)
    heard = hears(link)
    link.receive(HEARTBEAT(2, 3, 0, 1, 4, 3).pack(peer(ticks=NOW)), 0.0)
    held_back = HEARTBEAT(2, 3, 0, 2, 4, 3).pack(peer(ticks=NOW + 100_000))
    clocks.pass_(62.0)
    link.receive(held_back, 0.0)
    assert heard == [1]


@pytest.mark.parametrize("required", [True, False])
def test_a_link_id_is_that_of_a_signature_with_our_key(required: bool) -> None:
    link, found = MavlinkLink(), list[int | None]()
    link.signing = signing(required=required)
    link.subscribe(HEARTBEAT, lambda message, _t: found.append(link.signed_on(message)))
    for codec in (peer(link_id=7), peer(None), peer(OTHER, link_id=7)):
        link.receive(HEARTBEAT(2, 3, 0, 0, 4, 3).pack(codec), 0.0)
    assert found == ([7] if required else [7, None, None])


def test_a_forged_time_shuts_nobody_out() -> None:
    judge = signing()
    assert judge.admits(MESSAGE.pack(peer(KEY, NOW)))
    assert not judge.admits(MESSAGE.pack(peer(OTHER, LAST - 5)))
    assert judge.admits(MESSAGE.pack(peer(KEY, NOW + 1)))
    assert judge.clock.now() < NOW + TICKS_PER_S


def test_any_flipped_bit_is_refused() -> None:
    data = MESSAGE.pack(peer())
    judge = signing()
    for bit in range(8 * 3, 8 * len(data)):
        broken = bytearray(data)
        broken[bit // 8] ^= 1 << bit % 8
        assert not judge.admits(broken) or int.from_bytes(broken[7:10], "little") in (109, 166), bit
    assert judge.admits(data)


def test_the_senders_that_are_remembered_are_bounded() -> None:
    judge = signing()
    taken = sum(judge.admits(MESSAGE.pack(peer(system=system))) for system in range(1, 100))
    assert taken == MAX_STREAMS


# --- time


def test_time_never_goes_back_with_the_clock() -> None:
    clocks = Clocks()
    clock = clocks.clock()
    before = clock.next()
    assert before == pytest.approx(NOW, abs=2)
    for step_s in (3600.0, -7200.0, -3e8, 0.0):
        clocks.wall_s += step_s
        clocks.pass_(1.0)
        now = clock.next()
        assert now >= before + TICKS_PER_S
        before = now
    # All within the same instant.
    assert [clock.next() - before for _ in range(3)] == [1, 2, 3]


def test_a_jump_of_the_clock_is_refused_and_true_senders_stay_believed() -> None:
    clocks = Clocks()
    judge = Signing(required=True, key=KEY, clock=clocks.clock())
    assert judge.clock.next() == pytest.approx(NOW, abs=2)
    clocks.pass_(1.0)
    clocks.wall_s += 20 * YEAR_S
    assert judge.clock.next() == pytest.approx(NOW + TICKS_PER_S, abs=2)
    assert judge.admits(MESSAGE.pack(peer(KEY, NOW)))
    clocks.wall_s -= 20 * YEAR_S
    # A small correction is followed: receivers allow a minute.
    clocks.wall_s += 30.0
    assert judge.clock.next() == pytest.approx(NOW + 31 * TICKS_PER_S, abs=2)
    # A sender that has the key and the right time is believed, and moves the time.
    assert judge.admits(MESSAGE.pack(peer(KEY, NOW + 90 * TICKS_PER_S)))
    assert judge.clock.next() >= NOW + 90 * TICKS_PER_S


def test_the_end_of_time_is_survived() -> None:
    judge = signing()
    assert judge.admits(MESSAGE.pack(peer(KEY, LAST)))
    assert judge.clock.next() == judge.clock.next() == LAST
    assert len(judge.sign(MESSAGE.pack(peer(None)), MESSAGE.crc_extra)) == len(MESSAGE.pack(peer(None))) + 13


# --- the key file


def key_file(folder: Path, content: bytes, mode: int = 0o600) -> Path:
    path = folder / "signing.key"
    path.write_bytes(content)
    path.chmod(mode)
    return path


RAW = bytes(range(200, 232))


@pytest.mark.parametrize(
    ("content", "key"),
    [
        (RAW, RAW),
        (RAW.hex().encode() + b"\n", RAW),
        (RAW.hex().upper().encode(), RAW),
        # As Mission Planner's `MAVAuthKeys.AddKey` has it.
        (b"Correct Horse 42!\n", bytes.fromhex("a013d10faa418333bc4db7fa9d0c49e5a0906a8ac99afe417d3df932bf68c833")),
        (b"a passphrase of 32 characters ok\r\n", hashlib.sha256(b"a passphrase of 32 characters ok").digest()),
        (b"a passphrase of 32 characters ok", hashlib.sha256(b"a passphrase of 32 characters ok").digest()),
        ("Straße am Fluß".encode(), hashlib.sha256("Straße am Fluß".encode()).digest()),
    ],
)
def test_keys_are_read(tmp_path: Path, content: bytes, key: bytes) -> None:
    assert read_key(key_file(tmp_path, content)) == key


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "found 0 bytes; wanted: 32 bytes"),
        (b"short\n", "found 6 bytes"),
        (b"two lines\nof words\n", "wanted"),
        (b"\xff\xfe" * 20, "wanted"),
        (b"x" * 2000, "wanted"),
        (bytes(32), "zeros"),
        (b"0" * 64, "zeros"),
    ],
)
def test_what_is_no_key_is_said_without_a_word_of_it(tmp_path: Path, content: bytes, words: str) -> None:
    with pytest.raises(LinkError, match=words) as caught:
        read_key(key_file(tmp_path, content))
    assert "signing.key" in str(caught.value)
    assert "two lines" not in str(caught.value)


@pytest.mark.parametrize(
    ("mode", "good"), [(0o600, True), (0o400, True), (0o640, True), (0o604, False), (0o602, False)]
)
def test_a_key_that_everybody_may_open_is_refused(tmp_path: Path, mode: int, good: bool) -> None:
    path = key_file(tmp_path, RAW, mode)
    if good:
        assert read_key(path) == RAW
    else:
        with pytest.raises(LinkError, match=f"everybody on this computer may open it: chmod 600 {path}"):
            read_key(path)


def test_no_file_and_a_folder_are_said(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match="No such file"):
        read_key(tmp_path / "none")
    with pytest.raises(LinkError, match="Is a directory"):
        read_key(tmp_path)


def test_the_key_is_in_no_words() -> None:
    judge = signing(key=RAW)
    assert RAW.hex() not in repr(judge)
    assert repr(RAW) not in repr(judge)


def test_what_is_not_signed_does_not_count_as_heard_even_where_nobody_wants_it() -> None:
    link = MavlinkLink()
    link.signing = signing()
    link.receive(MESSAGE.pack(peer(None)), 1.0)
    assert link.received["HEARTBEAT"] == 0
    link.receive(MESSAGE.pack(peer()), 2.0)
    assert link.received["HEARTBEAT"] == 1
