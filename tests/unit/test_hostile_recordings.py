"""Recordings and logs that somebody made to fill the memory: one line each, and not much memory."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.cli import main as companion
from companion.config import parse
from companion.recording import topics
from companion.recording.files import versions
from companion.recording.past import unpacked
from companion.recording.walk import MAGIC, Message, Recording

MB = 1 << 20
MOST = 128 * MB
"""Some chunks, unpacked, and what is made of one."""


def record(kind: int, content: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(content)) + content


def text(words: bytes) -> bytes:
    return struct.pack("<I", len(words)) + words


def channel(number: int, topic: bytes) -> bytes:
    return record(4, struct.pack("<HH", number, 0) + text(topic) + text(b"json") + struct.pack("<I", 0))


def message(data: bytes) -> bytes:
    return record(5, struct.pack("<HIQQ", 1, 0, 1, 1) + data)


def chunk(packed: bytes, size: int) -> bytes:
    return record(6, struct.pack("<QQQI", 0, 0, size, 0) + text(b"zstd") + struct.pack("<Q", len(packed)) + packed)


def packed(data: bytes) -> bytes:
    return chunk(zstandard.compress(data), len(data))


def filled(size: int) -> bytes:
    """A channel and one message: so many bytes in all, each of which looks like the beginning of a message."""
    head = channel(1, b"/a")
    return head + message(b"\x05" * (size - len(head) - len(message(b""))))


def frame_of(size: int, *, said: bool) -> bytes:
    """So many zeros, packed without having them in memory."""
    packer = zstandard.ZstdCompressor(write_content_size=said).compressobj(size=size if said else -1)
    piece = bytes(MB)
    return b"".join(packer.compress(piece) for _ in range(size // MB)) + packer.flush()


def tiny(size: int) -> bytes:
    one = message(b"")
    return channel(1, b"/a") + one * ((size - 100) // len(one))


def topics_without_end() -> bytes:
    return b"".join(channel(number & 0xFFFF, b"/t%d" % number) for number in range(400_000))


BOMBS = {
    "a chunk of 64 MB": lambda: packed(filled(64 * MB)),
    "tiny messages, 64 MB of them": lambda: packed(tiny(64 * MB)),
    "a chunk of 16 MB, whatever is in it": lambda: packed(filled(16 * MB)),
    "a hundred chunks of 16 MB": lambda: packed(filled(16 * MB)) * 100,
    "a frame that holds more than the chunk says": lambda: chunk(frame_of(256 * MB, said=True), 100),
    "a frame that does not say how much it holds": lambda: chunk(frame_of(256 * MB, said=False), 100),
    "a frame that says a terabyte": lambda: chunk(b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 1 << 40) + b"\1\0\0", 9),
    "240 MB of messages in a file of 3 MB": lambda: record(0x80, bytes(3 * MB)) + packed(filled(8 * MB)) * 30,
    "topics without end": lambda: packed(topics_without_end()),
    "a record longer than the file": lambda: struct.pack("<BQ", 9, 2**63 - 1),
    "an attachment's name longer than it": lambda: record(9, bytes(16) + struct.pack("<I", 2**32 - 1)),
    "a table longer than its record": lambda: record(12, text(b"") + struct.pack("<I", 2**32 - 1)),
}


@pytest.fixture
def _little_memory() -> Iterator[None]:
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < MOST
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("what", BOMBS)
def test_a_bomb_is_not_unpacked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], what: str, request: pytest.FixtureRequest
) -> None:
    path = tmp_path / "bomb.mcap"
    path.write_bytes(MAGIC + BOMBS[what]())
    assert path.stat().st_size < 4 * MB
    request.getfixturevalue("_little_memory")
    for command in ("replay", "profile"):
        assert companion([command, str(path)]) == 1
        out, said = capsys.readouterr()
        assert out == ""
        assert said.count("\n") == 1
        assert str(path) in said


def test_what_was_recorded_before_a_bomb_is_read(tmp_path: Path) -> None:
    path = tmp_path / "bomb.mcap"
    whole = channel(1, b"/a") + message(b"one")
    path.write_bytes(MAGIC + packed(whole) + packed(filled(17 * MB)))
    recording = Recording(path)
    assert [item.data for item in recording if isinstance(item, Message)] == [b"one"]
    at = len(MAGIC) + len(packed(whole)) + 9
    assert recording.cut_short == f"damaged at byte {at}: found {17 * MB} bytes in one piece; allowed: {16 * MB}"


@pytest.mark.parametrize(
    ("records", "why"),
    [
        (lambda: packed(topics_without_end()), "damaged: more than 1024 topics"),
        (
            lambda: channel(1, b"/a") + message(bytes(17 * MB)),
            f"found {17 * MB + 22} bytes in one piece; allowed: {16 * MB}",
        ),
    ],
)
def test_what_no_recording_has_ends_it(tmp_path: Path, records: Callable[[], bytes], why: str) -> None:
    path = tmp_path / "bomb.mcap"
    path.write_bytes(MAGIC + records())
    recording = Recording(path)
    assert list(recording) == []
    assert recording.cut_short is not None
    assert recording.cut_short.endswith(why)


def test_a_file_that_is_a_thousand_times_as_much_unpacked_is_not_read_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "bomb.mcap"
    path.write_bytes(MAGIC + packed(filled(4 * MB)) * 100)
    recording = Recording(path)
    assert sum(len(item.data) for item in recording if isinstance(item, Message)) < 16 * MB + 100 * path.stat().st_size
    assert recording.cut_short == "damaged: unpacks to more than 100 times its size"


def test_bytes_that_look_like_messages_hide_none(tmp_path: Path) -> None:
    sizes = [0, 1, 31, 500, 40_000, 7]
    path = tmp_path / "fives.mcap"
    path.write_bytes(MAGIC + packed(channel(1, b"/a") + b"".join(message(b"\x05" * size) for size in sizes)))
    assert [len(item.data) for item in Recording(path) if isinstance(item, Message)] == sizes


@settings(max_examples=200)
@given(st.data())
def test_no_bytes_do_more_than_end_a_recording(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    sound = MAGIC + record(1, text(b"") * 2) + packed(channel(1, b"/a") + message(b"one") * 3) + record(12, text(b"m"))
    damaged = bytearray(sound)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(len(MAGIC), len(sound) - 1))
        damaged[at] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / "damaged.mcap"
    path.write_bytes(damaged[: data.draw(st.integers(len(MAGIC), len(sound)))])
    recording = Recording(path)
    for item in recording:
        assert not isinstance(item, Message) or item.data == b"one" or len(item.data) <= len(sound)
    assert recording.cut_short is not None


# --- what is in force, in it


def lists(count: int) -> bytes:
    return b"\xdd" + struct.pack(">I", count)


DETAILS = {
    "a list longer than the data": lists(2**32 - 1),
    "ten million zeros": lists(10**7) + bytes(10**7),
    "lists without end": lists(900_000) + b"\x90" * 900_000,
    "depth without end": b"\x91" * 900_000,
    "an IMU that is turned by nothing": msgspec.msgpack.encode(
        {"name": "fc", "rotation": [[]] * 9, "profile": {"name": "x", "gyro": {}, "accel": {}}}
    ),
}


@pytest.mark.parametrize(
    "packed_second",
    [
        frame_of(256 * MB, said=True),
        frame_of(256 * MB, said=False),
        zstandard.compress(msgspec.msgpack.encode([(topics.PAST, 1.0, b"")])),
        zstandard.compress(b"\xdd\xff\xff\xff\xff"),
        b"no frame",
    ],
)
def test_a_second_of_before_that_would_fill_the_memory_is_refused(packed_second: bytes) -> None:
    tracemalloc.start()
    try:
        with pytest.raises((ValueError, msgspec.MsgspecError)):
            unpacked(packed_second)
        assert tracemalloc.get_traced_memory()[1] < MOST
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("what", DETAILS)
def test_an_event_that_would_fill_the_memory_is_one_line_of_the_replay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], what: str, request: pytest.FixtureRequest
) -> None:
    table = b"".join(
        text(each.encode()) for item in (versions() | {"t_s": "1", "unix_s": "1"}).items() for each in item
    )
    config = msgspec.json.encode(
        parse('[mavlink]\nurl = "udpin:0.0.0.0:1"\n[[imu]]\nname = "fc"\nsource = "autopilot"\n', "")
    )
    start = msgspec.json.encode(topics.StartEntry(1.0, 0))
    entry = msgspec.json.encode(topics.JournalEntry(1.0, "imu", DETAILS[what]))
    path = tmp_path / "event.mcap"
    path.write_bytes(
        MAGIC
        + record(12, text(topics.METADATA.encode()) + text(table))
        + record(
            9, bytes(16) + text(topics.CONFIG.encode()) + text(b"") + struct.pack("<Q", len(config)) + config + bytes(4)
        )
        + packed(channel(1, topics.START.encode()) + message(start))
        + packed(channel(1, topics.JOURNAL.encode()) + message(entry))
    )
    request.getfixturevalue("_little_memory")
    assert companion(["replay", str(path)]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"companion: {path}: a message on /companion/journal cannot be used by this version (")
    assert said.count("\n") == 1
    assert len(said) < 400


# --- logs of others

HEAD = b"t_s,gx_rad_s,gy_rad_s,gz_rad_s,ax_g,ay_g,az_g\n"


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (b"t_s,gx," * 1_500_000, 1),
        (HEAD + b"1,0,0,0,0,0,1\n" + b"1" * 10_000_000, 3),
        (b"#" * 10_000_000, 1),
        (HEAD + b"1,0,0,0,0,0," + b"1" * 100_000 + b"\n2,0,0,0,0,0,1\n", 2),
    ],
)
@pytest.mark.parametrize("command", ["replay", "profile"])
def test_a_line_without_end_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes, line: int, command: str
) -> None:
    path = tmp_path / "log.csv"
    path.write_bytes(content)
    assert companion([command, str(path)]) == 1
    assert capsys.readouterr().err == f"companion: {path}, line {line}: found no line end within 16384 characters\n"
