"""The fleet's face on virtual time: what was kept reaches a collector whole, in order and once, whatever happens."""

from __future__ import annotations

import asyncio
import datetime
import json
import os
import random
import sqlite3
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import msgspec
import pytest

from companion.estimation.records.record import ArmingRecord
from companion.mqtt.fleet import AircraftFleet
from companion.storage import fleet_items
from companion.storage.profiles import ProfileStore
from companion.storage.records import Done, RecordStore
from companion.storage.state import BoundedList, sealed, write_atomically
from tests.support.extent import extent
from tests.support.fleet import CRANE, HERON, Aircraft
from tests.support.histories import arming, record
from tests.support.virtual_time import run_virtual
from tests.unit.lab.test_profiles import saved


async def until(what: Callable[[], object], within_s: float = 3600.0) -> None:
    async with asyncio.timeout(within_s):
        while not what():
            await asyncio.sleep(0.5)


async def until_told(face: AircraftFleet, within_s: float = 3600.0) -> None:
    """Until the face has looked, and all is confirmed."""
    await asyncio.sleep(15.0)
    await until(lambda: not face.status()["waiting"], within_s)


def virtually(main: Coroutine[Any, Any, None]) -> None:
    run_virtual(main)


def begun(collector_items: list[Any]) -> list[str]:
    return [item["body"]["started_at"] for item in collector_items if item["kind"] == "calibration"]


def starts(*numbers: int) -> list[str]:
    return [record(number).started_at for number in numbers]


def keep(folder: Path, *numbers: int) -> None:
    for number in numbers:
        RecordStore(folder).save(record(number))


# --- nothing is lost


def test_a_collector_that_is_away_is_written_to_ever_more_rarely_and_then_gets_all_in_order(
    tmp_path: Path,
) -> None:
    keep(tmp_path, *range(40))

    async def main() -> None:
        aircraft = Aircraft(tmp_path)
        collector = aircraft.collector
        collector.confirms = lambda item: False
        async with aircraft.running() as face:
            aircraft.connection.connect()
            await asyncio.sleep(10_000.0)
            assert len(collector.deliveries) < 8 * (10_000 / 600 + 5)
            collector.confirms = lambda item: True
            await until_told(face)
            await asyncio.sleep(700.0)
        assert begun(collector.of(HERON)) == starts(*range(40))

    virtually(main())


@pytest.mark.parametrize("seed", range(extent(whole=50, a_slice=2)))
def test_lost_doubled_reordered_and_cut_off(tmp_path: Path, seed: int) -> None:
    """A bad radio, a collector that confirms what it likes, a daemon that is switched off at any time."""
    dice = random.Random(seed)
    keep(tmp_path, *range(30))

    async def main() -> None:
        aircraft = Aircraft(tmp_path)
        connection, collector = aircraft.connection, aircraft.collector
        connection.loses = lambda: dice.random() < 0.3
        collector.confirms = lambda item: dice.random() < 0.7
        number = 30
        for _ in range(8):
            async with aircraft.running():
                for _ in range(dice.randrange(1, 6)):
                    (connection.disconnect if connection.connected else connection.connect)()
                    await asyncio.sleep(dice.expovariate(1 / 20.0))
                    keep(tmp_path, number)
                    number += 1
                    if collector.database and dice.random() < 0.5:
                        collector.confirm(*dice.choices(sorted(collector.database), k=5))
        connection.loses, collector.confirms = lambda: False, lambda item: True
        async with aircraft.running() as face:
            if not connection.connected:
                connection.connect()
            await until_told(face)
        assert begun(collector.of(HERON)) == starts(*range(number))
        assert [item["sequence"] for item in collector.of(HERON)] == list(range(1, number + 1))

    virtually(main())


