"""/metrics of a collector, read by Prometheus' own parser, against what has really happened."""

from __future__ import annotations

import asyncio
import contextlib
import sqlite3
import time
from collections.abc import Iterator
from pathlib import Path

import aiomqtt
import pytest
from prometheus_client.parser import text_string_to_metric_families

from companion.fleet.metrics import BUCKETS_S, Metrics
from companion.fleet.simulated import Aircraft
from companion.fleet.store import Outcome
from tests.support.broker import MOSQUITTO, broker, free_port
from tests.support.collecting import NOW, CollectorProcess, basic, get, served, telling, until_confirmed
from tests.support.postgres import INITDB, postgres

PREFIX = "companion_fleet_"


def parsed(text: str) -> dict[str, float]:
    """Values by name; of a histogram by name and upper limit."""
    return {
        "".join((sample.name.removeprefix(PREFIX), *sample.labels.values())): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


async def scraped(port: int, *headers: str) -> dict[str, float]:
    status, answer = await get(port, "/metrics", *headers)
    assert status == 200
    head, _, body = answer.partition("\r\n\r\n")
    assert "Content-Type: text/plain; version=0.0.4" in head
    return parsed(body)


@pytest.fixture(params=["sqlite", "postgresql"])
def database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    if request.param == "sqlite":
        yield str(tmp_path / "fleet.sqlite")
    elif INITDB is None:
        pytest.skip("no PostgreSQL")
    else:
        with postgres() as server:
            yield server.create("fleet")


@pytest.mark.skipif(MOSQUITTO is None, reason="no Mosquitto")
def test_what_a_collector_has_done(database: str, tmp_path: Path) -> None:
    fleet, port = [Aircraft(k) for k in range(3)], free_port()
    for each in fleet:
        each.live(NOW, 6)
    told = sum(len(each.told) for each in fleet)
    began_s = time.time()

    async def until(**wanted: float) -> dict[str, float]:
        async with asyncio.timeout(60.0):
            while True:
                found = await scraped(port)
                if all(found[name] == value for name, value in wanted.items()):
                    return found
                await asyncio.sleep(0.05)

    async def main() -> None:
        async with broker(tmp_path) as one:
            collector = CollectorProcess(tmp_path, "collector", one, database, "--page", f"127.0.0.1:{port}")
            try:
                await collector.at_work()
                async with telling(fleet, one):
                    await until_confirmed(fleet)
                    found = await until(items_total=told, connected=1, connections_total=1, aircraft_heard=3)
                    assert found["payloads_rejected_total"] == 0
                    assert began_s - 1.0 < found["last_commit_timestamp_seconds"] < time.time() + 1.0
                    assert found["commit_seconds_count"] == found["commit_seconds_bucket+Inf"] > 0
                    assert 0.0 < found["commit_seconds_sum"] < time.time() - began_s
                    await publish(one.port, fleet[0].id, fleet[0].told[1], fleet[0].told[1], fleet[0].told[2])
                    await publish(one.port, fleet[1].id, fleet[0].told[1], b"~")
                    await until(items_total=told, payloads_rejected_total=2)
                    # What was told while the collector came was told again: it asked for what it lacked.
                    again = sum(each.deliveries for each in fleet) - told
                    await until(items_total=told, items_duplicate_total=again + 3)
                    one.kill()
                    await until(connected=0)
                    await one.start()
                    await until(connected=1, connections_total=2)
            finally:
                collector.kill()

    asyncio.run(main())


async def publish(port: int, aircraft: str, *payloads: bytes) -> None:
    async with aiomqtt.Client("127.0.0.1", port) as client:
        for payload in payloads:
            await client.publish(f"fleet/{aircraft}/item", payload, qos=1)


def test_a_histogram_of_what_took_how_long() -> None:
    metrics = Metrics()
    for took_s in (0.002, 0.02, 0.025, 0.5, 60.0):
        metrics.committed(Outcome({("a", "e"): [1, 2]}, {}, [], new=1), took_s)
    found = parsed(metrics.text(None).decode())
    assert [found[f"commit_seconds_bucket{most_s}"] for most_s in BUCKETS_S] == [1, 1, 3, 3, 3, 4, 4, 4]
    assert found["commit_seconds_bucket+Inf"] == found["commit_seconds_count"] == 5
    assert found["commit_seconds_sum"] == pytest.approx(60.547)
    assert (found["items_total"], found["items_duplicate_total"]) == (5, 5)
    assert "aircraft_heard" not in found


def test_it_wants_the_password_of_the_page_and_outlives_the_database(tmp_path: Path) -> None:
    password = "Grus grus grus"  # noqa: S105

    def break_database() -> None:
        with contextlib.closing(sqlite3.connect(tmp_path / "fleet.sqlite")) as connection:
            connection.execute("DROP TABLE aircraft")

    async def main() -> None:
        async with served(tmp_path, Aircraft(1), password=password) as port:
            assert (await get(port, "/metrics"))[0] == 401
            assert (await scraped(port, "Host: x", basic(password)))["aircraft_heard"] == 1
            break_database()
            status, answer = await get(port, "/", "Host: x", basic(password))
            assert status == 503
            assert "Refresh: 2\r\n" in answer  # a phone that looked too soon is not left with it
            found = await scraped(port, "Host: x", basic(password))
            assert "aircraft_heard" not in found
            assert found["items_total"] == 0

    asyncio.run(main())
