"""The fleet's fault table: what is killed, full, wrong or told twice between aircraft and database.

A real Mosquitto, the collector as processes, SQLite and PostgreSQL; `python -m tests.campaign --fleet`. Afterwards the
database has what each aircraft truly had, once. The aircraft's own part of it is in tests/unit/fleet/test_face.py.
"""

from __future__ import annotations

import asyncio
import contextlib
import datetime
import json
import random
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any, Literal

import aiomqtt
import sqlalchemy as sa

from companion.fleet.contract import moment
from companion.fleet.schema import UtcTime
from sim.fleet.aircraft import Aircraft
from tests.support.broker import Broker, broker
from tests.support.collecting import (
    NOW,
    CollectorProcess,
    items_in,
    quick,
    rows_of,
    telling,
    told_by,
    until_confirmed,
)
from tests.support.postgres import Postgres, postgres

Kind = Literal["sqlite", "postgresql"]
KINDS: tuple[Kind, ...] = ("sqlite", "postgresql")
ROOM_MB: dict[Kind, int] = {"sqlite": 2, "postgresql": 24}
"""Size of the small disk; PostgreSQL copies its catalogue into each database."""
NO_MOUNTS = "this user may not mount a small file system"


class NotApplicableError(Exception):
    """There is no such fault here; why."""


class FleetScene:
    """A fleet, its broker and its collectors, with a chance of their own."""

    def __init__(self, folder: Path, database: str, server: Postgres | None, chance: random.Random) -> None:
        self.folder, self.database, self.server, self.chance = folder, database, server, chance
        self.fleet = [Aircraft(number, chance.randrange(1 << 20)) for number in range(3)]
        self.collectors: list[CollectorProcess] = []
        self.broker: Broker
        self.small_disk = folder
        """Folder of the database on a small disk; None: elsewhere."""
        self._started = 0
        quick(self.fleet, 0.5)

    def live(self, flights: int, *, days: float = 90.0, wrong_by: float = 0.0) -> None:
        """Each has flown; their clocks may have been wrong by so many days, either way, from flight to flight."""
        for one in self.fleet:
            for _ in range(flights):
                off = datetime.timedelta(days=self.chance.choice((-wrong_by, 0.0, wrong_by)))
                one.live(NOW + off, 1, days)

    def start(self) -> CollectorProcess:
        self._started += 1
        self.collectors.append(CollectorProcess(self.folder, f"collector-{self._started}", self.broker, self.database))
        return self.collectors[-1]

    async def a_while(self, most_s: float = 0.7) -> None:
        await asyncio.sleep(self.chance.uniform(0.0, most_s))

    async def until(self, what: Callable[[], object], within_s: float = 120.0) -> None:
        async with asyncio.timeout(within_s):
            while not what():
                await asyncio.sleep(0.05)

    def not_there_but_confirmed(self) -> set[tuple[str, int]]:
        """Items that an aircraft holds for confirmed and the database lacks: must be empty at any time."""
        confirmed = {(one.id, number) for one in self.fleet for number in one.confirmed}
        return confirmed - {(row[0], row[2]) for row in items_in(self.database)}


# --- what happens


async def broker_killed(scene: FleetScene) -> None:
    for _ in range(3):
        await scene.a_while()
        scene.broker.kill()
        scene.live(2)
        await scene.a_while()
        await scene.broker.start()


async def collector_killed(scene: FleetScene) -> None:
    scene.start()
    for _ in range(3):
        await scene.collectors[0].at_work()
        await scene.a_while()
        scene.collectors.pop(0).kill()
        assert not scene.not_there_but_confirmed()
        scene.live(2)
        scene.start()


async def database_killed(scene: FleetScene) -> None:
    if scene.server is None:
        raise NotApplicableError("a file is not killed")
    for _ in range(2):
        await scene.a_while()
        scene.server.kill()
        scene.live(2)
        await scene.a_while()
        scene.server.start()


async def disk_full(scene: FleetScene) -> None:
    """A file system of a few MB is filled by others, and emptied again."""
    await scene.collectors[0].at_work()
    filler = scene.small_disk / "filler"
    with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(b"x" * 4096)
    scene.live(20)
    log = scene.collectors[0].log
    words = ("full", "space", "disk I/O")  # SQLite's, PostgreSQL's, and SQLite's where it cannot write its log
    await scene.until(lambda: any(each in log.read_text() for each in words))
    assert not scene.not_there_but_confirmed()
    filler.unlink()


async def clock_wrong(scene: FleetScene) -> None:
    """Set the clock wrong by a year, either way, from flight to flight."""
    scene.live(10, wrong_by=365.0)


async def doubled_and_reordered(scene: FleetScene) -> None:
    """Replay messages, in any order and repeatedly."""
    async with aiomqtt.Client("127.0.0.1", scene.broker.port) as client:
        for _ in range(4):
            for one in scene.fleet:
                said = [*one.told.values()] * 2
                scene.chance.shuffle(said)
                for payload in said:
                    await client.publish(f"fleet/{one.id}/item", payload, qos=1)
        scene.live(3)


async def half_a_year_offline(scene: FleetScene) -> None:
    """A flight a day is kept, and told over a connection that is lost again and again."""
    for _ in range(3):
        await scene.a_while(2.0)
        scene.broker.kill()
        await scene.broker.start()


FAULTS: dict[str, Callable[[FleetScene], Awaitable[None]]] = {
    strikes.__name__.replace("_", " "): strikes
    for strikes in (
        broker_killed,
        collector_killed,
        database_killed,
        disk_full,
        clock_wrong,
        doubled_and_reordered,
        half_a_year_offline,
    )
}


# --- one cell, and its judge


