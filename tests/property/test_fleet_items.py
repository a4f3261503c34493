"""The kept items on the disk: whatever a power cut leaves of the last write, nothing is lost, doubled or renumbered."""

from __future__ import annotations

import contextlib
import json
import sqlite3
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from companion.errors import StorageError
from companion.mqtt import fleet as wire
from companion.storage.fleet_items import FILE, FleetItems, Item, Mark, SourceItems
from tests.support.extent import extent
from tests.support.fleet import CRANE, HERON

AT = "2026-05-01T00:00:00.000Z"


def entry(number: int, size: int = 300) -> SourceItems:
    body = json.dumps({"number": number, "more": "x" * size}).encode()
    return SourceItems({f"thing/{number}": Mark("", str(number))}, [Item("arming", AT, "unknown", body)])


def told(items: FleetItems) -> list[tuple[int, int]]:
    """Sequence and number of each."""
    return [(each.sequence, json.loads(each.item.body)["number"]) for each in items.waiting(0, 10_000)]


def marked(items: FleetItems) -> list[int]:
    return sorted(int(mark.value) for mark in items.marks("thing/").values())


@pytest.fixture(scope="module")
def torn() -> tuple[bytes, bytes, int]:
    """The file and its log after some writes, the last of them not yet in the file itself; how many there were."""
    with tempfile.TemporaryDirectory() as name:
        folder, items = Path(name), FleetItems(Path(name))
        items.add(HERON, [entry(1)], AT)
        items.close()  # puts the log into the file
        for number in range(2, 6):
            items.add(HERON, [entry(number)], AT)
        data = (folder / FILE).read_bytes(), (folder / f"{FILE}-wal").read_bytes()
        items.close()
        return *data, 5


def check_left(database: bytes, log: bytes, whole: int) -> int:
    """Count the surviving writes; they must be the first ones, and the store must go on from there."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / FILE).write_bytes(database)
        (folder / f"{FILE}-wal").write_bytes(log)
        items = FleetItems(folder)
        survived = marked(items)
        assert survived == list(range(1, len(survived) + 1))
        assert told(items) == [(number, number) for number in survived], "an item without its mark, or the reverse"
        items.add(HERON, [entry(number) for number in range(len(survived) + 1, whole + 1)], AT)
        assert told(items) == [(number, number) for number in range(1, whole + 1)]
        items.close()
        return len(survived)


def test_a_log_cut_at_any_byte_leaves_whole_writes(torn: tuple[bytes, bytes, int]) -> None:
    database, log, whole = torn
    step = extent(whole=1, a_slice=499)
    survived = [check_left(database, log[:end], whole) for end in [*range(0, len(log), step), len(log)]]
    assert survived == sorted(survived)
    assert {*survived} == {1, 2, 3, 4, 5}


@given(st.data())
def test_a_log_with_rubbish_behind_any_byte_leaves_whole_writes(
    torn: tuple[bytes, bytes, int], data: st.DataObject
) -> None:
    database, log, whole = torn
    end = data.draw(st.integers(0, len(log)))
    check_left(database, log[:end] + data.draw(st.binary(max_size=5000)), whole)


KILLED = """
import sys
from pathlib import Path
from companion.storage.fleet_items import SourceItems, FleetItems, Item, Mark
items = FleetItems(Path(sys.argv[1]))
number = len(items.marks("thing/"))
while True:
    number += 1
    item = Item("arming", "", "unknown", b'{"number": %d, "more": "%s"}' % (number, b"x" * 9000))
    items.add(sys.argv[2], [SourceItems({f"thing/{number}": Mark("", str(number))}, [item])], "")
    items.confirm(sys.argv[2], items.aircraft()[0].epoch, [(1, number // 2)], "")
    print(number, flush=True)
"""


@pytest.mark.real_clock
def test_what_was_said_to_be_kept_is_there_after_a_kill(tmp_path: Path) -> None:
    """By a signal that nobody can catch, in the middle of whatever it does."""
    kept = 0
    for times in range(extent(whole=100, a_slice=4)):
        command = [sys.executable, "-c", KILLED, str(tmp_path), HERON]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            for _ in range(3 + times % 7):
                kept = int(process.stdout.readline())
            process.kill()
            kept = max([kept, *map(int, process.stdout.read().split())])
        items = FleetItems(tmp_path)
        found = marked(items)
        assert found == list(range(1, len(found) + 1))
        assert len(found) in (kept, kept + 1)
        (heron,) = items.aircraft()
        assert heron.last == len(found)
        assert [each.sequence for each in items.waiting(0, 10_000)][-1] == len(found)
        items.close()


def test_it_stays_small_and_says_what_was_lost(tmp_path: Path) -> None:
    items = FleetItems(tmp_path, most_bytes=100_000)
    items.add(CRANE, [entry(0, 1000)], AT)
    for number in range(1, 41):
        items.add(HERON, [entry(number, 1000)], AT)
    heron = items.aircraft()[1]
    items.confirm(HERON, heron.epoch, [(5, 20)], AT)
    for number in range(41, 400):
        items.add(HERON, [entry(number, 1000)], AT)
    crane, heron = items.aircraft()
    left, lost = [], []
    for each in items.waiting(0, 10_000):
        body = json.loads(each.item.body)
        if body.get("what") == "lost":
            lost += [(each.aircraft, number) for a, b in body["sequences"] for number in range(a, b + 1)]
        elif each.aircraft == HERON:
            left.append(each.sequence)
    items.close()
    assert (crane.first, crane.last) == (2, 2), "only the word that its item was lost"
    assert (CRANE, 1) in lost
    gone = {number for of, number in lost if of == HERON}
    assert gone & set(range(5, 21)) == set(), "those were confirmed"
    assert {*range(1, 5)} <= gone
    assert gone & {*left} == set()
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) < 100_000 + 450_000
    assert heron.last > 399


def test_a_newer_one_is_left_alone(tmp_path: Path) -> None:
    items = FleetItems(tmp_path)
    items.add(HERON, [entry(1)], AT)
    items.close()
    with contextlib.closing(sqlite3.connect(tmp_path / FILE)) as db:
        db.execute("PRAGMA user_version = 2")
    with pytest.raises(StorageError, match="found format 2; allowed: up to 1"):
        items.aircraft()
    with contextlib.closing(sqlite3.connect(tmp_path / FILE)) as db:
        assert db.execute("SELECT count(*) FROM item").fetchone() == (1,)


@given(st.one_of(st.binary(max_size=200), st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=20)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.dictionaries(st.sampled_from(["format_version", "epoch", "sequences", "x"]), inner, max_size=4),
    ),
).map(lambda value: json.dumps(value).encode())))  # fmt: skip
@example(b'{"format_version": 1, "epoch": "0", "sequences": [[1, 1]]}')
def test_any_bytes_from_the_wire_are_heeded_or_not_and_never_raise(payload: bytes) -> None:
    said = wire.parse(payload)
    if said is not None:
        assert all(1 <= first <= last <= 2**53 for first, last in said[1])
