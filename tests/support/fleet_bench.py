"""Parts shared by the fleet's benches: items of aircraft, places, and costs."""

from __future__ import annotations

import contextlib
import datetime
import os
import random
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec

from companion.daemon.job import Job
from companion.estimation.machine import What
from sim.fleet.aircraft import Aircraft
from tests.support.broker import Broker
from tests.support.light_aircraft import Fleet, Light
from tests.support.postgres import Postgres
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

NOW: Final = datetime.datetime(2026, 11, 20, 12, tzinfo=datetime.UTC)
MOSQUITTO: Final = "max_queued_messages 100000\nmax_inflight_messages 1000\n"
POSTGRES: Final = {"fsync": "on", "shared_buffers": "256MB", "max_wal_size": "4GB"}
_TICK_S: Final = 1.0 / os.sysconf("SC_CLK_TCK")


class Place(NamedTuple):
    folder: Path
    one: Broker
    postgres: Postgres


# --- what is told


async def _record(folder: Path) -> dict[str, Any]:
    """A calibration's record as the daemon makes it: two IMUs, gradienter, compass, six parameters written."""
    rig = Rig(folder, own_imu=True)
    async with rig.running():
        await rig.ready()
        job = rig.service.calibrating.manager.start_calibration(What.BOTH, "bench")
        assert isinstance(job, Job), job
        await job.finished
    found: dict[str, Any] = msgspec.json.decode((folder / "records" / "000001.json").read_bytes())
    return found


class Sessions:
    """Items of aircraft after a power-up: a calibration with their own biases, and an arming."""

    def __init__(self) -> None:
        with tempfile.TemporaryDirectory() as folder:
            self._record = run_virtual(_record(Path(folder)))
        self._record["imus"] = [{**imu, "held_back": []} for imu in self._record["imus"]]

    def add(self, one: Aircraft, at: datetime.datetime) -> list[int]:
        told = one.calibrate(at)
        item = msgspec.json.decode(one.told[told])
        for number, imu in enumerate(item["body"]["imus"]):
            own = {name: value for name, value in imu.items() if value not in (None, [], {}, ())}
            item["body"]["imus"][number] = {**self._record["imus"][number], **own}
        item["body"] = {**self._record, "imus": item["body"]["imus"], "started_at": item["body"]["started_at"]}
        one.told[told] = msgspec.json.encode(item)
        return [told, one.arm(at + datetime.timedelta(minutes=5))]

    def of(self, fleet: Fleet, seed: int) -> list[tuple[Light, list[int]]]:
        """One of each aircraft, which begins anew."""
        fleet.begin_anew(seed)
        found = [(light, self.add(light.one, NOW)) for light in fleet.lights]
        random.Random(seed).shuffle(found)
        return found


# --- what it costs


def _stat(process_id: int) -> list[str]:
    return Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()


def processor_s(process_id: int) -> float:
    """Processor time of a process, of its living children, and of its ended ones."""
    spent = sum(map(int, _stat(process_id)[11:15]))
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            stat = _stat(int(folder.name))
            spent += sum(map(int, stat[11:13])) if int(stat[1]) == process_id else 0
    return spent * _TICK_S


class Cost(NamedTuple):
    """Cost of so many items: wall time, processor time of the process, and of the database."""

    items: int
    clock_s: float
    own_s: float
    database_s: float

    def __str__(self) -> str:
        own, both = self.items / self.own_s, self.items / (self.own_s + self.database_s)
        return f"{self.items / self.clock_s:9.0f} {own:9.0f} {both:9.0f}"


class Meter:
    """Measures from its making to `cost`."""

    def __init__(self, own: Callable[[], float], database: Callable[[], float] = lambda: 0.0) -> None:
        self._own, self._database = own, database
        self._begun = time.perf_counter(), own(), database()

    def cost(self, items: int) -> Cost:
        clock_s, own_s, database_s = self._begun
        return Cost(items, time.perf_counter() - clock_s, self._own() - own_s, self._database() - database_s)


def say(what: str, cost: object, more: str = "") -> None:
    print(f"{what:52} {cost} {more}".rstrip(), flush=True)


def spread(of_ms: Sequence[float]) -> str:
    return f"median {statistics.median(of_ms):.0f} ms, p95 {p95(of_ms):.0f} ms, worst {max(of_ms):.0f} ms"


def p95(of: Sequence[float]) -> float:
    return sorted(of)[int(0.95 * (len(of) - 1))]
