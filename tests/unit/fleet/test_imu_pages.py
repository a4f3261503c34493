"""The pages of IMU models and of one IMU's biases, against the figures that the parts were drawn with."""

from __future__ import annotations

import datetime
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa

from companion.fleet import page, schema
from companion.fleet.imu_pages import model_page
from companion.fleet.judgement import parts_of
from companion.fleet.sequential import LEAST_PARTS, Typical, typical_part
from companion.fleet.store import Message, Store
from companion.physics.units import DEG_H, MG
from sim.fleet.aircraft import Aircraft
from tests.support.collecting import NOW

MODEL = "icm42688p"
TRUE = np.array([30.0 * DEG_H] * 3 + [0.3 * MG] * 3)
DIFFER = 0.2
PER_K = np.array([10.0 * DEG_H] * 3 + [0.02 * MG] * 3)
SPREAD = np.array([6.0 * DEG_H] * 3 + [0.01 * MG] * 3)


def rows(number: int, model: str | None = MODEL, seed: int = 1, times: float = 1.0) -> list[dict[str, Any]]:
    """Of one aircraft with one part."""
    dice = np.random.default_rng((seed, number))
    scatter = TRUE * np.exp(dice.normal(0.0, DIFFER, 6)) * times
    slope = dice.normal(PER_K, SPREAD)
    return [
        {
            "aircraft": f"{number:036x}",
            "imu": "fc",
            "triad": ("gyro", "accel")[k // 3],
            "axis": "xyz"[k % 3],
            "model": model,
            "power_ups": 20,
            "turn_on": float(scatter[k]),
            "wander": None,
            "per_k": float(slope[k]),
        }
        for k in range(6)
    ]


@pytest.fixture
def store(tmp_path: Path) -> Store:
    one = Store(str(tmp_path / "fleet.sqlite"))
    one.prepare()
    return one


def fill(store: Store, parts: list[list[dict[str, Any]]]) -> None:
    with store._engine.begin() as connection:
        connection.execute(sa.insert(schema.parts), [row for part in parts for row in part])
        for part in parts:
            name = {"aircraft": part[0]["aircraft"], "name": f"Heron {int(part[0]['aircraft'], 16)}"}
            connection.execute(sa.insert(schema.aircraft).values(name))


def typical_of(store: Store, model: str = MODEL) -> Typical | None:
    with store._engine.begin() as connection:
        return typical_part(list(parts_of(connection, model).values()))


def test_the_typical_part_has_the_figures_that_the_parts_were_drawn_with(store: Store) -> None:
    others = [rows(400 + k, "bmi088") for k in range(4)] + [rows(500, None)]
    liars = [rows(300, times=1e3), rows(301, times=0.0)]
    fill(store, [*[rows(k) for k in range(200)], *others, *liars])
    found = typical_of(store)
    assert found is not None
    assert found.turn_on == pytest.approx(TRUE, rel=0.1)
    assert found.turn_on_spread == pytest.approx(DIFFER * TRUE, rel=0.35)
    assert found.per_k[:3] == pytest.approx(PER_K[:3], rel=0.2)
    assert found.per_k_spread[:3] == pytest.approx(SPREAD[:3], rel=0.25)


def test_few_parts_have_no_typical_one(store: Store) -> None:
    fill(store, [rows(k) for k in range(LEAST_PARTS - 1)])
    assert typical_of(store) is None
    with store._engine.begin() as connection:
        shown = model_page(connection, MODEL, NOW, "of a test")
    assert "Too few parts with a known scatter" in (shown or "")


def test_what_is_not_known_of_an_axis_is_left_out(store: Store) -> None:
    parts = [rows(k) for k in range(8)]
    for part in parts:
        part[5]["turn_on"] = part[0]["per_k"] = None
    fill(store, parts)
    with store._engine.begin() as connection:
        shown = model_page(connection, MODEL, NOW, "of a test")
    assert shown is not None
    labels = re.findall(r">([xyz], (?:deg/h|mg): typically)", shown)
    assert labels == [f"{axis}, deg/h: typically" for axis in "xyz"] + [f"{axis}, mg: typically" for axis in "xy"]
    assert "deg/h a kelvin" not in shown
    assert "mg a kelvin" in shown


def test_the_models_page_has_a_dot_for_each_part_and_names_who_is_outside(store: Store) -> None:
    fill(store, [*[rows(k) for k in range(30)], rows(77, times=4.0)])
    with store._engine.begin() as connection:
        shown = model_page(connection, MODEL, NOW, "of a test")
        assert model_page(connection, "bmi088", NOW, "of a test") is None
        links = page.glance(connection, NOW) or ""
    assert shown is not None
    assert f'href="/model/{MODEL}"' in links
    dots = [len(re.findall("h.01", path)) for path in re.findall(r'd="([^"]*)" class="dot sx"', shown)]
    assert dots == [31, 31]
    assert "31 parts, 620 power-ups" in shown
    outside = re.findall(r'<a href="/aircraft/(\w+)">Heron (\d+)</a><small>IMU fc</small>', shown)
    assert (f"{77:036x}", "77") in outside
    # Of the others hardly one in a thousand is that far off by chance.
    assert sum(number != "77" for _, number in outside) <= 6


def test_an_aircrafts_page_shows_its_curve_with_sigma(store: Store) -> None:
    one = Aircraft(1)
    one.live(NOW, 12)
    curve = [{"degc": 10.0 + k, "gyro_deg_h": [1.0 + k, 2.0, 3.0], "sigma_deg_h": [5.0, 5.0, 5.0]} for k in range(20)]
    body = {"imu": "fc1", "power_ups": 12, "days": 11, "curve": curve, "accel_curve": []}
    for imu in ("fc1", "fc9"):
        one.tell("curve", NOW, {**body, "imu": imu})
    one.tell("curve", NOW + datetime.timedelta(days=1), {**body, "power_ups": 13})
    one.tell("curve", NOW, {"imu": ["no curve"]})
    store.take([Message(f"fleet/{one.id}/item", payload) for payload in one.told.values()])
    with store._engine.begin() as connection:
        shown = page.aircraft(connection, one.id, NOW)
    assert shown is not None
    assert "IMU fc1 by temperature" in shown
    assert f"The curve of 13 power-ups, as told {NOW + datetime.timedelta(days=1):%Y-%m-%d}." in shown
    assert 'class="area sx"' in shown
    assert "fc9" not in shown
    dots = re.search(r"IMU fc1 by temperature, gyro x: bias by temperature</title><desc>(\d+) points", shown)
    assert dots is not None
    assert int(dots[1]) == sum("fc1" in found for found in one.biases.values())
    assert json.loads(one.told[1])["kind"] in ("calibration", "arming")
