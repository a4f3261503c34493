"""The fleet's fault table (`python -m tests.campaign --fleet`), a cell a test, and whether its judge can see."""

from __future__ import annotations

import datetime
import itertools
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa

from companion.fleet.schema import engine_of
from companion.fleet.store import Store
from companion.mqtt.client import Incoming
from sim.fleet.aircraft import Aircraft
from tests.campaign.__main__ import SEED
from tests.campaign.fleet import FAULTS, KINDS, NO_MOUNTS, Kind, judge, play
from tests.support.broker import MOSQUITTO
from tests.support.collecting import NOW
from tests.support.extent import extent
from tests.support.namespaces import run_again_with_mounts
from tests.support.postgres import INITDB, Postgres, postgres

ALL = [cell for cell in itertools.product(FAULTS, KINDS) if cell != ("database killed", "sqlite")]
SLICE = [("collector killed", "postgresql"), ("database killed", "postgresql"), ("disk full", "sqlite")]
"""`python -m tests.campaign --fleet` and `make long` play all."""


@pytest.fixture(scope="module")
def server() -> Iterator[Postgres]:
    if INITDB is None:
        pytest.skip("no PostgreSQL")
    with postgres() as one:
        yield one


@pytest.mark.real_clock
@pytest.mark.skipif(MOSQUITTO is None, reason="no Mosquitto")
@pytest.mark.parametrize(("fault", "kind"), extent(whole=ALL, a_slice=SLICE))
def test_nothing_is_lost_and_nothing_is_there_twice(
    tmp_path: Path, request: pytest.FixtureRequest, fault: str, kind: Kind
) -> None:
    one: Postgres | None = request.getfixturevalue("server") if kind == "postgresql" else None
    for seed in range(SEED, SEED + extent(whole=5, a_slice=1)):
        folder = tmp_path / str(seed)
        folder.mkdir()
        why = play(fault, kind, seed, folder, one)
        if why == NO_MOUNTS and kind == "sqlite":
            run_again_with_mounts(request.node)
            return
        if why:
            pytest.skip(why)


@pytest.mark.parametrize(
    "wrong",
    [
        "DELETE FROM items WHERE sequence = 2",
        "DELETE FROM biases WHERE sequence = 1 AND axis = 'z' AND imu = 'fc2'",
        "UPDATE biases SET gyro_bias_rad_s = gyro_bias_rad_s + 1e-9 WHERE sequence = 1 AND axis = 'x' AND imu = 'fc1'",
        "INSERT INTO undos SELECT aircraft, epoch, 99, 'calibration', armed_at, armed_at FROM armings LIMIT 1",
        "UPDATE calibrations SET state = 'failed' WHERE sequence = (SELECT MAX(sequence) FROM calibrations)",
        "UPDATE items SET payload = replace(payload, 'good', 'best') WHERE sequence = 3",
    ],
)
def test_the_judge_sees_what_is_lost_twice_or_wrong(tmp_path: Path, wrong: str) -> None:
    one = Aircraft(1)
    for hours in range(3):
        one.calibrate(NOW + datetime.timedelta(hours=hours))
        one.arm(NOW + datetime.timedelta(hours=hours))
    database = str(tmp_path / "fleet.sqlite")
    store = Store(database)
    store.prepare()
    store.take([Incoming(f"fleet/{one.id}/item", payload) for payload in one.told.values()])
    store.take([Incoming(f"fleet/{one.id}/hello", one.hello)])
    store.close()
    judge(database, [one])
    engine = engine_of(database)
    with engine.begin() as connection:
        connection.execute(sa.text(wrong))
    engine.dispose()
    with pytest.raises(AssertionError):
        judge(database, [one])