def test_nonsense_foreign_epochs_and_retained_words_change_nothing(tmp_path: Path) -> None:
    keep(tmp_path, *range(5))

    async def main() -> None:
        aircraft = Aircraft(tmp_path)
        connection, collector = aircraft.connection, aircraft.collector
        collector.confirms = lambda item: False
        async with aircraft.running() as face:
            connection.connect()
            await asyncio.sleep(15.0)
            epoch = collector.hellos[-1]["epoch"]
            good = {"format_version": 1, "epoch": epoch, "sequences": [[1, 5]]}
            nonsense = [
                b"", b"\xff", b"[]", b"null", b"{}", b"[" * 5000, b'{"epoch": 1}',
                *(
                    json.dumps({**good, **wrong}).encode()
                    for wrong in (
                        {"format_version": 2}, {"epoch": "0" * 16}, {"sequences": [[5, 1]]}, {"sequences": [[0, 5]]},
                        {"sequences": [[1]]}, {"sequences": [[1, 2**70]]}, {"sequences": [[1, 5]] * 257},
                        {"sequences": "all"}, {"sequences": [["1", "5"]]},
                    )
                ),
            ]  # fmt: skip
            for payload in nonsense:
                connection.deliver(f"fleet/{HERON}/confirmed", payload)
                connection.deliver(f"fleet/{CRANE}/confirmed", json.dumps(good).encode())
                await asyncio.sleep(1.0)
                assert face.status()["waiting"] == 5, payload
                connection.deliver(f"fleet/{HERON}/wanted", payload)
                await asyncio.sleep(1.0)
            connection.deliver(f"fleet/{HERON}/confirmed", json.dumps(good).encode(), retained=True)
            await asyncio.sleep(20.0)
            assert face.status()["waiting"] == 5
            connection.deliver(f"fleet/{HERON}/confirmed", json.dumps(good).encode())
            await asyncio.sleep(5.0)
            assert face.status()["waiting"] == 0

    virtually(main())


# --- whose, and when


def test_a_board_moved_to_another_airframe(tmp_path: Path) -> None:
    keep(tmp_path, 0, 1)

    async def main() -> None:
        aircraft = Aircraft(tmp_path)
        collector = aircraft.collector
        async with aircraft.running():
            await asyncio.sleep(15.0)
            keep(tmp_path, 2)
        keep(tmp_path, 3)  # written, and switched off before the fleet had looked
        aircraft.vehicle.uid = CRANE
        async with aircraft.running() as face:
            await asyncio.sleep(15.0)
            keep(tmp_path, 4)
            aircraft.connection.connect()
            await until_told(face)
            assert {each["aircraft"]: each["last"] for each in collector.hellos} == {HERON: 4, CRANE: 2}
            aircraft.vehicle.uid = aircraft.vehicle.version = None  # another one, and nobody knows yet which
            keep(tmp_path, 5)
            await asyncio.sleep(15.0)
            assert len(collector.database) == 6
            aircraft.vehicle.uid = HERON
            await until_told(face)
        assert begun(collector.of(HERON)) == starts(0, 1, 2, 3, 5)
        assert begun(collector.of(CRANE)) == starts(4)
        (event,) = [item for item in collector.of(CRANE) if item["kind"] == "event"]
        assert event["body"] == {"what": "airframe changed", "before": HERON}
        (event,) = [item for item in collector.of(HERON) if item["kind"] == "event"]
        assert event["body"] == {"what": "airframe changed", "before": CRANE}
        assert len({item["epoch"] for item in collector.database.values()}) == 2

    virtually(main())


def test_without_a_unique_id_nothing_is_kept_and_that_is_said(tmp_path: Path) -> None:
    keep(tmp_path, 0)

    async def main() -> None:
        aircraft = Aircraft(tmp_path, uid=None)
        async with aircraft.running() as face:
            aircraft.connection.connect()
            await asyncio.sleep(60.0)
            assert face.status()["good"] is False
            assert "has no unique id" in face.status()["summary"]
            aircraft.vehicle.uid = HERON
            await until_told(face)
            assert face.status()["good"] is True
        assert begun(aircraft.collector.of(HERON)) == starts(0)

    virtually(main())


@pytest.mark.parametrize(("off_s", "clock"), [(0.0, "good"), (365 * 86400.0, "unknown"), (None, "unknown")])
def test_a_clock_is_good_where_gnss_agrees_and_never_for_what_was_before(
    tmp_path: Path, off_s: float | None, clock: str
) -> None:
    """Wrong by a year or not, the order is that of the sequences."""
    keep(tmp_path, 5, 3, 4)

    async def main() -> None:
        now = datetime.datetime.now(tz=datetime.UTC)
        aircraft = Aircraft(tmp_path)
        aircraft.vehicle.unix_time_s = None if off_s is None else now.timestamp() + off_s
        async with aircraft.running() as face:
            await asyncio.sleep(1.0)
            at = datetime.datetime.now(tz=datetime.UTC).isoformat(timespec="milliseconds")
            RecordStore(tmp_path).save(record(0, started_at=at))
            aircraft.connection.connect()
            await until_told(face)
        told = aircraft.collector.of(HERON)
        assert begun(told) == [*starts(5, 3, 4), at]
        assert [item["clock"] for item in told] == ["unknown"] * 3 + [clock]

    virtually(main())


# --- what is told