def play(name: str, kind: Kind, seed: int, folder: Path, server: Postgres | None) -> str:
    """Why it does not apply, or nothing.

    Raises:
        AssertionError: something was lost, is there twice, or is something else than what it was.
    """
    chance = random.Random(f"{seed} {name} {kind}")
    with contextlib.ExitStack() as stack:
        small, database = folder, str(folder / "fleet.sqlite")
        if name == "disk full":
            try:
                small, database = stack.enter_context(_on_small_disk(kind, server))
            except NotApplicableError as error:
                return str(error)
        elif kind == "postgresql":
            assert server is not None
            database = server.create(f"fleet-{time.monotonic_ns()}")
        scene = FleetScene(folder, database, server if kind == "postgresql" else None, chance)
        scene.small_disk = small
        if name == "half a year offline":
            scene.live(180, days=180.0)
        else:
            scene.live(8)
        try:
            asyncio.run(_course(scene, FAULTS[name]))
        except NotApplicableError as error:
            return str(error)
        judge(database, scene.fleet)
    return ""


async def _course(scene: FleetScene, strikes: Callable[[FleetScene], Awaitable[None]]) -> None:
    async with broker(scene.folder) as scene.broker, _collected(scene), telling(scene.fleet, scene.broker):
        await strikes(scene)
        await until_confirmed(scene.fleet, 300.0)
        # What a hello tells may come behind the items: by it things have their order where clocks are wrong.
        of_hello = sa.text("SELECT COUNT(*) FROM aircraft WHERE epoch IS NOT NULL")
        await scene.until(lambda: rows_of(scene.database, of_hello)[0][0] == len(scene.fleet))


@contextlib.asynccontextmanager
async def _collected(scene: FleetScene) -> AsyncIterator[None]:
    scene.start()
    try:
        yield
        for collector in scene.collectors:
            await collector.at_work()
            assert collector.stop() == 0, collector.log.read_text()
    finally:
        for collector in scene.collectors:
            collector.kill()


@contextlib.contextmanager
def _small_disk(size_mb: int) -> Iterator[Path | None]:
    """Mount a file system of that size, to be filled; None: this user may not mount one."""
    with tempfile.TemporaryDirectory(prefix="companion-small-") as folder:
        mount = ["mount", "-n", "-t", "tmpfs", "-o", f"size={size_mb}m", "tmpfs", folder]
        if subprocess.run(mount, check=False, capture_output=True).returncode != 0:
            yield None
            return
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", folder], check=True)


@contextlib.contextmanager
def _on_small_disk(kind: Kind, server: Postgres | None) -> Iterator[tuple[Path, str]]:
    """A small file system, and the address of a new database on it."""
    with _small_disk(ROOM_MB[kind]) as folder:
        if folder is None:
            raise NotApplicableError(NO_MOUNTS)
        if kind == "sqlite":
            yield folder, str(folder / "fleet.sqlite")
        else:
            assert server is not None
            with server.created_in(folder) as database:
                yield folder, database


def judge(database: str, fleet: list[Aircraft]) -> None:
    """Compare all tables with what each aircraft truly had."""
    assert items_in(database) == told_by(fleet)
    told = {(one.id, number): json.loads(item) for one in fleet for number, item in one.told.items()}
    kinds = Counter(item["kind"] for item in told.values())
    counted = {
        kind: rows_of(database, sa.text(f"SELECT COUNT(*) FROM {kind}s"))[0][0]  # noqa: S608 - a kind of ours
        for kind in ("calibration", "arming", "undo")
    }
    assert counted == {kind: kinds[kind] for kind in counted}
    biases = rows_of(database, sa.text("SELECT aircraft, sequence, imu, axis, gyro_bias_rad_s FROM biases"))
    assert sorted(map(tuple, biases)) == sorted(
        (*key, imu["name"], axis, imu["gyro_bias_rad_s"][k])
        for key, item in told.items()
        if item["kind"] == "calibration"
        for imu in item["body"]["imus"]
        for k, axis in enumerate("xyz")
    )
    in_force = sa.text("SELECT aircraft, calibrated_at FROM fleet").columns(calibrated_at=UtcTime())
    assert dict(tuple(row) for row in rows_of(database, in_force)) == {one.id: _in_force(one) for one in fleet}


def _in_force(one: Aircraft) -> datetime.datetime | None:
    """The last that was done and not put back, by the order of things and no clock."""
    standing: list[str] = []
    for _, payload in sorted(one.told.items()):
        item: dict[str, Any] = json.loads(payload)
        if item["kind"] == "calibration" and item["body"]["state"] == "done":
            standing.append(item["body"]["started_at"])
        elif item["kind"] == "undo":
            standing.remove(item["body"]["of"])
    return moment(standing[-1]) if standing else None


def main(seed: int, only: list[str] | None) -> int:
    """The whole table, or the rows whose name has one of these in it; 1 when a cell fails."""
    names = [name for name in FAULTS if not only or any(part in name for part in only)]
    failed = 0
    print(f"{'':24}" + "".join(f"{kind:>14}" for kind in KINDS))
    with postgres() as server:
        for name in names:
            print(f"{name:24}", end="", flush=True)
            for kind in KINDS:
                with tempfile.TemporaryDirectory(prefix="companion-faults-") as folder:
                    try:
                        verdict = "n.a." if (why := play(name, kind, seed, Path(folder), server)) else "ok"
                    except Exception:  # noqa: BLE001 - whatever it is, it is what the cell shows
                        verdict, why, failed = "FAIL", traceback.format_exc(limit=-4), failed + 1
                print(f"{verdict:>14}", end="", flush=True)
                if why:
                    print(f"\n  {kind}: {why}", file=sys.stderr)
            print()
    print(f"{len(names)} faults, {failed} cells failed; seed {seed}")
    return 1 if failed else 0
