"""Recordings and logs that somebody made to fill the memory: one line each, and not much memory."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.cli import main as companion
from companion.config import parse
from companion.lab.recording import MAGIC, Recording
from companion.recording import messages

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
    """Pack so many zeros without having them in memory."""
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
        assert companion(["log", command, str(path)]) == 1
        out, said = capsys.readouterr()
        assert out == ""
        assert said.count("\n") == 1
        assert str(path) in said


def head() -> bytes:
    """Versions and configuration, as they stand before the first message."""
    rows = {"format": messages.FORMAT_VERSION, "offset_ns": "0"}
    table = b"".join(text(each.encode()) for row in rows.items() for each in row)
    config = msgspec.json.encode(
        parse('[mavlink]\nurl = "udpin:0.0.0.0:1"\n[[imu]]\nname = "fc"\nsource = "autopilot"\n', "")
    )
    attached = text(messages.CONFIG.encode()) + text(b"") + struct.pack("<Q", len(config)) + config
    return (
        MAGIC + record(12, text(messages.METADATA.encode()) + text(table)) + record(9, bytes(16) + attached + bytes(4))
    )


def found(path: Path) -> tuple[list[bytes], str | None]:
    recording = Recording(path)
    return [data for _, _, data in recording.read()], recording.cut_short


@settings(max_examples=200)
@given(st.data())
def test_no_bytes_do_more_than_end_a_recording(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    begin = head()
    sound = begin + packed(channel(1, b"/a") + message(b"one") * 3) + record(12, text(b"m"))
    damaged = bytearray(sound)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(len(begin), len(sound) - 1))
        damaged[at] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / "damaged.mcap"
    path.write_bytes(damaged[: data.draw(st.integers(len(begin), len(sound)))])
    read, cut_short = found(path)
    assert all(each == b"one" for each in read)
    assert cut_short is not None


# --- states in force


def lists(count: int) -> bytes:
    return b"\xdd" + struct.pack(">I", count)


STATES = {
    "a list longer than the data": lists(2**32 - 1),
    "three million zeros": lists(3 * 10**6) + bytes(3 * 10**6),
    "lists without end": lists(900_000) + b"\x90" * 900_000,
    "depth without end": b"\x91" * 900_000,
    "an IMU that is turned by nothing": msgspec.msgpack.encode(
        {
            "sender": [1, 1], "firmware": None, "instance": 1, "message": None, "calibration": None,
            "input": {"name": "fc", "rotation": [[]] * 9, "profile": {"name": "x", "gyro": {}, "accel": {}}},
        }
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", STATES)
@pytest.mark.parametrize("command", ["replay", "profile"])
def test_a_state_that_would_fill_the_memory_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], what: str, command: str, request: pytest.FixtureRequest
) -> None:
    path = tmp_path / "state.mcap"
    start = messages.encode(messages.Start())
    path.write_bytes(
        head()
        + packed(channel(1, messages.START.encode()) + message(start))
        + packed(channel(1, messages.IMU.encode() + b"fc") + message(STATES[what]))
    )
    request.getfixturevalue("_little_memory")
    assert companion(["log", command, str(path)]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"companion: {path}: a message on /autopilot/imu/fc cannot be used by this version (")
    assert said.count("\n") == 1
    assert len(said) < 400


# --- logs of others

HEAD = b"t_s,gx_rad_s,gy_rad_s,gz_rad_s,ax_g,ay_g,az_g\n"
