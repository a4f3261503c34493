"""The fleet's pages: every aircraft is on one of them, and many clients cost one rendering."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa

from companion.fleet import page, schema
from companion.fleet.database import engine_of
from companion.fleet.server import Renderer
from companion.fleet.store import Store
from companion.mqtt.client import Incoming
from sim.fleet.aircraft import Aircraft
from tests.support.collecting import NOW


@pytest.fixture
def database(tmp_path: Path) -> str:
    return str(tmp_path / "fleet.sqlite")


@pytest.fixture
def store(database: str) -> Iterator[Store]:
    one = Store(database)
    one.prepare()
    yield one
    one.close()


def tell(store: Store, *fleet: Aircraft) -> None:
    for one in fleet:
        items = [Incoming(f"fleet/{one.id}/item", payload) for payload in one.told.values()]
        store.take([Incoming(f"fleet/{one.id}/hello", one.hello), *items])


def shown(database: str, number: int = 1) -> str | None:
    engine = engine_of(database, reads_only=True)
    try:
        with engine.begin() as connection:
            return page.glance(connection, NOW, number)
    finally:
        engine.dispose()


def listed(html: str | None) -> list[str]:
    assert html is not None
    return re.findall(r'<tr><td><a href="/aircraft/([0-9a-f]{36})"', html)


def test_invented_aircraft_push_no_real_one_from_the_first_page(
    store: Store, database: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page, "MOST_AIRCRAFT", 10)
    real, invented = [Aircraft(number) for number in range(6)], [Aircraft(number) for number in range(100, 130)]
    for one in real:
        one.calibrate(NOW)
    real[0].calibrate(NOW, "the aircraft moved")
    real[1].arm(NOW)
    for number, one in enumerate(invented):
        one.name = f"A{number:02}"
    tell(store, *real)
    tell(store, *invented)  # heard later, and before all others by name
    finding = {"aircraft": real[5].id, "place": 0, "kind": "bias", "power_ups": 4, "size": 9.0, "words": "replace it"}
    with store._engine.begin() as connection:
        connection.execute(sa.insert(schema.findings).values(finding))
    pages = [shown(database, number) for number in range(1, 5)]
    first = pages[0] or ""
    assert "36 aircraft: 30 not calibrated, 1 last try failed, 5 calibrated<" in first
    assert "1 to 10 of 36, " in first
    assert {one.id for one in real} < {*listed(first)}
    every = [which for each in pages for which in listed(each)]
    assert sorted(every) == sorted(one.id for one in (*real, *invented))
    assert shown(database, 5) is None
    assert [re.findall(r'href="(/(?:page/\d)?)">(?:Previous|Next)', each or "")[:2] for each in pages] == [
        ["/page/2", "/page/2"], ["/", "/page/3"], ["/page/2", "/page/4"], ["/page/3", "/page/3"],
    ]  # fmt: skip


@pytest.mark.parametrize(
    "at", ["0001-01-01 00:00:00.000000", "9999-12-31 23:59:59.999999", "1969-12-31 23:59:59.000000"]
)
def test_a_database_of_an_older_collector_with_an_extreme_date_has_pages(store: Store, database: str, at: str) -> None:
    """Older collectors have taken in whatever could be read as a date."""
    one = Aircraft(1)
    one.live(NOW, 4)
    one.fly(NOW)
    one.learn(NOW)
    one.undo(NOW)
    tell(store, one)
    with store._engine.begin() as connection:
        connection.exec_driver_sql("UPDATE calibrations SET started_at = ?, zero_at = ? WHERE sequence = 1", (at, at))
        connection.exec_driver_sql("UPDATE armings SET armed_at = ? WHERE sequence = 2", (at,))
        connection.exec_driver_sql("UPDATE flights SET began_at = ?", (at,))
        connection.exec_driver_sql("UPDATE undos SET undone_at = ?, of_at = ?", (at, at))
    while store.judge():
        pass
    with store._reads.begin() as connection:
        its = page.aircraft(connection, one.id, NOW)
    assert its is not None
    assert "clock went back in between, so these stand in their order" in its
    assert one.name in (shown(database) or "")


# --- many clients


class Counting:
    """A renderer, and how often it has read the database."""

    def __init__(self, database: str) -> None:
        self.times = 0
        self.engine = engine_of(database, reads_only=True)
        sa.event.listen(self.engine, "begin", self._count)
        self.renderer = Renderer(self.engine)

    def _count(self, _connection: sa.Connection) -> None:
        self.times += 1


@pytest.fixture
def counting(store: Store, database: str) -> Iterator[Counting]:
    one = Aircraft(1)
    one.live(NOW, 2)
    tell(store, one)
    found = Counting(database)
    yield found
    found.engine.dispose()


def test_clients_of_one_page_share_one_rendering(counting: Counting) -> None:
    async def main() -> None:
        impatient = [asyncio.create_task(counting.renderer.get("/")) for _ in range(20)]
        await asyncio.sleep(0)
        for each in impatient:
            each.cancel()
        found = await asyncio.gather(*(counting.renderer.get("/") for _ in range(20)))
        assert {*found} == {found[0]}
        assert b"1 aircraft" in (found[0] or b"")
        assert counting.times == 1

    asyncio.run(main())


def test_a_page_is_made_anew_once_it_is_old(counting: Counting, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.fleet.server.FRESH_S", 0.0)

    async def main() -> None:
        for times in (1, 2):
            await counting.renderer.get("/")
            await asyncio.sleep(0.01)
            assert counting.times == times

    asyncio.run(main())
