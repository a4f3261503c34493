"""The fleet's pages: every aircraft is on one of them, and many clients cost one rendering."""

from __future__ import annotations

import re

import pytest
import sqlalchemy as sa

from companion.fleet import page, schema
from companion.fleet.schema import engine_of
from companion.fleet.store import Store
from companion.mqtt.client import Incoming
from sim.fleet.aircraft import Aircraft
from tests.support.collecting import NOW


def tell(store: Store, *fleet: Aircraft) -> None:
    for one in fleet:
        items = [Incoming(f"fleet/{one.id}/item", payload) for payload in one.told.values()]
        store.take([Incoming(f"fleet/{one.id}/hello", one.hello), *items])


def shown(database: str) -> str:
    engine = engine_of(database, reads_only=True)
    try:
        with engine.begin() as connection:
            return page.glance(connection, NOW)
    finally:
        engine.dispose()


def listed(html: str) -> list[str]:
    return re.findall(r'<tr><td><a href="/aircraft/([0-9a-f]{36})"', html)


def test_invented_aircraft_push_no_real_one_from_the_page(
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
    first = shown(database)
    assert "36 aircraft: 30 not calibrated, 1 last try failed, 1 suspect, 4 calibrated<" in first
    assert "The 10 with findings, worst and latest heard are listed." in first
    assert len(listed(first)) == 10
    assert {one.id for one in real} < {*listed(first)}


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
