"""`companion log flight` on the logs of real firmware whose gyros are off by a known amount."""

from __future__ import annotations

import asyncio
import contextlib
import time
from pathlib import Path
from typing import Any

import pytest

from companion.storage.records import RecordStore
from sim.flying.flight import Flight, Plan, flying
from sim.imu_model import DEG_H, MG
from tests.sitl.test_flying import binary_of

pytestmark = pytest.mark.sitl
OFFSETS = {
    "ardupilot": tuple(f"INS_{kind}OFFS_{axis}" for kind in ("GYR", "ACC") for axis in "XYZ"),
    "px4": tuple(f"CAL_{kind}0_{axis}OFF" for kind in ("GYRO", "ACC") for axis in "XYZ"),
}
"""Offsets of the first IMU."""
BIASES = tuple(f"SIM_{kind}1_BIAS_{axis}" for kind in ("GYR", "ACC") for axis in "XYZ")
"""Errors of ArduPilot's simulated first IMU. PX4's has none: there, an offset that is too small stands for an error."""
JUDGED = (0, 1, 2, 5)
"""Axes that `companion log flight` judges: gyros, vertical accelerometer."""
MOVED_DEG_H = (400.0, -300.0, 200.0)
MOVED_MG = 5.0
"""Step of the vertical accelerometer; PX4 ignores offsets that differ by less than 1 mg."""
LOGGING = {
    "arducopter": {"LOG_DISARMED": 1.0, "LOG_BITMASK": float(176126 | 1 | 1 << 18)},  # attitude and IMU at 400 Hz
    "px4": {"SDLOG_BACKEND": 1.0, "SDLOG_MODE": 1.0},
}
STOOD_S = 35.0
LARGEST_SIGMA = {"arducopter": (40.0 * DEG_H, 1.0 * MG), "px4": (60.0 * DEG_H, 1.0 * MG)}
"""Largest sigma of gyros and accelerometer at rest: a larger one would let every error pass."""


async def flown(craft: str, folder: Path) -> tuple[dict[str, Any], str, list[float]]:
    """The last flight of its log, when its calibration began, and what gyros x, y, z and accelerometer z truly have."""
    plan = Plan(binary_of(craft), "none", "px4" if craft == "px4" else "command", wind=(3.0, 90.0), watched_s=60.0)
    async with flying(plan, folder, time.time()) as flight:
        await flight.ground.put_all(LOGGING[craft])
        await flight.set_up()
        await flight.calibrate()
        before = {name: await flight.ground.get(name) for name in OFFSETS[flight.vehicle.firmware]}
        await move(flight, before)
        await flight.vehicle.sleep(STOOD_S)
        await flight.fly()
        *_, log = sorted(flight.vehicle.folder.rglob("*.ulg" if craft == "px4" else "*.BIN"))
        answer = await flight.daemon.ask("log", "flight", str(log))
        (record, *_) = RecordStore(flight.folder / "state").history()
    found = answer["flights"][-1]
    return found, record.started_at, (px4_true_error(log) if craft == "px4" else ardupilot_true_error(log))


def px4_true_error(log: Path) -> list[float]:
    """Error of PX4's readings, from the offsets that the log begins with (read by pyulog)."""
    from pyulog import ULog

    initial = ULog(str(log), ["vehicle_imu_status"]).initial_parameters
    return [-float(initial[OFFSETS["px4"][k]]) for k in JUDGED]


def ardupilot_true_error(log: Path) -> list[float]:
    """Error of ArduPilot's readings, from the last parameters in the log (read by pymavlink): bias less offset."""
    from pymavlink.DFReader import DFReader_binary

    reader: Any = DFReader_binary(str(log))  # type: ignore[no-untyped-call]
    told = dict[str, float]()
    with contextlib.closing(reader):
        while (message := reader.recv_match(type=["PARM"])) is not None:
            told[message.Name] = message.Value
    return [told[BIASES[k]] - told[OFFSETS["ardupilot"][k]] for k in JUDGED]


async def move(flight: Flight, offsets: dict[str, float]) -> None:
    """ArduPilot's simulated gyros read more as of now; PX4's have no errors, so their offsets become less by that."""
    ground = flight.ground
    if flight.vehicle.firmware == "ardupilot":
        names = BIASES[:3]
        values = [await ground.get(name) for name in names]
        await ground.put_all({n: v + d * DEG_H for n, v, d in zip(names, values, MOVED_DEG_H, strict=True)})
        return
    less = [each * DEG_H for each in MOVED_DEG_H] + [0.0, 0.0, MOVED_MG * MG]
    await ground.put_all({n: v - d for (n, v), d in zip(offsets.items(), less, strict=True)})
    await flight.vehicle.sleep(3.0)  # until it has stored them
    await flight.vehicle.power_cycle()  # small ones are taken at its start only


@pytest.mark.parametrize("craft", ["arducopter", "px4"])
def test_what_the_gyros_turned_on_with_is_found_in_the_log(tmp_path: Path, craft: str) -> None:
    flight, calibrated_at, true = asyncio.run(flown(craft, tmp_path))
    imu = flight["imus"][0]
    print(imu, true)
    # In these flights PX4's offsets are not ours.
    assert imu["calibration"] == (calibrated_at if craft == "arducopter" else None)
    for axis, value in zip(imu["axes"], true, strict=True):
        for term in ("turn_on", "in_flight"):
            assert abs(axis[term]["value"] - value) < 3.0 * axis[term]["sigma"]
        assert axis["turn_on"]["sigma"] < LARGEST_SIGMA[craft][0 if axis["axis"].startswith("gyro") else 1]
    drift = {name: next(row for row in rows if row["seconds"] == 30.0) for name, rows in imu["drift"].items()}
    # Some 500 deg/h of tilting: g w t^3 / 6; PX4 has 5 mg besides.
    assert 40.0 < drift["flown"]["median_m"] < 250.0
    assert drift["flown"]["starts"] > 10
    if craft == "arducopter":
        # Its sensor has moved, and not its offsets; those of before were off by as much.
        assert 40.0 < drift["before"]["median_m"] < 250.0
