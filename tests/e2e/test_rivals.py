"""ArduPilot's own gyro calibration at a start, against ours: told, switched off when wanted, and no reboot into it."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from companion.daemon.job import Job
from companion.estimation.request import What
from sim.ardupilot.double import offset_names
from tests.e2e.test_calibration import calibrated
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

ON = {"INS_GYR_CAL": 1.0}
STOP = "[push]\nstop_rivals = true\n"


def quick(folder: Path, **options: Any) -> Rig:
    return Rig(folder, **({"min_still_s": 4.0, "max_s": 8.0, "feed_s": 0.2, "imu_rate_hz": 50.0, "imus": 1} | options))


def gyro(rig: Rig) -> list[float]:
    return [rig.double.parameter(name) for name in offset_names(1, "gyro")]


def test_no_reboot_into_a_gyro_calibration_that_would_throw_the_offsets_away(tmp_path: Path) -> None:
    async def main() -> None:
        async with quick(tmp_path, parameters=ON).running() as rig:
            await rig.ready()
            result, record = await calibrated(rig, reboot=True)
            assert result.outcome == "done", result
            assert rig.service.core.vehicle.boots == 0
            assert any("not rebooted: INS_GYR_CAL = 1 would measure the gyros anew" in w for w in record.warnings)
            assert any("push.stop_rivals = true" in warning for warning in record.imus[0].warnings)

    run_virtual(main())


def test_with_the_rival_stopped_it_is_rebooted_and_the_offsets_are_confirmed(tmp_path: Path) -> None:
    async def main() -> None:
        async with quick(tmp_path, parameters=ON, more=STOP).running() as rig:
            await rig.ready()
            result, record = await calibrated(rig, reboot=True)
            assert result.outcome == "done", result
            assert "rebooted, offsets in force" in record.reason
            assert rig.service.core.vehicle.boots == 1
            assert rig.double.parameter("INS_GYR_CAL") == 0
            written = record.imus[0].written
            assert [written[name].after for name in offset_names(1, "gyro")] == pytest.approx(gyro(rig))
            undo = rig.service.calibrating.manager.start_undo("test")
            assert isinstance(undo, Job)
            assert (await undo.finished).outcome == "done"
            assert rig.double.parameter("INS_GYR_CAL") == 1

    run_virtual(main())


def test_a_start_that_measured_the_gyros_itself_is_told_as_such(tmp_path: Path) -> None:
    async def main() -> None:
        async with quick(tmp_path, parameters=ON).running() as rig:
            await rig.ready()
            result, _ = await calibrated(rig)
            assert result.outcome == "done", result
            await rig.ready()
            ours = gyro(rig)
            rig.double.reboot()
            await rig.until(lambda: rig.service.core.vehicle.boots == 1, 60.0)
            await rig.until(
                lambda: "The autopilot rewrote gyro offsets of fc: INS_GYR_CAL=1" in rig.ground.texts(), 30.0
            )
            assert gyro(rig) != ours

    run_virtual(main())


def test_a_rival_is_told_once_while_it_is_on_whatever_restarts(tmp_path: Path) -> None:
    async def main() -> None:
        async with quick(tmp_path, parameters=ON).running() as rig:
            told = "The autopilot may rewrite gyro offsets: set INS_GYR_CAL to 0"
            await rig.ready()
            for boots in (1, 2):
                rig.double.reboot()
                await rig.until(lambda: rig.service.core.vehicle.boots == boots, 60.0)  # noqa: B023 - awaited at once
                await rig.ready()
            await asyncio.sleep(5.0)
            assert rig.ground.texts().count(told) == 1
            assert rig.service.status()["warnings"], "to be read always"
            rig.double.write_as_another_station("INS_GYR_CAL", 0.0)
            await rig.until(lambda: not rig.service.status()["warnings"], 30.0)
            rig.double.write_as_another_station("INS_GYR_CAL", 1.0)
            await rig.until(lambda: rig.ground.texts().count(told) == 2, 30.0)

    run_virtual(main())


def test_what_somebody_else_wrote_is_told_as_such(tmp_path: Path) -> None:
    async def main() -> None:
        async with quick(tmp_path).running() as rig:
            await rig.ready()
            rig.double.write_as_another_station(offset_names(1, "accel")[1], 0.123)
            await rig.until(lambda: "Somebody rewrote accelerometer offsets of fc" in rig.ground.texts(), 20.0)

    run_virtual(main())


def test_a_reboot_is_not_sent_to_an_aircraft_that_armed_meanwhile(tmp_path: Path) -> None:
    async def main() -> None:
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
            assert any("not rebooted: the aircraft is armed" in warning for warning in job.record.warnings)
            await asyncio.sleep(5.0)
            assert rig.service.core.vehicle.boots == 0

    run_virtual(main())


def test_ardupilot_without_a_ground_station_is_told_what_routing_needs(tmp_path: Path) -> None:
    async def main() -> None:
        rig = quick(tmp_path)
        async with rig.running():
            await rig.ready()
            await asyncio.sleep(3.0)
            assert "reaches the companion" in rig.service.status()["ground_stations"]["summary"]
            rig.radio.cut = True
            await asyncio.sleep(6.0)
            ground = rig.service.status()["ground_stations"]
            assert ground["good"]
            assert "set not to forward" in ground["summary"]

    run_virtual(main())
