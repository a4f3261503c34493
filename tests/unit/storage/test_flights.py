"""The flights on disk."""

from __future__ import annotations

import stat
from pathlib import Path

import msgspec
import pytest

from companion.errors import StorageError
from companion.storage.records import FlightStore
from tests.support.flights import kept_flight


def test_a_flight_comes_back_as_it_was_and_the_service_may_read_it(tmp_path: Path) -> None:
    store, kept = FlightStore(tmp_path), kept_flight()
    assert store.newest() == {}
    assert store.save(kept) == 1
    assert store.file(1).read() == kept
    assert stat.S_IMODE((tmp_path / "flights/000001.json").stat().st_mode) == 0o644


def test_the_same_flight_read_again_stays_one_with_the_later_reading(tmp_path: Path) -> None:
    store = FlightStore(tmp_path)
    assert [store.save(kept_flight(key)) for key in ("a", "b")] == [1, 2]
    again = msgspec.structs.replace(kept_flight("a"), log="again.bin")
    assert store.save(again) == 1
    assert list(store.newest()) == [2, 1]
    assert store.newest()[1].log == "again.bin"


def test_a_damaged_one_is_passed_over_with_a_line(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store = FlightStore(tmp_path)
    for k in range(3):
        store.save(kept_flight(str(k)))
    path = tmp_path / "flights/000002.json"
    data = path.read_bytes()
    path.write_bytes(data.replace(b"400.0", b"401.0"))
    assert list(store.newest()) == [3, 1]
    (words,) = caplog.messages
    assert words.startswith(f"{path}: cannot be used: its checksum does not fit")
    assert words.endswith(", skipped")
    for content in (b"", b"{}", data[: len(data) // 2], b"[" * 100_000):
        path.write_bytes(content)
        with pytest.raises(StorageError, match="cannot be used: "):
            store.file(2).read()
    assert store.file(7).read() is None