def test_everything_that_the_disk_has_and_each_change_once(tmp_path: Path) -> None:
    async def main() -> None:
        aircraft = Aircraft(tmp_path, location="full")
        collector = aircraft.collector
        store, armed = RecordStore(tmp_path), BoundedList(tmp_path / "armings.json", ArmingRecord, 200)
        by_hand = BoundedList(tmp_path / "by-hand.json", Done, 50)
        async with aircraft.running() as face:
            aircraft.connection.connect()
            first, second = record(0), record(1)
            path = store.file(store.save(first)).path
            armed.append(arming(first))
            await until_told(face)
            assert collector.kinds() == ["calibration", "arming"]
            assert collector.of(HERON)[1]["body"] == msgspec.to_builtins(arming(first))
            # An undo changes the record; a second one is another item.
            undone = msgspec.structs.replace(first, undone_at="2026-05-01T07:00:00.000+00:00")
            write_atomically(path, sealed(msgspec.json.encode(undone)))
            store.save(second)
            armed.append(arming(second, good=False))
            level = Done(
                what="level", state="done", measured_at="2026-05-02T07:00:00.000+00:00", reason="0.1 deg", system_id=1,
                written={"AHRS_TRIM_X": 0.01},
            )  # fmt: skip
            predicted = msgspec.structs.replace(level, what="gyro prediction", state="predicted")
            by_hand.write([predicted, level])
            ProfileStore(tmp_path).write(saved("mine"))
            await until_told(face)
            os.utime(path, (1.0, 1.0))  # copied back, say: another time, the same content
            await until_told(face)
            assert collector.kinds()[2:] == ["undo", "calibration", "alignment", "arming", "profile"]
            undo, _, alignment, _, profile = (item["body"] for item in collector.of(HERON)[2:])
            assert undo == {"what": "calibration", "of": first.started_at, "undone_at": undone.undone_at}
            assert alignment == {**msgspec.to_builtins(level), "record": None}
            assert profile["name"] == "mine"
            by_hand.write([msgspec.structs.replace(level, undone_at="2026-05-02T08:00:00.000+00:00")])
            ProfileStore(tmp_path).write(msgspec.structs.replace(saved("mine"), saved_at="2026-05-03T00:00:00+00:00"))
            await until_told(face)
            assert collector.kinds()[7:] == ["undo", "profile"]
            assert collector.of(HERON)[7]["body"]["what"] == "level"
        async with aircraft.running() as face:
            await until_told(face)
        assert len(collector.database) == 9

    virtually(main())


# --- the disk


def test_a_full_disk_is_said_and_nothing_is_missing_afterwards(tmp_path: Path) -> None:
    keep(tmp_path, 0)

    async def main() -> None:
        aircraft = Aircraft(tmp_path)
        async with aircraft.running() as face:
            aircraft.connection.connect()
            await until_told(face)
            connection = face._items._connection
            assert isinstance(connection, sqlite3.Connection)
            pages = connection.execute("PRAGMA page_count").fetchone()[0]
            connection.execute(f"PRAGMA max_page_count = {pages}")  # SQLite takes it for a full disk
            opened = face._items._opened

            def full() -> sqlite3.Connection:
                db = opened()
                db.execute(f"PRAGMA max_page_count = {pages}")
                return db

            face._items._opened = full  # type: ignore[method-assign]
            keep(tmp_path, *range(1, 9))
            await asyncio.sleep(30.0)
            assert face.status()["good"] is False
            assert "database or disk is full" in face.status()["summary"]
            aircraft.collector.say(HERON, "wanted", aircraft.collector.hellos[-1]["epoch"], [[1, 1]])
            await asyncio.sleep(5.0)
            assert len(aircraft.collector.deliveries) >= 2, "what is there is sent all the same"
            face._items._opened = opened  # type: ignore[method-assign]
            face._items.close()
            await until_told(face)
            assert face.status()["good"] is True
        assert begun(aircraft.collector.of(HERON)) == starts(*range(9))

    virtually(main())


@pytest.mark.parametrize("damage", [b"nonsense", b"SQLite format 3\0" + b"\xff" * 4096])
def test_a_damaged_file_is_set_aside_and_all_is_told_anew(tmp_path: Path, damage: bytes) -> None:
    keep(tmp_path, 0, 1)

    async def main() -> None:
        aircraft = Aircraft(tmp_path)
        collector = aircraft.collector
        async with aircraft.running() as face:
            aircraft.connection.connect()
            await until_told(face)
        (tmp_path / fleet_items.FILE).write_bytes(damage)
        async with aircraft.running() as face:
            await until(lambda: len(collector.database) == 4)
            await until_told(face)
        assert (tmp_path / "fleet.sqlite.unusable").read_bytes() == damage
        one, two = {item["epoch"] for item in collector.database.values()}
        bodies = [[item["body"] for key, item in sorted(collector.database.items()) if key[1] == e] for e in (one, two)]
        assert bodies[0] == bodies[1]

    virtually(main())
