"""The dashboard of docs/fleet: the SQL of every panel and variable, as Grafana would send it, at a real PostgreSQL."""

from __future__ import annotations

import datetime
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psycopg
import pytest

from companion.fleet.store import Store
from companion.mqtt.client import Incoming
from sim.fleet import demo
from tests.support.postgres import INITDB, postgres

pytestmark = pytest.mark.real_clock

DASHBOARD = json.loads((Path(__file__).parents[2] / "docs/fleet/grafana.json").read_text(encoding="utf-8"))
PANELS: list[dict[str, Any]] = DASHBOARD["panels"]
VARIABLES: list[dict[str, Any]] = DASHBOARD["templating"]["list"]
NOW = datetime.datetime.now(tz=datetime.UTC)


@pytest.fixture(scope="module")
def database() -> Iterator[str]:
    if INITDB is None:
        pytest.skip("no PostgreSQL")
    fleet = demo.fleet_of(demo.AIRCRAFT, NOW)
    with postgres() as server:
        where = server.create("fleet")
        store = Store(where)
        store.prepare()
        for each in fleet:
            store.take([Incoming(f"fleet/{each.id}/item", payload) for payload in each.told.values()])
            store.take([Incoming(f"fleet/{each.id}/hello", each.hello)])
        while store.judge():
            pass
        store.close()
        with psycopg.connect(where, autocommit=True) as connection:  # as docs/fleet.md says
            connection.execute("CREATE ROLE grafana LOGIN PASSWORD '...'")
            connection.execute("GRANT pg_read_all_data TO grafana")
        yield where.replace("fleet@", "grafana@")


def as_sent(sql: str, aircraft: str) -> str:
    """Macros and variables replaced as Grafana's PostgreSQL data source does, for its last 90 days."""
    since, until = (f"{at:%Y-%m-%dT%H:%M:%SZ}" for at in (NOW - datetime.timedelta(days=90), NOW))
    sql = sql.replace("${aircraft:sqlstring}", "'" + aircraft.replace("'", "''") + "'")
    sql = re.sub(r"\$__timeFilter\((\w+)\)", rf"\1 BETWEEN '{since}' AND '{until}'", sql)
    sql = re.sub(r"\$__timeGroupAlias\((\w+), *'1d'\)", r'floor(extract(epoch from \1)/86400)*86400 AS "time"', sql)
    assert "$" not in sql
    return sql


def answer(database: str, sql: str, aircraft: str = "nobody") -> tuple[list[psycopg.Column], list[tuple[Any, ...]]]:
    with psycopg.connect(database) as connection:
        found = connection.execute(as_sent(sql, aircraft).encode())
        return found.description or [], found.fetchall()


@pytest.fixture(scope="module")
def somebody(database: str) -> str:
    """Value of the variable for the first aircraft."""
    (variable,) = (each for each in VARIABLES if each["type"] == "query")
    columns, rows = answer(database, variable["query"])
    assert [column.name for column in columns] == ["__text", "__value"]
    assert len(rows) == demo.AIRCRAFT
    return str(next(value for text, value in rows if text == "Heron 1"))


@pytest.mark.parametrize("panel", PANELS, ids=lambda panel: panel["title"])
def test_every_panel_has_an_answer(database: str, somebody: str, panel: dict[str, Any]) -> None:
    (target,) = panel["targets"]
    columns, rows = answer(database, target["rawSql"], somebody)
    assert rows
    names = [column.name for column in columns]
    if target["format"] == "time_series":  # the time, a name for each line, and the value
        assert names == ["time", "metric", "value"]
        types = [column.type_display for column in columns]
        assert types[0] in ("timestamptz", "numeric")
        assert types[1].startswith(("text", "varchar"))
        assert types[2] in ("float8", "int8")
        assert [row[0] for row in rows] == sorted(row[0] for row in rows)
    else:
        assert len({*names}) == len(names) > 1
