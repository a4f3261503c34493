"""The whole daemon, a real broker and a collector: what happens on the aircraft is in the fleet's hands afterwards."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from companion.config.sections import Mqtt
from companion.fleet.collector import Collector, stop
from companion.fleet.store import Store
from tests.support.broker import BEST, Broker, broker, hurry
from tests.support.collecting import items_in, rows_of
from tests.support.fleet import check
from tests.support.mqtt_daemon import until_connected
from tests.support.rig import Rig

pytestmark = pytest.mark.real_clock

UID = b"virtual 0000".ljust(18, b"\0").hex()


@pytest.fixture(autouse=True)
def _hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch, BEST)


@contextlib.asynccontextmanager
async def collecting(one: Broker, database: str) -> AsyncIterator[None]:
    """A collector at a real broker, as long as that lives."""
    task = asyncio.create_task(Collector(Mqtt(host="127.0.0.1", port=one.port), Store(database)).run())
    try:
        yield
    finally:
        await stop([task])


def told(database: str) -> list[Any]:
    """The items in the database, in order; each as the contract says."""
    return [check("item", item[3].encode()) for item in items_in(database)] if Path(database).exists() else []


def kinds(database: str) -> list[str]:
    return [item["kind"] for item in told(database)]


async def until(what: Callable[[], bool], within_s: float = 90.0) -> None:
    async with asyncio.timeout(within_s):
        while not what():
            await asyncio.sleep(0.05)


async def test_a_calibration_an_undo_and_an_arming_are_in_the_database_whatever_is_killed(tmp_path: Path) -> None:
    database, named = str(tmp_path / "collected.sqlite"), sa.text("SELECT aircraft, name FROM fleet")
    store = Store(database)
    store.prepare()
    store.close()
    async with broker(tmp_path) as one:
        more = f'{one.section()}[fleet]\nname = "Heron 7"\nlocation = "full"\n'
        rig = Rig(tmp_path, min_still_s=3.0, max_s=4.0, more=more)
        rig.offload = asyncio.to_thread
        async with rig.running():
            service = rig.service
            await until_connected(service)
            await rig.ready()

            async def ask(**request: Any) -> Any:
                return [reply async for reply in service.faces.answer(request)][-1]

            async with collecting(one, database):
                done = await ask(command="calibrate", wait=True)
                assert done["record"]["state"] == "done"
                await until(lambda: service.status()["fleet"]["waiting"] == 0 and kinds(database) == ["calibration"])
            # Nobody collects any more, and the broker forgets everything.
            one.kill()
            assert (await ask(command="undo"))["state"] == "done"
            await until(lambda: service.status()["fleet"]["waiting"] == 1)
            await one.start()
            await until_connected(service)
            await asyncio.sleep(1.0)
            one.kill()
            rig.autopilot.armed = True
            await until(lambda: service.status()["fleet"]["waiting"] == 2)
            await one.start()
            async with collecting(one, database):
                await until(lambda: kinds(database)[1:] == ["undo", "arming"])
                await until(lambda: service.status()["fleet"]["waiting"] == 0)
                # Its name comes with a hello, which waits for the items that were sent with it.
                await until(lambda: [*map(tuple, rows_of(database, named))] == [(UID, "Heron 7")])
    calibration, undo, _ = told(database)
    assert calibration["body"] == json.loads(json.dumps(done["record"]))
    assert undo["body"]["of"] == done["record"]["started_at"]
    (imu, *_) = calibration["body"]["imus"]
    assert imu["gyro_id"] == rig.autopilot.parameter("INS_GYR_ID")
    query = sa.text("SELECT gyro_bias_rad_s FROM biases WHERE imu = :imu ORDER BY axis").bindparams(imu=imu["name"])
    assert [row[0] for row in rows_of(database, query)] == imu["gyro_bias_rad_s"]
    assert [tuple(row) for row in rows_of(database, sa.text("SELECT aircraft, name FROM fleet"))] == [(UID, "Heron 7")]
