"""Accepted, refused and requested items of the collector, against the contract's schemas and the payloads."""

from __future__ import annotations

import contextlib
import datetime
import json
import sqlite3
from typing import Any

import hypothesis
import hypothesis.strategies as st
import pytest
import sqlalchemy as sa

from companion.errors import CompanionError, LinkError, StorageError
from companion.fleet import contract, schema
from companion.fleet.contract import answers, ranges
from companion.fleet.schema import url_of
from companion.fleet.store import BatchResult, Store
from companion.mqtt.client import Incoming
from companion.mqtt.fleet import MOST_RANGES
from sim.fleet.aircraft import Aircraft
from tests.support.collecting import NOW, items_in, rows_of, told_by
from tests.support.fleet import check


def aircraft(flights: int = 5, number: int = 1) -> Aircraft:
    one = Aircraft(number)
    one.live(NOW, flights)
    return one


def items_of(one: Aircraft) -> list[Incoming]:
    return [Incoming(f"fleet/{one.id}/item", payload) for payload in one.told.values()]


def changed(message: Incoming, **news: Any) -> Incoming:
    return message._replace(payload=json.dumps(json.loads(message.payload) | news).encode())


def hello_of(one: Aircraft) -> Incoming:
    return Incoming(f"fleet/{one.id}/hello", one.hello)


def query(database: str, text: str) -> list[tuple[Any, ...]]:
    return [tuple(row) for row in rows_of(database, sa.text(text))]


# --- the contract


def test_the_simulated_aircraft_says_what_the_contract_says() -> None:
    one = aircraft(150)
    one.fly(NOW)
    one.learn(NOW)
    kinds = {check("item", payload)["kind"] for payload in one.told.values()}
    assert kinds == {"calibration", "arming", "undo", "flight", "curve"}
    check("hello", one.hello)


@hypothesis.given(st.sets(st.integers(1, 3000), max_size=1200))
def test_answers_name_each_number_once_and_nothing_else(numbers: set[int]) -> None:
    found: list[int] = []
    for payload in answers("0123456789abcdef", ranges(numbers)):
        said = check("confirmed", payload)["sequences"]
        assert len(said) <= MOST_RANGES
        found += [number for first, last in said for number in range(first, last + 1)]
    assert sorted(found) == sorted(numbers)


@hypothesis.given(st.data())
def test_no_bytes_raise(data: st.DataObject) -> None:
    one = aircraft(1)
    payload = data.draw(st.sampled_from([*one.told.values(), one.hello]))
    if data.draw(st.booleans()):
        at = data.draw(st.integers(0, len(payload) - 1))
        payload = payload[:at] + data.draw(st.binary(max_size=4)) + payload[at + data.draw(st.integers(0, 3)) :]
    else:
        payload = data.draw(st.binary(max_size=60))
    with contextlib.suppress(contract.InvalidPayloadError):
        contract.read_hello(one.id, payload)
    with contextlib.suppress(contract.InvalidPayloadError):
        contract.rows_of(contract.read_item(one.id, payload))


# --- what is taken


def test_duplicates_and_disorder_change_nothing(store: Store, database: str) -> None:
    one = aircraft(12)
    messages = items_of(one)
    whole = store.take(messages[::-1])
    assert whole.confirmed == {(one.id, one.epoch): [*one.told][::-1]}
    derived = (schema.calibrations, schema.biases, schema.armings)
    before = [rows_of(database, sa.select(table)) for table in derived]
    assert all(before)
    for start in range(0, len(messages), 5):
        some = messages[start : start + 5]
        again = store.take([*some, *some])
        assert sum(map(len, again.confirmed.values())) == 2 * len(some)
    assert items_in(database) == told_by([one])
    assert [rows_of(database, sa.select(table)) for table in derived] == before


def test_each_of_many_is_asked_for_what_it_lacks(store: Store) -> None:
    """In one batch: some are whole, some have gaps anywhere, of one nothing is there, one forgot its first."""
    fleet = [aircraft(12, number) for number in range(5)]
    lacks: list[set[int]] = [set(), {1, 2, 7}, {3, 4, 5, 9, len(fleet[2].told)}, {*fleet[3].told}, {11}]
    store.take([message for one, lack in zip(fleet, lacks, strict=True) for message in items_of(one)
                if json.loads(message.payload)["sequence"] not in lack])  # fmt: skip
    hellos = [hello_of(one) for one in fleet]
    hellos[4] = changed(hellos[4], first=10)
    wanted = store.take(hellos).wanted
    assert wanted == {(one.id, one.epoch): ranges(lack) for one, lack in zip(fleet, lacks, strict=True) if lack}


def test_a_clock_that_is_wrong_by_a_year_changes_no_order(store: Store, database: str) -> None:
    """The last by number is in force, though its clock has gone back by a year, and another one was a year ahead."""
    one = Aircraft(1)
    for days in (0, 365, 1, -365):
        last = one.calibrate(NOW + datetime.timedelta(days=days))
    store.take([*items_of(one), hello_of(one)])
    assert query(database, "SELECT force_sequence FROM latest") == [(last,)]
    one.undo(NOW)
    store.take(items_of(one))
    assert query(database, "SELECT force_sequence FROM latest") == [(3,)]


