"""Response time and size of the fleet's pages and judgements with five years of a thousand aircraft.

Real requests, one after another, to the server of a `companion fleet run`.
"""

from __future__ import annotations

import asyncio
import datetime
import http.client
import random
import time
from collections.abc import Callable, Sequence
from typing import Any, Final

import sqlalchemy as sa

from companion.fleet import schema
from companion.fleet.schema import engine_of
from companion.fleet.store import Store
from companion.mqtt.client import Incoming
from sim.fleet.aircraft import Aircraft
from tests.support.broker import broker, free_port
from tests.support.collecting import CollectorProcess
from tests.support.fleet_bench import MOSQUITTO, NOW, Meter, Place, Sessions, p95, processor_s, say, spread

AIRCRAFT: Final = 1000
YEARS, POWER_UPS_A_YEAR, COPIES = 5, 100, 10
LIMIT_MS: Final = 200.0


def seed(url: str, sessions: Sessions, aircraft: int) -> None:
    """Five years of so many aircraft: the first of a tenth of them is taken in as told, the others are copies of it."""
    store, dice = Store(url), random.Random(5)
    store.prepare()
    for number in range(aircraft // COPIES):
        one = Aircraft(number)
        for days in sorted(dice.uniform(0.0, 365.0) for _ in range(POWER_UPS_A_YEAR)):
            sessions.add(one, NOW - datetime.timedelta(days=365 * (YEARS - 1) + days))
        messages = [Incoming(f"fleet/{one.id}/item", payload) for payload in one.told.values()]
        store.take([*messages, Incoming(f"fleet/{one.id}/hello", one.hello)])
    store.close()
    engine = engine_of(url)
    later = "strftime('%Y-%m-%d %H:%M:%f000', {0}, '{1} days')"
    if engine.dialect.name == "postgresql":
        later = "{0} + make_interval(days => {1})"
    a_year = 2 * POWER_UPS_A_YEAR
    for year in range(1, YEARS):
        of_time = {"sequence": f"sequence + {a_year * year}", "same": f"substr(same, 1, 31) || {year}"}
        _copy(engine, lambda column, year=year, of_time=of_time: of_time.get(column.name) or (  # type: ignore[misc]
            later.format(column.name, 365 * year) if isinstance(column.type, schema.UtcTime) else column.name
        ), "sequence", f"sequence <= {a_year}")  # fmt: skip
    for copy in range(1, COPIES):
        _copy(engine, lambda column, copy=copy: f"substr(aircraft, 1, 35) || {copy}" if column.name == "aircraft"  # type: ignore[misc]
              else column.name, "aircraft", "aircraft LIKE '%0'")  # fmt: skip
    with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        connection.execute(sa.update(schema.aircraft).values(last=a_year * YEARS))
        connection.exec_driver_sql("ANALYZE")
    engine.dispose()


def _copy(engine: sa.Engine, value: Callable[[sa.Column[Any]], str], by: str, where: str) -> None:
    """Rows of every table that has such a key once more, changed."""
    for table in schema.tables.sorted_tables:
        if by in table.primary_key.columns:
            columns = [column for column in table.columns if column.computed is None]
            names, values = [column.name for column in columns], [sa.text(value(column)) for column in columns]
            rows = sa.select(*values).select_from(table).where(sa.text(where))
            with engine.begin() as connection:
                if engine.dialect.name == "postgresql":
                    connection.exec_driver_sql("SET LOCAL statement_timeout = 0")
                connection.execute(sa.insert(table).from_select(names, rows))


def sizes(url: str, aircraft: int) -> str:
    """Bytes of one aircraft and year."""
    engine, per = engine_of(url, reads_only=True), aircraft * YEARS
    with engine.connect() as connection:
        rows = {
            table.name: connection.execute(sa.select(sa.func.count()).select_from(table)).scalar_one() / per
            for table in schema.tables.sorted_tables
            if "sequence" in table.primary_key.columns
        }
        if engine.dialect.name == "sqlite":
            size = connection.exec_driver_sql("SELECT page_count * page_size FROM pragma_page_count, pragma_page_size")
        else:
            size = connection.exec_driver_sql("SELECT pg_database_size(current_database())")
        kib = size.scalar_one() / per / 1024.0
    engine.dispose()
    words = ", ".join(f"{table} {number:.0f}" for table, number in rows.items() if number)
    return f"{sum(rows.values()):.0f} rows ({words}), {kib:.0f} KiB an aircraft and year"


def judging(url: str) -> None:
    """Time the judgement of all items, one after another."""
    store, took_ms = Store(url), list[float]()
    meter, begun_s = Meter(time.process_time), time.perf_counter()
    while store.judge():
        took_ms.append(1e3 * (time.perf_counter() - begun_s))
        begun_s = time.perf_counter()
    store.close()
    if took_ms:
        cost = meter.cost(len(took_ms))
        say(
            f"judging {len(took_ms)} aircraft",
            f"{spread(took_ms)};",
            f"processor {1e3 * cost.own_s / cost.items:.0f} ms each",
        )


def _get(port: int, path: str) -> tuple[float, int]:
    """Response time of a page, in ms, and its bytes."""
    begun_s = time.perf_counter()
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60.0)
    connection.request("GET", path)
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    assert answer.status == 200, (path, answer.status, body[:200])
    return 1e3 * (time.perf_counter() - begun_s), len(body)


async def page_latency(place: Place, url: str, aircraft: int) -> None:
    """Time real requests to the real server, one after another."""
    port, dice = free_port(), random.Random(7)
    page = f"127.0.0.1:{port}"
    one = CollectorProcess(place.folder, f"page-{port}", place.one, url, "--page", page)
    try:
        await one.at_work()
        of_one = [f"/aircraft/{Aircraft(dice.randrange(aircraft // COPIES)).id}" for _ in range(200)]
        kinds = [("the fleet", ["/"] * 50), ("an aircraft", of_one)]
        for words, paths in kinds:
            await asyncio.to_thread(_get, port, paths[0])
            meter = Meter(lambda: processor_s(one.process_id), lambda: processor_s(place.postgres.process_id))
            found = [await asyncio.to_thread(_get, port, path) for path in paths]
            cost = meter.cost(len(paths))
            took_ms = [ms for ms, _ in found]
            own_ms, database_ms = 1e3 * cost.own_s / cost.items, 1e3 * cost.database_s / cost.items
            held = "held" if p95(took_ms) <= LIMIT_MS else "NOT HELD"
            say(
                f"page of {words}, {found[0][1] / 1024:.0f} KiB",
                f"{spread(took_ms)}, limit {LIMIT_MS:g} ms {held};",
                f"processor {own_ms:.0f} ms, the database's {database_ms:.0f} ms",
            )
    finally:
        one.kill()


async def pages(place: Place, urls: Sequence[str], aircraft: int) -> None:
    """Measure databases with five years."""
    async with broker(place.folder, "mosquitto", more=MOSQUITTO) as one:
        for url in urls:
            print(f"\n{'SQLite' if '://' not in url else 'PostgreSQL'}: {sizes(url, aircraft)}")
            await asyncio.to_thread(judging, url)
            await page_latency(place._replace(one=one), url, aircraft)
