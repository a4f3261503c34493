"""A telemetry port of 57600 baud, full of other things: slower, never wrong."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.config import parse
from companion.configured import models
from companion.daemon.job import Job
from companion.estimation.machine import What
from sim.imu_model import DEG_H, MG
from tests.support.rig import Rig

BAUD = 57600
OTHERS_BYTES = 60
OTHERS_HZ = 40.0
"""2400 of the 5760 bytes per second: the streams that a ground station has asked for on this port too."""

PROFILE = """
[mavlink]
url = "{url}"
[[imu]]
name = "fc"
source = "autopilot"
"""


@pytest.mark.parametrize(
    ("url", "least_hz", "most_hz"),
    [
        ("serial:/dev/ttyAMA0:57600", 25.0, 2880 / 75),
        ("serial:/dev/ttyAMA0:9600", 10.0, 10.0),
        ("serial:/dev/ttyAMA0:921600", 100.0, 100.0),
        ("udpin:0.0.0.0:14550", 100.0, 100.0),
    ],
)
def test_the_imu_rate_leaves_half_of_a_serial_line_free(url: str, least_hz: float, most_hz: float) -> None:
    assert least_hz <= models.imu_rate_hz(parse(PROFILE.format(url=url), "test.toml")) <= most_hz


@contextlib.asynccontextmanager
async def other_traffic(rig: Rig) -> AsyncIterator[None]:
    """Whatever else the autopilot has to say on this line."""
    text = mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_DEBUG, b"x" * 50)
    packet = text.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=100))
    assert abs(len(packet) - OTHERS_BYTES) < 10

    async def talk() -> None:
        while True:
            rig.wire.carry_from_other(bytes(packet))
            await asyncio.sleep(1.0 / OTHERS_HZ)

    task = asyncio.create_task(talk())
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def test_on_a_busy_57600_baud_line_a_calibration_is_right(tmp_path: Path) -> None:
    rig = Rig(
        tmp_path,
        firmware="px4",
        baud=BAUD,
        imus=1,
        part="bmi088",
        default_streams=False,
        parameters={"IMU_GYRO_CAL_EN": 0.0, "SENS_IMU_AUTOCAL": 0.0},
    )
    async with rig.running(), other_traffic(rig):
        await rig.ready()
        job = rig.service.calibrating.manager.start_calibration(What.BOTH, "test")
        assert isinstance(job, Job)
        result = await job.finished
        assert result.outcome == "done", result
        assert job.record is not None
        left, sigma = rig.autopilot.residual(1, rig.now_s), np.array(job.record.imus[0].gyro_sigma_use_rad_s)
        assert sigma.max() < 30 * DEG_H
        assert (np.abs(left.gyro_rad_s) < 3.0 * sigma).all()
        assert np.abs(left.accel_m_s2).max() < 0.5 * MG
        assert rig.wire.dropped < 50, "we asked for more than the line carries"
