"""Findings about sensors: injected faults, and none where there are none."""

from __future__ import annotations

import datetime
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa

from companion.fleet import page
from companion.fleet.judgement import judge_zero
from companion.fleet.store import Store
from companion.mqtt.client import Incoming
from companion.physics.units import DEG_H
from sim.fleet.aircraft import Aircraft
from tests import judgement_study as study
from tests.support.collecting import NOW, rows_of

MOVED = 80.0
"""deg/h, 16 of the simulated scatters."""


def flown(one: Aircraft, flights: int, days: float, until: float = 0.0) -> None:
    """A calibration each, evenly within the days before `until` days ago."""
    for k in range(flights):
        one.calibrate(NOW - datetime.timedelta(days=until + days * (flights - k) / flights))


def faulty(number: int = 1, after: int = 30) -> Aircraft:
    one = Aircraft(number)
    flown(one, 30, 60.0, 40.0)
    one.moved_rad_s = MOVED * DEG_H
    flown(one, after, 40.0)
    return one


def messages_of(one: Aircraft) -> list[Incoming]:
    return [Incoming(f"fleet/{one.id}/item", payload) for payload in one.told.values()]


def changed(one: Aircraft, sequence: int, **news: Any) -> None:
    """The body of an item with other values."""
    item = json.loads(one.told[sequence])
    item["body"] |= news
    one.told[sequence] = json.dumps(item, separators=(",", ":")).encode()


def judged(store: Store, database: str, messages: Sequence[Incoming]) -> list[Any]:
    store.take(messages)
    while store.judge():
        pass
    return list(rows_of(database, sa.text("SELECT * FROM findings ORDER BY aircraft, place")))


# --- the study, a small one


def test_false_alarms_are_rarer_than_one_a_hundred_aircraft_and_month() -> None:
    found = study.false_alarms(aircraft=20, years=1.0, seed=4)
    assert found.months == 240.0
    assert sum(found.by_kind.values()) <= 2


@pytest.mark.parametrize(("fault", "within"), [*zip(study.FAULTS, (20, 45, 60, 20), strict=True)])
def test_faults_are_found(fault: str, within: int) -> None:
    found = study.delays(fault, parts=24, since=60, seed=3)
    assert np.quantile(found, 0.75, method="higher") <= within
    assert found.min() >= 2.0


def test_a_compass_that_got_iron_is_found() -> None:
    assert np.median(study.delays("compass got iron", parts=16, since=60, seed=3)) <= 15.0


def test_a_zero_counts_once_it_has_moved_beyond_its_sigmas() -> None:
    offsets = np.array([[0.10, 0.0], [0.12, 0.03], [0.11, 0.62]])
    sigmas = np.full(3, 0.02)
    assert judge_zero(offsets[:2], sigmas[:2]) == []
    (found,) = judge_zero(offsets, sigmas)
    assert "moved by 0.59 deg" in found.words
    assert judge_zero(offsets, np.full(3, 0.2)) == []


# --- from items to findings


def test_a_fleet_without_faults_has_nothing_said_of_it(store: Store, database: str) -> None:
    for number in range(6):
        one = Aircraft(number)
        flown(one, 60, 100.0)
        assert judged(store, database, messages_of(one)) == []
    with store._reads.begin() as connection:
        assert " IMU " not in (page.glance(connection, NOW) or "")


def test_disorder_repetition_and_wrong_clocks_change_nothing(store: Store, database: str, tmp_path: Path) -> None:
    one = faulty()
    expected = judged(store, database, messages_of(one))
    for sequence in (5, 40, 50):
        started_at = (NOW - datetime.timedelta(days=400 + sequence)).isoformat()
        changed(one, sequence, started_at=started_at)
    messages = messages_of(one)
    another = str(tmp_path / "another.sqlite")
    other = Store(another)
    other.prepare()
    for start in (40, 0, 20, 40):
        found = judged(other, another, messages[start : start + 20][::-1])
    one.epoch = "0" * 16
    again = [
        each._replace(payload=each.payload.replace(b'"epoch":"', b'"epoch":"' + b"0" * 16 + b'","x":"'))
        for each in messages
    ]
    found = judged(other, another, again)
    other.close()
    assert [row[:5] + row[6:] for row in found] == [row[:5] + row[6:] for row in expected]


def test_absurd_figures_keep_nobody_from_being_judged(
    store: Store, database: str, caplog: pytest.LogCaptureFixture
) -> None:
    one = faulty()
    for sequence, degc, duration_s in ((2, 1e12, 0.0), (3, -1e12, -3.0), (12, 1e-300, 1e12)):
        imus = json.loads(one.told[sequence])["body"]["imus"]
        for imu in imus:
            imu |= {"temperature_degc": degc, "samples": 0, "gyro_sigma_use_rad_s": [0.0, -1.0, 1e12]}
        changed(one, sequence, imus=imus, duration_s=duration_s)
    (found,) = judged(store, database, messages_of(one))
    assert found.kind == "bias"
    assert "cannot be judged" not in caplog.text


def test_the_reading_counts_and_not_what_earlier_ones_made_of_it(store: Store, database: str) -> None:
    one = faulty()
    for sequence in [sequence for sequence in one.told if sequence > 30]:
        imus = json.loads(one.told[sequence])["body"]["imus"]
        read = imus[1]["gyro_bias_rad_s"]
        imus[1]["prior"] = {"gyro": {"used": True, "measured_rad_s": read}, "accel": None}
        imus[1]["gyro_bias_rad_s"] = [read[0] - MOVED * DEG_H, *read[1:]]
        changed(one, sequence, imus=imus)
    (found,) = judged(store, database, messages_of(one))
    assert found.kind == "bias"


def test_another_part_is_another_history(store: Store, database: str) -> None:
    one = faulty()
    for sequence in [sequence for sequence in one.told if sequence > 30]:
        imus = json.loads(one.told[sequence])["body"]["imus"]
        imus[1] |= {"gyro_id": 2490890, "accel_id": 2491146}
        changed(one, sequence, imus=imus)
    assert judged(store, database, messages_of(one)) == []
    (power_ups,) = {row[0] for row in rows_of(database, sa.text("SELECT power_ups FROM parts WHERE imu = 'fc2'"))}
    assert power_ups == 30


def test_accelerometers_that_move_together_tell_of_the_gradienter(store: Store, database: str) -> None:
    one = Aircraft(1)
    flown(one, 60, 100.0)
    for sequence in range(31, 61):
        imus = json.loads(one.told[sequence])["body"]["imus"]
        for imu in imus:
            imu["accel_bias_m_s2"][0] += 0.05
        changed(one, sequence, imus=imus)
    (found,) = judged(store, database, messages_of(one))
    assert (found.kind, found.imu) == ("zero", None)
    # asin(0.05 / 9.80665) is 0.292 deg.
    assert "the gradienter's zero, by 0.29 deg" in found.words


def test_what_comes_during_a_judgement_is_judged_again(
    store: Store, database: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = faulty()
    messages = messages_of(one)
    store.take(messages[:31])
    real = Store._judged

    def meanwhile(self: Store, connection: sa.Connection, aircraft: str) -> Any:
        found = real(self, connection, aircraft)
        monkeypatch.setattr(Store, "_judged", real)
        self.take(messages[31:])
        return found

    monkeypatch.setattr(Store, "_judged", meanwhile)
    assert store.judge()
    assert rows_of(database, sa.text("SELECT * FROM parts")) == []
    assert store.judge()
    assert not store.judge()
    assert len(rows_of(database, sa.text("SELECT * FROM findings"))) == 1
