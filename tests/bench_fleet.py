"""Throughput of one collector with ten thousand aircraft at a real Mosquitto, into a real PostgreSQL and into SQLite.

Each aircraft has a connection of its own and comes with a session: its hello, a calibration and an arming as companions
send them. Rates are items a second: by the clock, by a core-second of the collector's process, and by one of process
and database together. Then follow the time from publishing an item to its confirmation, two collectors of which one is
killed every ten seconds, and the pages of a database of five years.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import os
import tempfile
import time
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Final

from sim.fleet.aircraft import Aircraft
from tests import bench_fleet_pages
from tests.bench_memory import memory
from tests.support.broker import Broker, broker
from tests.support.collecting import CollectorProcess, items_in, told_by
from tests.support.fleet_bench import (
    MOSQUITTO,
    NOW,
    POSTGRES,
    Meter,
    Place,
    Sessions,
    processor_s,
    say,
    spread,
)
from tests.support.light_aircraft import Fleet, Light
from tests.support.postgres import Postgres

AIRCRAFT: Final = 10_000
AT_ONCE: Final = 1000
"""Aircraft with something unconfirmed at any moment while a rate is measured."""
QUIET_A_SECOND: Final = 200
"""Sessions a second while latencies are measured, and while collectors are killed."""
KILLED_EVERY_S: Final = 10.0


# --- collectors


@contextlib.asynccontextmanager
async def collectors(place: Place, url: str, number: int) -> AsyncIterator[list[CollectorProcess]]:
    """At work, and through with what was kept by the broker."""
    found = [_collector(place, url) for _ in range(number)]
    try:
        for each in found:
            await each.at_work()
        await asyncio.sleep(6.0)
        while True:
            before_s = _spent(found)
            await asyncio.sleep(1.0)
            if _spent(found) - before_s < 0.05 * number:
                break
        yield found
    finally:
        for each in found:
            each.kill()


def _collector(place: Place, url: str) -> CollectorProcess:
    return CollectorProcess(place.folder, f"collector-{time.monotonic_ns()}", place.one, url, "--page", "off")


def _spent(collectors: Sequence[CollectorProcess]) -> float:
    return sum(processor_s(each.process_id) for each in collectors)


async def rate(place: Place, fleet: Fleet, sessions: Sequence[tuple[Light, list[int]]], url: str, number: int) -> str:
    """Throughput of so many collectors with a permanent backlog."""
    async with collectors(place, url, number) as found:
        meter = Meter(lambda: _spent(found), lambda: processor_s(place.postgres.process_id))
        of_broker = Meter(lambda: processor_s(place.one.process_id))
        await asyncio.wait_for(fleet.tell(sessions, AT_ONCE), 600.0)
        items = sum(len(sequences) for _, sequences in sessions)
        cost, brokers = meter.cost(items), of_broker.cost(items)
    _check(url, fleet)
    often = fleet.deliveries / cost.items
    return f"{cost} told {often:.2f} times each; broker: {brokers.items / brokers.own_s:.0f} a core-s"


def _check(url: str, fleet: Fleet) -> None:
    assert items_in(url) == told_by([light.one for light in fleet.lights]), "lost, or there twice"


async def latency(place: Place, fleet: Fleet, sessions: Sequence[tuple[Light, list[int]]], url: str) -> str:
    """Time from publishing to the confirmation, with one collector below its capacity."""
    async with collectors(place, url, 1):
        await asyncio.wait_for(fleet.tell_at(sessions, QUIET_A_SECOND), 600.0)
    took_ms = [1e3 * (heard_s - told_s) for told_s, heard_s in fleet.confirmed]
    return spread(took_ms)


async def killed(place: Place, fleet: Fleet, sessions: Sequence[tuple[Light, list[int]]], url: str) -> str:
    """Two collectors; every ten seconds one of them is killed, by turns, and another one started."""
    async with collectors(place, url, 2) as found:
        killings = 0

        async def kill() -> None:
            nonlocal killings
            while True:
                await asyncio.sleep(KILLED_EVERY_S)
                found.pop(0).kill()
                killings += 1
                found.append(_collector(place, url))

        killing = asyncio.create_task(kill())
        await asyncio.wait_for(fleet.tell_at(sessions, QUIET_A_SECOND), 600.0)
        killing.cancel()
    _check(url, fleet)
    items = sum(len(sequences) for _, sequences in sessions)
    return f"{items} items, {killings} killings: none lost, none twice; told {fleet.deliveries / items:.2f} times each"


async def rates(place: Place, number: int, sessions: Sessions) -> None:
    """All but the pages."""
    folder, postgres = place.folder, place.postgres
    fleet, one_of = Fleet([Aircraft(k) for k in range(number)]), Aircraft(number)
    sizes = [len(one_of.told[sequence]) for sequence in sessions.add(one_of, NOW)]
    print(f"{number} aircraft; a calibration has {sizes[0]} bytes, an arming {sizes[1]}")
    async with broker(folder, "mosquitto", more=MOSQUITTO) as one:
        place, numbers = place._replace(one=one), itertools.count(1)

        def another() -> str:
            return postgres.create(f"rates-{time.monotonic_ns()}")

        def another_file() -> str:
            return str(folder / f"rates-{time.monotonic_ns()}.sqlite")

        begun_s = time.monotonic()
        async with fleet.at(one.port):
            resident_mib = memory(one.process_id).resident
            print(f"all at the broker after {time.monotonic() - begun_s:.1f} s, which has {resident_mib:.0f} MiB then")
            print(f"\n{'items a second':52} {'by clock':>9} {'a core-s':>9} {'with db':>9}")
            for words, where, many in (
                ("one collector, PostgreSQL", another(), 1),
                ("two collectors, PostgreSQL", another(), 2),
                ("one collector, SQLite", another_file(), 1),
            ):
                say(words, await rate(place, fleet, sessions.of(fleet, next(numbers)), where, many))
            words = f"published to confirmed, {2 * QUIET_A_SECOND} items/s"
            say(words, await latency(place, fleet, sessions.of(fleet, next(numbers)), another()))
            words = "one of two killed every 10 s"
            say(words, await killed(place, fleet, sessions.of(fleet, next(numbers)), another()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", default=["rates", "pages"], help="rates, pages, seed (default: all)")
    parser.add_argument("--aircraft", type=int, default=AIRCRAFT, help=f"at the broker (default {AIRCRAFT})")
    parser.add_argument("--aircraft-of-years", type=int, default=bench_fleet_pages.AIRCRAFT)
    parser.add_argument("--folder", type=Path, help="for the databases; those of five years are used again")
    options = parser.parse_args()
    sessions = Sessions()
    with tempfile.TemporaryDirectory(prefix="companion-bench-") as text:
        folder = options.folder or Path(text)
        folder.mkdir(exist_ok=True)
        folder.chmod(0o755)
        (folder / "postgres").mkdir(exist_ok=True)
        postgres = Postgres(folder / "postgres", **POSTGRES)
        postgres.start()
        try:
            _play(options, Place(folder, Broker(folder), postgres), sessions)
        finally:
            postgres.kill()


def _play(options: argparse.Namespace, place: Place, sessions: Sessions) -> None:
    name, number = f"pages{options.aircraft_of_years}", options.aircraft_of_years
    urls = [place.postgres.url(name), str(place.folder / f"{name}.sqlite")]
    if "rates" in options.parts:
        asyncio.run(rates(place, options.aircraft, sessions))
    for url in urls if {"pages", "seed"} & set(options.parts) else ():
        done = place.folder / f"{name}-{'://' in url}.done"
        if not done.exists():
            if "://" in url:
                place.postgres.create(name)
            bench_fleet_pages.seed(url, sessions, number)
            done.touch()
    if "pages" in options.parts:
        asyncio.run(bench_fleet_pages.pages(place, urls, number))
    print(f"\nload average {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main()
