"""`companion flight` on the log of a real ArduCopter whose gyros have moved since they were calibrated."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any

import pytest

from companion.storage.records import RecordStore
from sim.flying.flight import Flight, Plan, flying
from sim.imu_model import DEG_H, MG
from tests.sitl.test_flying import binary_of

pytestmark = pytest.mark.sitl
MOVED_DEG_H = (400.0, -300.0, 200.0)
LOGGING = {"LOG_DISARMED": 1.0, "LOG_BITMASK": float(176126 | 1 | 1 << 18)}
"""The usual, attitude and IMU at 400 Hz."""
STOOD_S = 35.0


async def flown(folder: Path) -> tuple[dict[str, Any], str, list[float]]:
    """The last flight of its log, when its calibration began, and what gyros x, y, z and accelerometer z truly have."""
    plan = Plan(binary_of("arducopter"), "none", "command", wind=(3.0, 90.0), watched_s=60.0)
    async with flying(plan, folder, time.time()) as flight:
        await flight.ground.put_all(LOGGING)
        await flight.set_up()
        await flight.calibrate()
        true = await moved(flight)
        await flight.vehicle.sleep(STOOD_S)
        await flight.fly()
        (log,) = flight.vehicle.folder.rglob("*2.BIN")  # the first is of before the set-up
        answer = await flight.ask("flight", str(log))
        (record, *_) = RecordStore(flight.folder / "state").history()
    return answer["flights"][-1], record.started_at, true


async def moved(flight: Flight) -> list[float]:
    """ArduPilot's simulated gyros read more as of now; what its offsets leave of that."""
    get = flight.ground.get
    for axis, more in zip("XYZ", MOVED_DEG_H, strict=True):
        name = f"SIM_GYR1_BIAS_{axis}"
        await flight.ground.put(name, await get(name) + more * DEG_H)
    left = [await get(f"SIM_GYR1_BIAS_{axis}") - await get(f"INS_GYROFFS_{axis}") for axis in "XYZ"]
    return [*left, await get("SIM_ACC1_BIAS_Z") - await get("INS_ACCOFFS_Z")]


def test_what_the_gyros_turned_on_with_is_found_in_the_log(tmp_path: Path) -> None:
    flight, calibrated_at, true = asyncio.run(flown(tmp_path))
    imu = flight["imus"][0]
    print(imu, true)
    assert imu["calibration"] == calibrated_at
    for axis, value in zip(imu["axes"], true, strict=True):
        for term in ("turn_on", "in_flight"):
            assert abs(axis[term]["value"] - value) < 3.0 * axis[term]["sigma"]
        assert axis["turn_on"]["sigma"] < (40.0 * DEG_H if axis["axis"].startswith("gyro") else 1.0 * MG)
    for name in ("flown", "before"):
        (at_30_s,) = (row for row in imu["drift"][name] if row["seconds"] == 30.0)
        # Some 500 deg/h of tilting, and as much of before: g w t^3 / 6.
        assert 40.0 < at_30_s["median_m"] < 250.0
        assert at_30_s["starts"] > 10
