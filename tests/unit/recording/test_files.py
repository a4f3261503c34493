"""The thread's side of recording: files, the ring, a full disk, a disk that does not keep up."""

from __future__ import annotations

import os
import random
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import IO

import pytest
from mcap.reader import make_reader

from companion.errors import StorageError
from companion.estimation.solution.site import Whereabouts
from companion.lab.recording import Recording
from companion.recording import files, messages
from companion.recording.files import RESERVE_BYTES, Beginning, RecordingFile, Ring
from companion.recording.messages import PLACE, START, Message, Tape, decode, encode

MB = 1 << 20


def beginning(t_s: float = 1000.0) -> Beginning:
    return Beginning(t_s=t_s, offset_ns=1_700_000_000 * 10**9, config=b"{}", states=())


def raw(count: int, size: int, seed: int = 0) -> list[Message]:
    """Messages that do not get smaller by compression."""
    rng = random.Random(seed)
    return [("/serial/own", 1000.0 + k / 100, rng.randbytes(size)) for k in range(count)]


def on_topic(path: Path, topic: str) -> list[Message]:
    return [item for item in Recording(path).read() if item[0] == topic]


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
        assert on_topic(path, START), "every file can be replayed by itself"
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count > 0


def numbers_of(paths: Iterable[Path]) -> list[int]:
    return [int(path.stem) for path in paths]


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


def test_a_full_disk_is_one_line_and_what_was_written_is_a_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "open_new", full)
    file = RecordingFile(tmp_path / "a.mcap")
    with pytest.raises(StorageError, match=r"a\.mcap: recording cannot be written: No space left on device"):
        file.write(raw(100, 1000), beginning())
    file.write(raw(1, 10), beginning())  # nothing more happens
    file.close()


def test_the_disk_is_never_filled_to_the_brim_and_the_ring_gives_way_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = 10 * RESERVE_BYTES
    monkeypatch.setattr(files, "free_bytes", lambda folder: free)
    ring = Ring(tmp_path, 8 * MB)
    for second in range(8):
        ring.write(raw(10, 5000, second), beginning())
        ring.close()
    assert len(numbers(tmp_path)) == 8
    ring.write(raw(10, 5000), beginning())
    free = RESERVE_BYTES - 1
    with pytest.raises(StorageError, match="less than 32 MB free"):
        ring.write(raw(10, 5000, 99), beginning())
    assert numbers(tmp_path) == [9], "old recordings make room for what matters more"
    assert on_topic(tmp_path / "000009.mcap", START)
    free = 10 * RESERVE_BYTES
    ring.write(raw(10, 5000), beginning())
    ring.close()
    assert numbers(tmp_path) == [9, 10]


def test_what_finds_no_room_is_lost_in_one_piece_and_said_in_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(messages, "MOST_MESSAGES", 50)
    tape = Tape()
    tape.begin(1000.0)
    file = RecordingFile(tmp_path / "a.mcap")
    for k in range(20):
        tape.put("/serial/own", 1000.0 + k, bytes([k]))
    file.write(tape.drain(1020.0)[2], beginning())
    for k in range(20, 90):  # the disk hangs
        tape.put("/serial/own", 1000.0 + k, bytes([k]))
    assert tape.drain(1090.0)[2] == [], "nothing of a part with a hole in it"
    assert tape.lost == tape.lost_in_all == 70
    tape.begin(1090.0)
    for k in range(90, 95):
        tape.put("/serial/own", 1000.0 + k, bytes([k]))
    file.write(tape.drain(1095.0)[2], beginning())
    file.close()
    starts = [decode(START, data) for _, _, data in on_topic(tmp_path / "a.mcap", START)]
    assert [start.lost for start in starts] == [0, 0, 70], "the file, the tape, the tape again"
    found = on_topic(tmp_path / "a.mcap", "/serial/own")
    wanted = [*range(20), *range(90, 95)]
    assert found == [("/serial/own", 1000.0 + k, bytes([k])) for k in wanted]


def test_a_file_begins_with_the_states_in_force_and_says_whether_it_follows_on_another(tmp_path: Path) -> None:
    tape, ring = Tape(), Ring(tmp_path, 8 * MB)
    tape.put_state(PLACE, 990.0, encode(Whereabouts(height_m=1.0)))
    tape.begin(1000.0)
    for height in (2.0, 3.0):
        since_s, states, batch = tape.drain(1000.0 + height)
        ring.write(batch, Beginning(since_s, 10**18, b"{}", states))
        ring.close()
        tape.put_state(PLACE, 1000.0 + height, encode(Whereabouts(height_m=height)))
    first, second = tmp_path / "000001.mcap", tmp_path / "000002.mcap"
    heights = [[decode(PLACE, data).height_m for _, _, data in on_topic(path, PLACE)] for path in (first, second)]
    assert heights == [[1.0], [1.0, 2.0]]
    (_, _), (follows,) = ([decode(START, data) for _, _, data in on_topic(path, START)] for path in (first, second))
    assert follows.continues
