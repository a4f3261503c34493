"""Views of flights, calibrations and armings against the sent items, in both databases."""

from __future__ import annotations

import datetime
import json
import math
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
import sqlalchemy as sa

from companion.estimation.records.flight_record import Drift, Flight, ImuFlight, KeptFlight, Split, Stages, Term
from companion.fleet import schema
from companion.fleet.schema import engine_of
from companion.fleet.store import Store
from companion.mqtt.client import Incoming
from sim.fleet.aircraft import Aircraft
from tests.support.collecting import NOW, rows_of
from tests.support.fleet import check
from tests.support.postgres import INITDB, postgres

pytestmark = pytest.mark.real_clock

DAY = datetime.timedelta(days=1)
RAD_S = math.pi / 180.0 / 3600.0
"""In a deg/h."""
MG = 9.80665e-3


def kept_flight(key: str, began_at: str, gyro_deg_h: float) -> KeptFlight:
    def axis(name: str, value: float, unit: float) -> Split:
        return Split(
            axis=name,
            in_flight=Term(value * unit, 0.5 * unit),
            ekf=None,
            turn_on=None,
            temperature=None,
            motors=Term(-2.0 * value * unit, 0.25 * unit),
            vibration=None,
            trend=None,
        )

    imu = ImuFlight(
        imu=1,
        rate_hz=100.0,
        calibration="2026-11-19T09:00:00.000Z",
        gyro_id=2490378,
        accel_id=2490634,
        set_gyro_rad_s=None,
        set_accel_m_s2=None,
        axes=(axis("gyro x", gyro_deg_h, RAD_S), axis("accel z", 1.5, MG)),
        drift={"flown": [Drift(10.0, 9, 0.3, 0.9), Drift(30.0, 7, 2.5, 6.0)], "before": [Drift(30.0, 7, 29.0, 41.0)]},
        notes=(),
    )
    stages = Stages(1.0, 2.0, 3.0, 60.0, 61.0)
    flight = Flight(
        key=key, system_id=1, began_at=began_at, stages=stages, reference="ekf", imus=(imu,), notes=("windy",)
    )
    return KeptFlight(log=f"{key}.bin", read_at="2026-11-20T12:00:00.000Z", flight=flight)


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def database(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    if request.param == "sqlite":
        yield str(tmp_path_factory.mktemp("views") / "fleet.sqlite")
    elif INITDB is None:
        pytest.skip("no PostgreSQL")
    else:
        with postgres() as server:
            yield server.create("fleet")


def one_with_all() -> Aircraft:
    one = Aircraft(1)
    one.calibrate(NOW - 2 * DAY)
    one.calibrate(NOW - DAY, "not still: gyro x 0.31 deg/s")
    one.undo(NOW)
    one.arm(NOW)
    one.calibrate(NOW)
    for key, deg_h in (("a", 11.0), ("b", 12.0), ("a", 13.0)):  # one of them was read twice
        one.tell("flight", NOW, kept_flight(key, "2026-11-20T09:30:00.000Z", deg_h))
    return one


ONE, OTHER = one_with_all(), Aircraft(2)
OTHER.calibrate(NOW)


@pytest.fixture(scope="module")
def told(database: str) -> str:
    """One aircraft with all, told again under another epoch; another one with a calibration."""
    store = Store(database)
    store.prepare()
    for one in (ONE, OTHER):
        for payload in one.told.values():
            check("item", payload)
            store.take([Incoming(f"fleet/{one.id}/item", payload)])
        store.take([Incoming(f"fleet/{one.id}/hello", one.hello)])
    for payload in ONE.told.values():
        item = msgspec.json.decode(payload) | {"epoch": "f" * 16}
        store.take([Incoming(f"fleet/{ONE.id}/item", msgspec.json.encode(item))])
    store.close()
    return database


def asked(database: str, query: str) -> list[dict[str, Any]]:
    return [dict(row._mapping) for row in rows_of(database, sa.text(query))]


def test_calibrations_and_armings_each_once(told: str) -> None:
    found = asked(told, f"SELECT * FROM calibration_history WHERE aircraft = '{ONE.id}' ORDER BY sequence")  # noqa: S608
    bodies = [json.loads(item) for item in ONE.told.values()]
    of_it = [(item["sequence"], item["body"]) for item in bodies if item["kind"] == "calibration"]
    assert [(row["sequence"], row["state"], row["reason"], row["name"]) for row in found] == [
        (sequence, body["state"], body["reason"], ONE.name) for sequence, body in of_it
    ]
    assert [row["undone_at"] is not None for row in found] == [True, False, False]
    (armed,) = asked(told, "SELECT * FROM arming_history")
    assert (armed["aircraft"], armed["name"], armed["clock"]) == (ONE.id, ONE.name, "good")
    assert len(asked(told, "SELECT * FROM calibration_history")) == 4


def test_flights_each_once(told: str) -> None:
    found = asked(told, "SELECT * FROM flight_history ORDER BY flight, triad")
    axes = [("accel", "z"), ("gyro", "x")]
    assert [(row["flight"], row["triad"], row["axis"]) for row in found] == [
        (key, *axis) for key in "ab" for axis in axes
    ]
    for row, value in zip(found, (None, 13.0, None, 12.0), strict=True):
        assert (row["aircraft"], row["instance"], row["gyro_id"], row["accel_id"]) == (ONE.id, 1, 2490378, 2490634)
        assert (row["drift_s"], row["drift_m"]) == (30.0, 2.5)
        assert str(row["began_at"]).startswith("2026-11-20 09:30:00")
        assert str(row["calibration_at"]).startswith("2026-11-19 09:00:00")
        assert row["turn_on_deg_h"] is row["turn_on_mg"] is None
        gyro = None if value is None else pytest.approx(value)
        accel = pytest.approx(1.5) if value is None else None
        assert (row["in_flight_deg_h"], row["in_flight_mg"]) == (gyro, accel)
        assert (row["motors_deg_h"], row["motors_mg"]) == (
            None if value is None else pytest.approx(-2.0 * value),
            pytest.approx(-3.0) if value is None else None,
        )
        sigma = row["in_flight_sigma_deg_h"] if value is not None else row["in_flight_sigma_mg"]
        assert sigma == pytest.approx(0.5)


def test_scatter_and_findings_in_the_units_of_people(told: str) -> None:
    engine = engine_of(told)
    part = {"aircraft": ONE.id, "imu": "fc1", "axis": "x", "model": "ICM-42688-P", "power_ups": 9}
    finding = {"aircraft": ONE.id, "kind": "scatter", "since": NOW, "power_ups": 4, "size": 4.0, "words": "replace it"}
    with engine.begin() as connection:
        for triad, unit in (("gyro", RAD_S), ("accel", MG)):
            figures = {"triad": triad, "turn_on": 3.0 * unit, "wander": 0.5 * unit}
            connection.execute(sa.insert(schema.parts).values(part | figures))
        connection.execute(sa.insert(schema.findings).values(finding | {"place": 0}))
    engine.dispose()
    accel, gyro = asked(told, "SELECT * FROM part_scatter ORDER BY triad")
    assert (gyro["name"], gyro["model"], gyro["power_ups"]) == (ONE.name, "ICM-42688-P", 9)
    names = ("turn_on_deg_h", "wander_deg_h", "turn_on_mg", "wander_mg")
    assert [gyro[name] for name in names] == [pytest.approx(3.0), pytest.approx(0.5), None, None]
    assert [accel[name] for name in names] == [None, None, pytest.approx(3.0), pytest.approx(0.5)]
    (found,) = asked(told, "SELECT * FROM sensor_findings")
    assert (found["name"], found["words"], found["place"]) == (ONE.name, "replace it", 0)
