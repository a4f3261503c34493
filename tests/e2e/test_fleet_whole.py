"""From simulated devices to the fleet's database: daemon, collector and a Mosquitto with its access list."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from tests.e2e.test_commands import DONE, companion, flight_line
from tests.e2e.test_fleet_access import start
from tests.support.collecting import CollectorProcess, items_in, rows_of
from tests.support.fleet import check
from tests.support.mqtt_daemon import mosquitto_only

LIMIT_S = 900.0
"""Twenty processes start one after another: 40 s, and minutes on a busy machine."""
UID = b"virtual 0025".ljust(18, b"\0").hex()
"""Of the flight line's autopilot."""


async def until(what: Callable[[], bool]) -> None:
    while not what():
        await asyncio.sleep(0.2)


@contextlib.asynccontextmanager
async def another_daemon(config: Path) -> AsyncIterator[None]:
    """In the place of one that was killed."""
    daemon = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "companion", "run", "--config", str(config), stderr=asyncio.subprocess.DEVNULL
    )
    try:
        yield
    finally:
        daemon.kill()
        await daemon.wait()


async def until_done(config: Path, *words: str) -> None:
    """Asked for again until it was done: on a busy machine the aircraft may not answer in time."""
    while (await companion("-c", str(config), *words, "--json", within_s=LIMIT_S)).code != DONE:
        await asyncio.sleep(1.0)


async def history(config: Path) -> list[Any]:
    """The records that the aircraft has, the first one first."""
    said = await companion("-c", str(config), "history", "--json")
    assert said.code == DONE, said.err
    return sorted(said.json["records"], key=lambda record: str(record["started_at"]))


@pytest.mark.timeout(LIMIT_S)
@mosquitto_only
def test_what_happens_on_the_aircraft_is_in_the_database_whatever_is_killed(tmp_path: Path) -> None:
    database = str(tmp_path / "collected.sqlite")
    one = start(tmp_path, [f"heron={UID}"], ("heron", "collector"))

    def done() -> list[str]:
        """What was told of calibrations that were done, and of undos."""
        told = [json.loads(item[3]) for item in items_in(database)]
        return [item["kind"] for item in told if item["body"].get("state") in (None, "done")]

    def collector(name: str) -> CollectorProcess:
        return CollectorProcess(tmp_path, name, one, database, "--page", "off", username="collector")

    async def main() -> None:
        await one.start()
        collecting = collector("first")
        aircraft = tmp_path / "aircraft"
        aircraft.mkdir()
        section = one.section(username="heron", base_topic="companion/heron")
        try:
            await collecting.at_work()
            async with flight_line(aircraft, more=f'{section}[fleet]\nname = "Heron"\nlocation = "full"\n') as line:
                await until_done(line.config, "calibrate", "--wait")
                await until(lambda: done() == ["calibration"])
                assert line.daemon is not None
                line.daemon.kill()
                await line.daemon.wait()
                async with another_daemon(line.config):
                    # Told by nobody but the disk: put back with the broker away, and then the power fails.
                    one.kill()
                    collecting.kill()
                    await until_done(line.config, "undo")
                async with another_daemon(line.config):
                    await one.start()  # it keeps nothing
                    await until_done(line.config, "calibrate", "--wait")
                    collecting = collector("second")
                    await until(lambda: done() == ["calibration", "undo", "calibration"])
                    records = await history(line.config)
            assert collecting.stop() == DONE
        finally:
            collecting.kill()
            one.kill()
        told = [check("item", item[3].encode()) for item in items_in(database)]
        assert [item["sequence"] for item in told] == list(range(1, len(told) + 1))
        assert {item["aircraft"] for item in told} == {UID}
        # Each as the aircraft has it, but for what was put back after it was told.
        calibrations = [item["body"] for item in told if item["kind"] == "calibration"]
        assert calibrations == [record | {"undone_at": None} for record in records]
        (undo,) = (item["body"] for item in told if item["kind"] == "undo")
        assert [undo["of"]] == [record["started_at"] for record in records if record["undone_at"] is not None]
        query = sa.text("SELECT gyro_bias_rad_s FROM biases WHERE sequence = :last AND imu = 'fc' ORDER BY axis")
        (imu,) = (imu for imu in calibrations[-1]["imus"] if imu["name"] == "fc")
        found = rows_of(database, query.bindparams(last=told[-1]["sequence"]))
        assert [row[0] for row in found] == imu["gyro_bias_rad_s"]
        assert [row[0] for row in rows_of(database, sa.text("SELECT name FROM fleet"))] == ["Heron"]

    asyncio.run(main())
