"""A database of each earlier version, brought up to date: as if the present one had taken the same items."""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from companion.fleet import schema
from companion.fleet.database import engine_of
from companion.fleet.store import Message, Store
from companion.physics.units import DEG_H
from sim.fleet.aircraft import Aircraft
from tests.support.collecting import NOW, rows_of
from tests.support.postgres import INITDB, Postgres, postgres

OLDER = sorted(Path(__file__).parents[1].joinpath("support").glob("fleet_version_*.sql"))
_SQLITES = {"TIMESTAMP WITH TIME ZONE": "DATETIME", "DOUBLE PRECISION": "DOUBLE", "BYTEA": "BLOB"}
DERIVED = (schema.calibrations, schema.biases, schema.undos, schema.armings)


@pytest.fixture(scope="module")
def server() -> Iterator[Postgres]:
    if INITDB is None:
        pytest.skip("no PostgreSQL")
    with postgres() as one:
        yield one


@pytest.fixture(params=["sqlite", "postgresql"])
def databases(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, str]:
    """Two empty ones."""
    if request.param == "sqlite":
        return str(tmp_path / "older.sqlite"), str(tmp_path / "new.sqlite")
    server: Postgres = request.getfixturevalue("server")
    return server.create(f"older-{tmp_path.name}"), server.create(f"new-{tmp_path.name}")


def messages_of(one: Aircraft) -> list[Message]:
    return [Message(f"fleet/{one.id}/item", payload) for payload in one.told.values()]


def content(database: str) -> list[list[Any]]:
    """Of all that is made from items, and what tells that two of them are one."""
    items = schema.items.c
    derived = [sorted(map(tuple, rows_of(database, sa.select(table))), key=str) for table in DERIVED]
    return [*derived, sorted(map(tuple, rows_of(database, sa.select(items.sequence, items.state, items.same))))]


def judged(database: str) -> list[Any]:
    """The rows of all parts, and what was found against one of them."""
    p = schema.parts.c
    rows = rows_of(database, sa.select(schema.parts).order_by(p.imu, p.triad, p.axis))
    assert len(rows) == 2 * 6
    assert all(row.turn_on is not None for row in rows)
    (found,) = rows_of(database, sa.select(schema.findings))
    assert found.words.startswith("replace IMU fc2: gyro x bias has moved by ")
    return [*map(tuple, rows), tuple(found)]


def tables_of(database: str) -> dict[str, dict[str, tuple[str, bool]]]:
    """Columns with their types, of each table."""
    engine = engine_of(database)
    found = sa.inspect(engine)
    tables = {
        name: {one["name"]: (str(one["type"]), one["nullable"]) for one in found.get_columns(name)}
        for name in found.get_table_names()
    }
    indexes = {name: {str(one["name"]): ("", True) for one in found.get_indexes(name)} for name in tables}
    engine.dispose()
    return {name: columns | indexes[name] for name, columns in tables.items()}


def fill_as_older(older: Path, database: str, source: str) -> None:
    """With what the other database has, as far as that version had columns for it."""
    engine = engine_of(database)
    with engine.begin() as connection:
        text = older.read_text()
        if connection.dialect.name == "sqlite":
            for word, its in _SQLITES.items():
                text = text.replace(word, its)
        for statement in filter(str.strip, text.split(";")):
            connection.exec_driver_sql(statement)
        there = sa.MetaData()
        there.reflect(connection)
        for name, table in there.tables.items():
            if name not in schema.tables.tables or name == "schema_version":
                continue
            rows = [
                {key: value for key, value in row._mapping.items() if key in table.columns}
                for row in rows_of(source, sa.select(schema.tables.tables[name]))
            ]
            for row in rows:
                row |= {"same": f"older {row['sequence']}"} if row.get("kind") == "calibration" else {}
            if rows:
                connection.execute(sa.insert(schema.tables.tables[name]), rows)
        version = int(older.stem.rpartition("_")[2])
        connection.execute(sa.insert(schema.tables.tables["schema_version"]).values(version=version))
    engine.dispose()


@pytest.mark.parametrize("older", OLDER, ids=lambda path: path.stem)
def test_an_earlier_version_becomes_the_present_one(databases: tuple[str, str], older: Path) -> None:
    database, new = databases
    one = Aircraft(1)
    one.live(NOW - datetime.timedelta(days=40), 12, 20.0)
    for days_ago in range(40, 0, -1):
        one.moved_rad_s = 80.0 * DEG_H * (days_ago <= 15)
        one.calibrate(NOW - datetime.timedelta(days=days_ago))
    fresh, store = Store(new), Store(database)
    fresh.prepare()
    fresh.take(messages_of(one))
    fill_as_older(older, database, new)
    store.prepare()
    assert tables_of(database) == tables_of(new)
    assert content(database) == content(new)
    for each in (store, fresh):
        assert each.judge()
        assert not each.judge()
    assert judged(database) == judged(new)
    # Told again under another epoch it is known again.
    before = rows_of(database, sa.text("SELECT COUNT(*) FROM bias_history"))
    one.epoch = "f" * 16
    again = [each._replace(payload=_under(one.epoch, each.payload)) for each in messages_of(one)]
    store.take(again)
    assert rows_of(database, sa.text("SELECT COUNT(*) FROM bias_history")) == before
    store.close()
    fresh.close()


def _under(epoch: str, payload: bytes) -> bytes:
    head, _, rest = payload.partition(b'"epoch":"')
    return head + b'"epoch":"' + epoch.encode() + rest[16:]


def test_every_earlier_version_is_there() -> None:
    assert len(OLDER) == len(schema.STEPS)
