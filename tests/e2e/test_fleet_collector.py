"""The collector as a process, a real Mosquitto, PostgreSQL and SQLite: whatever is killed, nothing is lost or twice."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import pytest
import sqlalchemy as sa

from companion.config.sections import Mqtt
from companion.fleet.collector import Collector, stop
from companion.fleet.store import Store
from companion.mqtt.client import Incoming
from sim.fleet.aircraft import Aircraft
from tests.support.broker import MOSQUITTO, broker
from tests.support.collecting import (
    NOW,
    items_in,
    rows_of,
    telling,
    told_by,
    until_confirmed,
)
from tests.support.postgres import INITDB, Postgres, postgres

pytestmark = [
    pytest.mark.skipif(MOSQUITTO is None, reason="no Mosquitto: shared subscriptions need one"),
    pytest.mark.real_clock,
]
Kind = Literal["sqlite", "postgresql"]
KINDS: list[Kind] = ["sqlite", "postgresql"]


@pytest.fixture(scope="module")
def server() -> Iterator[Postgres]:
    if INITDB is None:
        pytest.skip("no PostgreSQL")
    with postgres() as one:
        yield one


@pytest.fixture
def database(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """An empty one of the kind that the test is asked for."""
    if request.param == "sqlite":
        return str(tmp_path / "fleet.sqlite")
    one: Postgres = request.getfixturevalue("server")
    return one.create(f"fleet-{tmp_path.name}")


def fleet_of(number: int, flights: int, seed: int) -> list[Aircraft]:
    fleet = [Aircraft(k, seed) for k in range(number)]
    for each in fleet:
        each.live(NOW, flights)
    return fleet


def test_a_broker_without_mqtt_5_gets_one_collector(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("companion.fleet.collector.ANSWER_S", 3.0)  # amqtt does not answer to MQTT 5
    fleet, database = fleet_of(3, 4, seed=5), str(tmp_path / "fleet.sqlite")

    async def main() -> None:
        async with broker(tmp_path, "amqtt") as one:
            collecting = asyncio.create_task(Collector(Mqtt(host="127.0.0.1", port=one.port), Store(database)).run())
            async with telling(fleet, one):
                await until_confirmed(fleet)
            await stop([collecting])

    with caplog.at_level(logging.INFO):
        asyncio.run(main())
    assert items_in(database) == told_by(fleet)
    assert "MQTT 3.1.1: no other collector beside this one" in caplog.text


@pytest.mark.parametrize("database", KINDS, indirect=True)
def test_odd_texts_come_into_every_database(database: str) -> None:
    """A zero byte is none of a text of PostgreSQL; the same six characters as text, quotes and umlauts stay."""
    one, odd = Aircraft(1), 'a\0b \\u0000 "Bö\u2028"'
    one.calibrate(NOW, odd)
    one.arm(NOW)
    hello = json.loads(one.hello)
    messages = [Incoming(f"fleet/{one.id}/item", payload) for payload in one.told.values()]
    store = Store(database)
    store.prepare()
    for name in (odd, None):  # a former aircraft of a companion is told without: it keeps its name
        said = json.dumps({**hello, "name": name}).encode()
        outcome = store.take([*messages, Incoming(f"fleet/{one.id}/hello", said)])
        assert outcome[:3] == ({(one.id, one.epoch): [1, 2]}, {}, [])
    store.close()
    wanted = odd.replace("\0", "\ufffd")
    assert rows_of(database, sa.text("SELECT reason FROM calibrations"))[0][0] == wanted
    assert rows_of(database, sa.text("SELECT name FROM aircraft"))[0][0] == wanted
    assert items_in(database) == told_by([one])
