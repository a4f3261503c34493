"""The thread's side of recording: files, the ring, a full disk, a disk that does not keep up."""

from __future__ import annotations

import io
import os
import random
import stat
import tracemalloc
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any

import msgspec
import pytest
from mcap.reader import make_reader

from companion.errors import StorageError
from companion.recording import journal as journal_module
from companion.recording import past as past_module
from companion.recording import topics
from companion.recording.files import RESERVE_BYTES, Beginning, RecordingFile, Ring, versions
from companion.recording.journal import Journal
from companion.recording.past import Message as Written
from companion.recording.past import Past
from companion.recording.walk import Message, Recording
from companion.samples import ImuSample

MB = 1 << 20


def beginning(t_s: float = 1000.0) -> Beginning:
    return Beginning(t_s=t_s, unix_s=1.7e9, versions=versions(), config=b"{}", past=Past(60.0, ()))


def taken(journal: Journal) -> list[Written]:
    return Past(60.0, ()).messages(journal.drain())


def raw(count: int, size: int, seed: int = 0) -> list[Written]:
    """Messages that do not get smaller by compression."""
    rng = random.Random(seed)
    made = Journal()
    made.begin(1000.0)
    for k in range(count):
        made.raw("/serial/own", 1000.0 + k / 100, rng.randbytes(size))
    return taken(made)[1:]


def messages(path: Path, topic: str) -> list[Message]:
    return [item for item in Recording(path) if isinstance(item, Message) and item.topic == topic]


def numbers(folder: Path) -> list[int]:
    return sorted(int(path.stem) for path in folder.glob("*.mcap"))


def test_the_ring_keeps_within_its_size_and_the_oldest_go_first(tmp_path: Path) -> None:
    ring = Ring(tmp_path / "ring", 2 * MB)
    kept = tmp_path / "ring" / "kept-001.mcap"
    most = 0
    seen: set[int] = set()
    for second in range(60):
        if ring.is_full:
            ring.close()
        ring.write(raw(40, 2000, second), beginning())
        if second == 0:
            kept.write_bytes(b"asked for by somebody")
        now = [path for path in (tmp_path / "ring").iterdir() if path != kept]
        most = max(most, sum(path.stat().st_size for path in now))
        present = set(numbers_of(now))
        assert not any(number < max(seen - present, default=0) for number in present), "an older file outlived a newer"
        seen |= present
    ring.close()
    assert most <= 2 * MB
    assert most > 1.5 * MB
    assert len(seen) >= 10
    assert kept.exists()
    left = sorted(path for path in (tmp_path / "ring").glob("0*.mcap"))
    assert len(left) >= 5
    for path in left:
        assert messages(path, topics.START), "every file can be replayed by itself"
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count > 0


def numbers_of(paths: Iterable[Path]) -> list[int]:
    return [int(path.stem) for path in paths]


def test_a_ring_found_too_large_at_start_is_made_smaller(tmp_path: Path) -> None:
    for number in range(1, 9):
        (tmp_path / f"{number:06d}.mcap").write_bytes(bytes(MB))
    ring = Ring(tmp_path, 4 * MB)
    ring.write(raw(1, 10), beginning())
    ring.close()
    assert numbers(tmp_path) == [6, 7, 8, 9]


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "mine.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(StorageError, match="exists already"):
        RecordingFile(path)
    assert path.read_bytes() == b"precious"


