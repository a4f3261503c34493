"""A real ArduPilot on a link that can be spoilt, with all its parameters remembered, for tests with the real daemon."""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.lua import ARMING_SCRIPT
from sim.companion_process import CompanionProcess, Record
from sim.imu_model import DEG_H, MG
from sim.sitl.ardupilot import ArduPilotSitl
from sim.sitl.daemon import LossyLink, Message, companion_daemon
from sim.sitl.ground import GroundStation
from sim.sitl.residuals import ground_station
from tests.sitl.craft import BINARIES, missing, world

QUICK = '\n[calibration]\nmin_still_s = 8\nmax_s = 12\nat_arm = "off"\n'
SETTLE_S = 25.0
"""After a start: it has its position, and the EKF does not object any more."""
CALIBRATED_WITHIN_S = 150.0
OUR_GYROS = tuple(f"INS_GYROFFS_{axis}" for axis in "XYZ")
OUR_ACCELS = tuple(f"INS_ACCOFFS_{axis}" for axis in "XYZ")
SECOND_GYROS = tuple(f"INS_GYR2OFFS_{axis}" for axis in "XYZ")
SECOND_ACCELS = tuple(f"INS_ACC2OFFS_{axis}" for axis in "XYZ")
OF_NO_CONCERN = ("STAT_", "BARO", "COMPASS_DEC", "SIM_", "MIS_TOTAL")
"""Counters of a firmware, and its measurements of air and field."""
GYRO_FAMILY = ("INS_GYR",)
GYRO_LIMIT_DEG_H = 15.0
BOOT_LIMIT_DEG_H = 80.0
"""Limit for the firmware's own calibration: two windows of a quarter second."""
ACCEL_LIMIT_MG = 0.2
"""The gradienter of these tests is 0.003 degrees off, 0.05 mg; 12 s of white noise are 0.015 mg."""


@dataclass
class ArduPilotBench:
    """A binary with a ground station, a link that can be spoilt, and what the firmware listed at the start."""

    vehicle: ArduPilotSitl
    ground: GroundStation
    link: LossyLink
    folder: Path
    before: dict[str, float] = field(default_factory=dict)

    @contextlib.asynccontextmanager
    async def daemon(self, more: str = QUICK) -> AsyncIterator[CompanionProcess]:
        async with companion_daemon(self.vehicle, self.folder, more=more, url=self.link.url) as daemon:
            yield daemon

    async def changed(self) -> dict[str, tuple[float, float]]:
        """Parameters that differ from the start: then, now."""
        now = await self.ground.whole_list()
        both = {name: (self.before.get(name, np.nan), now.get(name, np.nan)) for name in {*self.before, *now}}
        return {
            name: values
            for name, values in both.items()
            if values[0] != values[1] and not name.startswith(OF_NO_CONCERN)
        }

    def assert_right(
        self, parameters: Mapping[str, float], gyro_limit_deg_h: float = GYRO_LIMIT_DEG_H, *, instance: int = 1
    ) -> None:
        """The offsets of an IMU are its true bias."""
        bias = self.vehicle.true_bias(instance, self.vehicle.now_s)
        gyros, accels = (OUR_GYROS, OUR_ACCELS) if instance == 1 else (SECOND_GYROS, SECOND_ACCELS)
        gyro = (np.array([parameters[name] for name in gyros]) - bias.gyro_rad_s) / DEG_H
        accel = (np.array([parameters[name] for name in accels]) - bias.accel_m_s2) / MG
        assert np.abs(gyro).max() < gyro_limit_deg_h, gyro
        assert np.abs(accel).max() < ACCEL_LIMIT_MG, accel


@contextlib.asynccontextmanager
async def bench(tmp_path: Path, *, gyr_cal: bool = False, script: bool = False) -> AsyncIterator[ArduPilotBench]:
    reason = missing("ardupilot-sitl")
    if reason is not None:
        pytest.skip(reason)
    async with LossyLink() as link:
        vehicle = ArduPilotSitl(
            Path(os.environ[BINARIES["ardupilot-sitl"]]), world(), tmp_path / "ap", gyr_cal=gyr_cal, companion=link.near
        )
        if script:
            vehicle.scripts.mkdir(parents=True)
            (vehicle.scripts / ARMING_SCRIPT.name).write_bytes(ARMING_SCRIPT.read_bytes())
        async with vehicle, ground_station(vehicle) as ground:
            await ground.wait_for(lambda: bool(ground.vehicle_heartbeats()), 60.0, "a heartbeat")
            await asyncio.sleep(SETTLE_S)
            result = ArduPilotBench(vehicle, ground, link, tmp_path / "daemon")
            result.before = await ground.whole_list()
            yield result


def sets(*names: str) -> Callable[[Message], bool]:
    return lambda message: isinstance(message, mavlink.MAVLink_param_set_message) and message.param_id in names


def calibrates(message: Message) -> bool:
    return (
        isinstance(message, mavlink.MAVLink_command_long_message)
        and message.command == mavlink.MAV_CMD_PREFLIGHT_CALIBRATION
    )


def asks_for_ahrs(message: Message) -> bool:
    """Requests for the messages that show the EKF settling."""
    ahrs: int = mavlink.MAVLINK_MSG_ID_AHRS
    return (
        isinstance(message, mavlink.MAVLink_command_long_message)
        and message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
        and message.param1 == ahrs
        and message.param2 > 0
    )


async def until_status(daemon: CompanionProcess, condition: Callable[[Record], bool], within_s: float = 60.0) -> Record:
    loop = asyncio.get_running_loop()
    deadline_s = loop.time() + within_s
    while True:
        status = await daemon.status()
        if status is not None and condition(status):
            return status
        assert loop.time() < deadline_s, (status, daemon.log())
        await asyncio.sleep(0.3)


async def until_quiet(daemon: CompanionProcess) -> None:
    """Nothing runs, nothing waits to be put back."""
    await until_status(
        daemon,
        lambda s: s["state"] in ("idle", "done", "failed", "cancelled") and not s["putting_back"]
        and s["vehicle"]["armed"] == "disarmed",
    )  # fmt: skip


def written(record: Record) -> dict[str, float]:
    """Parameters that the record says have new values."""
    return {
        name: entry["after"]
        for imu in record["imus"]
        for name, entry in imu["written"].items()
        if entry["outcome"] in ("verified", "stored")
    }


def assert_as_recorded(
    record: Record, changed: Mapping[str, tuple[float, float]], allowed: tuple[str, ...] = ()
) -> None:
    """Check that the changes are those in the record's list or warnings."""
    said = written(record)
    for name, (_, now) in changed.items():
        if name.startswith(allowed) and any("INS_GYR_CAL" in warning for warning in imu_warnings(record)):
            continue  # the record says that a boot overwrites it
        if name in said:
            assert now == pytest.approx(said[name], rel=1e-6, abs=1e-9), (name, record)
        else:
            named = any(name in warning for warning in (*record["warnings"], *imu_warnings(record)))
            assert named or name.startswith(allowed), (name, changed, record)
    for name, value in said.items():
        assert name in changed or value == pytest.approx(0.0, abs=1e-9), (name, record)


def imu_warnings(record: Record) -> list[str]:
    return [warning for imu in record["imus"] for warning in imu["warnings"]]


async def calibrated(daemon: CompanionProcess, within_s: float = CALIBRATED_WITHIN_S) -> Record:
    record = await daemon.calibrate(within_s)
    assert "imus" in record, record
    return record