def test_told_again_under_a_new_epoch_is_one_thing(store: Store, database: str) -> None:
    """A damaged memory card: what the disk still had is told anew; both tellings are kept, and shown once."""
    one = aircraft(6)
    store.take([*items_of(one), hello_of(one)])
    shown = query(database, "SELECT started_at, imu, axis, gyro_bias_deg_h FROM bias_history ORDER BY 1, 2, 3")
    fleet = query(database, "SELECT * FROM fleet")
    assert len(shown) == 6 * len(one.biases)
    one.epoch = "f" * 16
    again = [changed(message, epoch=one.epoch) for message in items_of(one)]
    store.take([*again, hello_of(one)])
    assert len(items_in(database)) == 2 * len(one.told)
    assert query(database, "SELECT started_at, imu, axis, gyro_bias_deg_h FROM bias_history ORDER BY 1, 2, 3") == shown
    assert [row[3:] for row in query(database, "SELECT * FROM fleet")] == [row[3:] for row in fleet]


def test_what_is_unknown_is_kept_and_taken_in_after_an_update(
    store: Store, database: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = aircraft(3)
    calibration = items_of(one)[0]
    messages = [
        changed(calibration, sequence=101, kind="battery", body={"minutes": 7}),
        changed(calibration, sequence=102, format_version=2, body=[1, 2]),
    ]
    with monkeypatch.context() as older:
        older.setattr(contract, "KINDS", {})
        older.setattr("companion.fleet.store.KINDS", {})
        outcome = store.take([calibration, *messages])
    assert outcome.rejected == []
    assert outcome.confirmed == {(one.id, one.epoch): [1, 101, 102]}
    states = "SELECT sequence, state FROM items ORDER BY sequence"
    assert query(database, states) == [(1, "unknown"), (101, "unknown"), (102, "unknown")]
    assert query(database, "SELECT * FROM biases") == []
    store.prepare()
    assert query(database, states) == [(1, "taken"), (101, "unknown"), (102, "unknown")]
    assert len(query(database, "SELECT * FROM biases")) == 6


@pytest.mark.parametrize("what", ["no text", "no number", "no JSON"])
def test_what_can_never_be_taken_in_keeps_no_collector_from_its_start(
    store: Store, database: str, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """It was of an unknown kind when it came; one that a database refuses takes no other with it."""
    one = aircraft(3)
    first, *good = items_of(one)
    bad = changed(first, body={"reason": "?"})
    if what == "no text":  # three times as long as it came, once it is a text
        bad = bad._replace(payload=bad.payload.replace(b"?", b"\xff" * 100_000))
    with monkeypatch.context() as older:
        for module in ("contract", "store"):
            older.setattr(f"companion.fleet.{module}.KINDS", {})
        assert store.take([bad, *good]).rejected == []
    with sqlite3.connect(database) as connection:
        if what != "no text":
            payload = "{" if what == "no JSON" else first.payload.decode()
            connection.execute("UPDATE items SET payload = ? WHERE sequence = 1", [payload])
        if what == "no number":
            connection.execute(
                "CREATE TRIGGER refuses BEFORE INSERT ON biases WHEN NEW.sequence = 1"
                " BEGIN SELECT RAISE(ABORT, 'no such number'); END"
            )
    connection.close()
    store.prepare()
    states = dict(query(database, "SELECT sequence, state FROM items"))
    assert states.pop(1) == "rejected"
    assert {*states.values()} == {"taken"}
    assert query(database, "SELECT * FROM calibrations WHERE sequence = 1") == []
    ((times, topic, reason),) = query(database, "SELECT times, topic, reason FROM rejected")
    assert (times, topic) == (1, first.topic)
    assert reason


# --- what is refused

BAD: dict[str, dict[str, Any]] = {
    "of another aircraft": {"aircraft": "f" * 36},
    "no sequence": {"sequence": 0},
    "beyond all numbers": {"sequence": 2**60},
    "no body": {"body": None},
    "no time": {"at": "yesterday"},
    "a time beyond all years": {"at": "9999-12-31T23:59:59-12:00"},
    "a time before all clocks": {"at": "0001-01-01T00:00:00Z"},
    "a time after all clocks": {"at": "9999-12-31T23:59:59Z"},
    "a bias of infinity": {"body": {"bias": 1e13}},
    "a format that is none": {"format_version": "1"},
    "a time that is empty": {
        "kind": "arming",
        "body": {"armed_at": "2026-11-20", "state": "", "reason": "", "calibration": ""},
    },
}


@pytest.mark.parametrize("what", BAD)
def test_a_bad_item_is_kept_aside_with_its_reason_and_stops_nothing(store: Store, database: str, what: str) -> None:
    one = aircraft(2)
    good = items_of(one)
    news = BAD[what]
    if what == "a bias of infinity":
        body = json.loads(good[0].payload)["body"]
        body["imus"][0]["gyro_bias_rad_s"] = [0.0, 1e13, 0.0]
        news = {"body": body}
    bad = changed(good[0], **news)
    for _ in range(3):
        outcome = store.take([good[1], bad, good[2]])
        assert [message for message, _ in outcome.rejected] == [bad]
    (times, reason, payload), *rest = query(database, "SELECT times, reason, payload FROM rejected")
    assert (times, rest, payload) == (3, [], bad.payload)
    assert reason == outcome.rejected[0][1]
    assert {2, 3} <= {row[2] for row in items_in(database)}
    # Of one whose number can be read no more is to be heard; it takes no other's place.
    readable = what in ("no body", "a bias of infinity") or " time" in what
    assert outcome.confirmed == {(one.id, one.epoch): [2, 1, 3] if readable else [2, 3]}
    assert query(database, "SELECT * FROM biases WHERE sequence = 1") == []


@pytest.mark.parametrize("which", ["instance", "gyro_id", "drift_m"])
def test_a_number_that_no_database_holds_stops_nothing(store: Store, which: str) -> None:
    """2^63 is no integer of theirs; views turn others into units in which they are no numbers any more."""
    one = aircraft(1)
    one.fly(NOW)
    *good, flight = items_of(one)
    body = json.loads(flight.payload)["body"]
    imu, *_ = body["flight"]["imus"]
    imu |= {"imu": 2**63} if which == "instance" else {"gyro_id": 2**63} if which == "gyro_id" else {}
    imu["drift"]["flown"][0]["median_m"] = 1e305 if which == "drift_m" else 2.5
    bad = changed(good[0], sequence=100, kind="flight", body=body)
    ((message, reason),) = store.take([*good, bad]).rejected
    assert message == bad
    assert reason.startswith(f"{which}: found ")


# --- the database


def test_a_full_disk_confirms_nothing_and_loses_nothing(store: Store, database: str) -> None:
    one = aircraft(40)
    store.take(items_of(one)[:5])
    with sqlite3.connect(database) as connection:
        pages = connection.execute("PRAGMA page_count").fetchone()[0]
    limit = lambda connection, _: connection.execute(f"PRAGMA max_page_count = {pages + 3}")  # noqa: E731
    sa.event.listen(store._engine, "connect", limit)
    store.close()
    with pytest.raises(LinkError, match="full"):
        store.take(items_of(one))
    assert items_in(database) == told_by([one])[:5]
    sa.event.remove(store._engine, "connect", limit)
    store.close()
    assert sum(map(len, store.take(items_of(one)).confirmed.values())) == len(one.told)
    assert items_in(database) == told_by([one])


def test_what_the_database_refuses_takes_nothing_else_with_it(
    store: Store, database: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = aircraft(4)
    messages = items_of(one)
    real = Store._take

    def refuses(self: Store, some: list[Incoming], now: datetime.datetime) -> BatchResult:
        if messages[3] in some:
            raise sa.exc.DataError("INSERT", {}, ValueError("no such number"))
        return real(self, some, now)

    monkeypatch.setattr(Store, "_take", refuses)
    outcome = store.take(messages)
    assert [reason for _, reason in outcome.rejected] == ["the database refuses it: no such number"]
    # It is there as it came, with its reason: so its aircraft need not tell it for ever, and is not asked for it.
    assert items_in(database) == told_by([one])
    assert query(database, "SELECT sequence FROM items WHERE state = 'rejected'") == [(4,)]
    assert query(database, "SELECT times, payload FROM rejected") == [(1, messages[3].payload[:4096])]
    assert sorted(outcome.confirmed[one.id, one.epoch]) == list(range(1, len(messages) + 1))
    assert store.take([Incoming(f"fleet/{one.id}/hello", one.hello)]).wanted == {}


@pytest.mark.parametrize(("version", "remedy"), [(3, "name a new database with --database"), (5, "update this one")])
def test_a_database_of_another_version_is_refused_in_one_line_and_left_as_it_is(
    store: Store, database: str, version: int, remedy: str
) -> None:
    one = aircraft(3)
    store.take(items_of(one))
    with sqlite3.connect(database) as connection:
        connection.execute("UPDATE schema_version SET version = ?", [version])
    with pytest.raises(StorageError, match=f"tables of version {version}; allowed: 4; .*{remedy}"):
        store.prepare()
    assert items_in(database) == told_by([one])


@pytest.mark.parametrize("wrong", ["mysql://a:secret@h/x", "postgresql:/x://", "sqlite://", "://"])
def test_an_address_that_is_none_is_one_line_without_the_password(wrong: str) -> None:
    with pytest.raises(CompanionError, match="allowed: postgresql://") as error:
        url_of(wrong)
    assert "secret" not in str(error.value)
