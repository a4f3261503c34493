"""ArduPilot's own gyro calibration at a start, against ours: told, switched off when wanted, and no reboot into it."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from companion.daemon.job import Job
from companion.estimation.machine import What
from sim.ardupilot.parameters import offset_names
from tests.e2e.test_calibration import calibrated
from tests.support.rig import Rig

ON = {"INS_GYR_CAL": 1.0}
STOP = "[push]\nstop_rivals = true\n"


def quick(folder: Path, **options: Any) -> Rig:
    return Rig(folder, **({"min_still_s": 4.0, "max_s": 8.0, "feed_s": 0.2, "imu_rate_hz": 50.0, "imus": 1} | options))


def gyro(rig: Rig) -> list[float]:
    return [rig.double.parameter(name) for name in offset_names(1, "gyro")]


async def test_no_reboot_into_a_gyro_calibration_that_would_throw_the_offsets_away(tmp_path: Path) -> None:
    async with quick(tmp_path, parameters=ON).running() as rig:
        await rig.ready()
        result, record = await calibrated(rig, reboot=True)
        assert result.outcome == "done", result
        assert rig.service.core.vehicle.boots == 0
        assert any("reboot not completed: INS_GYR_CAL = 1 would measure the gyros anew" in w for w in record.warnings)
        assert any("push.stop_rivals = true" in warning for warning in record.imus[0].warnings)


async def test_with_the_rival_stopped_it_is_rebooted_and_the_offsets_are_confirmed(tmp_path: Path) -> None:
    async with quick(tmp_path, parameters=ON, more=STOP).running() as rig:
        await rig.ready()
        result, record = await calibrated(rig, reboot=True)
        assert result.outcome == "done", result
        assert "rebooted, offsets active" in record.reason
        assert rig.service.core.vehicle.boots == 1
        assert rig.double.parameter("INS_GYR_CAL") == 0
        written = record.imus[0].written
        assert [written[name].after for name in offset_names(1, "gyro")] == pytest.approx(gyro(rig))
        undo = rig.service.calibrating.manager.start_undo("test")
        assert isinstance(undo, Job)
        assert (await undo.finished).outcome == "done"
        assert rig.double.parameter("INS_GYR_CAL") == 1


async def test_a_reboot_is_not_sent_to_an_aircraft_that_armed_meanwhile(tmp_path: Path) -> None:
    async with quick(tmp_path).running() as rig:
        await rig.ready()
        job = rig.service.calibrating.manager.start_calibration(What.BOTH, "test", reboot=True)
        assert isinstance(job, Job), job
        await rig.until(lambda: "stored the new offsets" in job.words, 90.0)
        rig.double.arm()
        result = await job.finished
        assert result.outcome == "done", result
        assert job.record is not None
        # Nor does the double restart while it is armed: what counts is that it was not asked.
        assert any("reboot not completed: the aircraft is armed" in warning for warning in job.record.warnings)
        await asyncio.sleep(5.0)
        assert rig.service.core.vehicle.boots == 0
