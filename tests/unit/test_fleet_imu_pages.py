"""What a fleet knows of IMU models, and the pages that show it: against the figures that the parts were drawn with."""

from __future__ import annotations

import datetime
import json
import re
from pathlib import Path

import pytest

from companion.fleet import page
from companion.fleet.simulated import Aircraft
from companion.fleet.store import Message, Store
from tests.support.collecting import NOW


@pytest.fixture
def store(tmp_path: Path) -> Store:
    one = Store(str(tmp_path / "fleet.sqlite"))
    one.prepare()
    return one


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
    assert "From 13 power-ups on 11 days" in shown
    assert 'class="area sx"' in shown
    assert "fc9" not in shown
    dots = re.search(r"IMU fc1 by temperature, gyro x: bias by temperature</title><desc>(\d+) points", shown)
    assert dots is not None
    assert int(dots[1]) == sum("fc1" in found for found in one.biases.values())
    assert json.loads(one.told[1])["kind"] in ("calibration", "arming")