def test_a_recording_is_its_owners_alone_whatever_the_umask(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        ring = Ring(tmp_path / "ring", 8 * MB)
        ring.write(raw(1, 10), beginning())
        ring.close()
        asked_for = RecordingFile(tmp_path / "mine.mcap")
        asked_for.write([], beginning())
        asked_for.close()
    finally:
        os.umask(before)
    modes = {path.name: stat.filemode(path.stat().st_mode) for path in tmp_path.rglob("*")}
    assert modes == {
        "ring": "drwx------",
        "000001.mcap": "-rw-------",
        "mine.mcap": "-rw-------",
    }


def full(path: Path) -> IO[bytes]:
    return Path("/dev/full").open("wb")


def test_a_full_disk_is_one_line_and_what_was_written_is_a_recording(tmp_path: Path) -> None:
    file = RecordingFile(tmp_path / "a.mcap", full)
    with pytest.raises(StorageError, match=r"a\.mcap: cannot be written: No space left on device"):
        file.write(raw(100, 1000), beginning())
    file.write(raw(1, 10), beginning())  # nothing more happens
    file.close()


def test_the_disk_is_never_filled_to_the_brim_and_the_ring_gives_way_first(tmp_path: Path) -> None:
    free = 10 * RESERVE_BYTES

    def left(folder: Path) -> int:
        return free

    ring = Ring(tmp_path, 8 * MB, free_bytes=left)
    for second in range(8):
        ring.write(raw(10, 5000, second), beginning())
        ring.close()
    assert len(numbers(tmp_path)) == 8
    ring.write(raw(10, 5000), beginning())
    free = RESERVE_BYTES - 1
    with pytest.raises(StorageError, match="less than 32 MB free"):
        ring.write(raw(10, 5000, 99), beginning())
    assert numbers(tmp_path) == [9], "old recordings make room for what matters more"
    assert messages(tmp_path / "000009.mcap", topics.START)
    free = 10 * RESERVE_BYTES
    ring.write(raw(10, 5000), beginning())
    ring.close()
    assert numbers(tmp_path) == [9, 10]


def test_what_finds_no_room_is_lost_in_one_piece_and_said_in_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(journal_module, "MOST_ENTRIES", 50)
    made = Journal()
    made.begin(1000.0)
    file = RecordingFile(tmp_path / "a.mcap")
    for k in range(20):
        made.raw("/serial/own", 1000.0 + k, bytes([k]))
    file.write(taken(made), beginning())
    for k in range(20, 90):  # the disk hangs
        made.raw("/serial/own", 1000.0 + k, bytes([k]))
    assert made.drain() == [], "nothing of a part with a hole in it"
    assert made.lost == made.lost_in_all == 70
    made.begin(1090.0)
    for k in range(90, 95):
        made.raw("/serial/own", 1000.0 + k, bytes([k]))
    file.write(taken(made), beginning())
    file.close()
    entries = [topics_of(message) for message in messages(tmp_path / "a.mcap", topics.START)]
    assert [entry.lost for entry in entries] == [0, 0, 70], "the file, the journal, the journal again"
    found = [
        msgspec.json.decode(message.data, type=topics.RawBytes).data
        for message in messages(tmp_path / "a.mcap", "/serial/own")
    ]
    assert found == [bytes([k]) for k in [*range(20), *range(90, 95)]]


def topics_of(message: Message) -> topics.StartEntry:
    return msgspec.json.decode(message.data, type=topics.StartEntry)


def test_raw_bytes_in_waiting_are_bounded_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(journal_module, "MOST_BYTES", 1000)
    made = Journal()
    made.begin(0.0)
    for k in range(3):
        made.raw("/mavlink/in", float(k), bytes(400))
    assert made.lost == 4  # its beginning too
    assert made.items == []


def in_second(message: Written) -> list[Written]:
    return past_module.unpacked(msgspec.json.decode(message[2], type=topics.PastEntry).packed)


def test_a_flood_of_one_second_takes_little_memory_on_its_way_to_the_disk() -> None:
    chance = random.Random(1)
    datagrams = [chance.randbytes(1400) for _ in range(journal_module.MOST_BYTES // 1400)]
    made, past = Journal(), Past(60.0, ())
    made.begin(0.0)
    for datagram in datagrams:
        made.raw(topics.MAVLINK_IN, 1.0, datagram)
    assert not made.lost
    entries = made.drain()
    tracemalloc.start()
    try:
        past.keep(entries, past.messages(entries), 1.0)
        _, most_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most_bytes < 12 * MB


def test_a_file_begins_with_the_seconds_before_it_and_with_what_is_in_force(tmp_path: Path) -> None:
    made, past = Journal(), Past(1.0, ("fc",))
    made.set_in_force(990.0, "expect", (True, False))
    made.begin(1000.0)
    sample = ImuSample(1000.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), None)
    for second in range(200):
        now_s = 1000.0 + second
        made.raw("/serial/own", now_s, bytes([second]))
        made.raw(topics.MAVLINK_OUT, now_s, b"sent")
        made.imu("own", sample, None)
        made.imu("fc", sample, "RAW_IMU")
        if second == 20:
            made.set_in_force(now_s, "expect", (True, True))
        entries = made.drain()
        past.keep(entries, past.messages(entries), now_s + 0.5)
    start, in_force, *seconds = past.beginning(1200.0)
    assert (start[0], in_force[0]) == (topics.START, topics.JOURNAL)
    assert b'"expect"' in in_force[2]
    assert in_force[1] == 1020.0, "the latest before the first second that is kept"
    assert {second[0] for second in seconds} == {topics.PAST}
    found = [message for second in seconds for message in in_second(second)]
    assert {message[0] for message in found} == {"/serial/own", "/imu/fc"}
    assert [message[1] for message in found if message[0] == "/serial/own"] == [1000.0 + k for k in range(133, 200)]


def test_the_seconds_before_are_bounded_in_bytes_and_end_at_a_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(past_module, "MOST_BYTES", 10_000)
    past, made = Past(60.0, ()), Journal()
    made.begin(0.0)
    for second in range(20):
        made.raw("/serial/own", second, os.urandom(1500))
        entries = made.drain()
        past.keep(entries, past.messages(entries), second)
    assert [message[1] for message in past.beginning(20.0)[1:]] == [14, 15, 16, 17, 18, 19]
    made.begin(30.0)
    entries = made.drain()
    past.keep(entries, past.messages(entries), 30.0)
    assert [in_second(second) for second in past.beginning(30.0)[1:]] == [[]]


@pytest.mark.parametrize("content", [b"", b"hello, world, this is no recording", bytes(100)])
def test_an_empty_or_foreign_file_is_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(StorageError, match=r"the file is empty|not a recording \(MCAP\)") as caught:
        list(Recording(path))
    assert "\n" not in str(caught.value)


def test_another_writers_file_is_walked_like_its_own_reader_does(tmp_path: Path) -> None:
    from mcap.writer import CompressionType, Writer

    for compression in (CompressionType.ZSTD, CompressionType.NONE):
        out = io.BytesIO()
        writer: Any = Writer(out, chunk_size=500, compression=compression)
        writer.start()
        schema = writer.register_schema("s", "jsonschema", b"{}")
        channels = [writer.register_channel(f"/t{k}", "json", schema) for k in range(3)]
        for k in range(200):
            writer.add_message(channels[k % 3], k, b"x" * k, k)
        writer.add_attachment(0, 0, "name", "text/plain", b"attached")
        writer.add_metadata("meta", {"a": "b"})
        writer.finish()
        path = tmp_path / "o.mcap"
        path.write_bytes(out.getvalue())
        recording = Recording(path)
        walked = [(item.topic, item.data) for item in recording if isinstance(item, Message)]
        out.seek(0)
        assert walked == [(channel.topic, message.data) for _, channel, message in make_reader(out).iter_messages()]
        assert recording.cut_short is None
