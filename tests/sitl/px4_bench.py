"""A real PX4 with all its parameters remembered, for tests with the real daemon."""

from __future__ import annotations

import contextlib
import os
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from sim.companion_process import CompanionProcess
from sim.scenario import DEMO_POSE, demo
from sim.sitl.ground import GroundStation
from sim.sitl.px4 import Px4Sitl
from sim.sitl.residuals import CALIBRATE_WITHIN_S, ground_station
from tests.sitl.craft import BINARIES, missing

ITS_OWN = frozenset(
    {"_HASH_CHECK", "LND_FLIGHT_T_HI", "LND_FLIGHT_T_LO", "COM_FLIGHT_UUID", "SDLOG_MODE", "SDLOG_BACKEND"}
    | {f"CAL_GYRO{slot}_PRIO" for slot in range(4)}
    | {f"CAL_BARO{slot}_OFF" for slot in range(4)}
)
"""Parameters that PX4 itself may change; its start scripts reset those of the log to their defaults.

A slot's priority is -1, which means 50, until PX4's background calibration saves the slot: it then writes the 50. The
barometer's offset is calibrated by GNSS after a start (SENS_BARO_AUTOCAL).
"""
GYRO_DEG_H = (500.0, -700.0, 1000.0)
"""Case D: integers tell it."""
ACCEL_MG = (1.0, -2.0, 3.0)
QUICK = "\n[calibration]\nmin_still_s = 20\nmax_s = 40\n"
SAVED_S = 4.0


@contextlib.asynccontextmanager
async def flying(
    folder: Path, *, gyro_deg_h: tuple[float, float, float] = GYRO_DEG_H
) -> AsyncIterator[tuple[Px4Sitl, GroundStation]]:
    """PX4 as it comes, its own background calibration on."""
    reason = missing("px4-sitl")
    if reason is not None:
        pytest.skip(reason)
    scenario = demo(pose=DEMO_POSE, part="white_only", gyro_deg_h=gyro_deg_h, accel_mg=ACCEL_MG, seed=1)
    vehicle = Px4Sitl(Path(os.environ[BINARIES["px4-sitl"]]), scenario, folder)
    async with vehicle, ground_station(vehicle) as ground:
        await ground.wait_for(lambda: bool(ground.vehicle_heartbeats()), 60.0, "a heartbeat")
        await vehicle.sleep(30.0)
        yield vehicle, ground


async def calibrate(daemon: CompanionProcess) -> dict[str, float]:
    """Calibrate successfully; return the written values, by parameter."""
    record = await daemon.calibrate(CALIBRATE_WITHIN_S)
    assert record["state"] == "done", (record["reason"], daemon.log())
    return {name: one["after"] for imu in record["imus"] for name, one in imu["written"].items()}


def changed(one: dict[str, float], other: dict[str, float]) -> set[str]:
    """Names of other values; PX4 lists what somebody aboard has used since the boot, so each boot lists others."""
    both = one.keys() & other.keys()
    assert len(both) > 800
    return {name for name in both if one[name] != other[name]} - ITS_OWN
