"""From bytes to parameters: the daemon against the simulator's truth."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest

from companion.calibration.record import Record
from companion.calibration.request import What
from companion.component.service import JobResult, Refusal
from companion.daemon.job import Job
from sim.autopilot import offset_names
from sim.imu_model import DEG_H, MG
from tests.support.component import ACCEPTED, CALIBRATE, UNDO
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

FC_PARAMETERS = [*offset_names(1, "accel"), *offset_names(1, "gyro")]


def started(answer: Job | Refusal) -> Job:
    assert isinstance(answer, Job), answer
    return answer


async def calibrated(rig: Rig, what: What = What.BOTH, timeout_s: float | None = None) -> tuple[JobResult, Record]:
    job = started(rig.service.conductor.start_calibration(what, "test", timeout_s))
    result = await job.finished
    assert job.record is not None
    return result, job.record


def test_both_imus_are_calibrated_at_once_and_the_autopilot_is_right_afterwards(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, own_imu=True).running() as rig:
            await rig.ready()
            result, record = await calibrated(rig)
            assert result.outcome == "done", result
            assert {imu.name for imu in record.imus} == {"fc", "own"}
            for imu, model in zip(record.imus, (rig.model, rig.own_model), strict=True):
                true = model.true_bias(rig.aircraft.time_at(rig.now_s))
                assert imu.gyro_bias_rad_s is not None
                assert imu.accel_bias_m_s2 is not None
                assert imu.gyro_sigma_use_rad_s is not None
                assert imu.accel_sigma_use_m_s2 is not None
                off = np.abs(np.subtract(imu.gyro_bias_rad_s, true.gyro_rad_s)) / imu.gyro_sigma_use_rad_s
                assert off.max() < 3.5
                off = np.abs(np.subtract(imu.accel_bias_m_s2, true.accel_m_s2)) / imu.accel_sigma_use_m_s2
                assert off.max() < 3.5
            fc, own = record.imus
            assert list(fc.written) == FC_PARAMETERS
            assert {written.outcome for written in fc.written.values()} == {"verified"}
            for name, written in fc.written.items():
                assert rig.double.parameter(name) == written.read_back == np.float32(written.after)
            assert own.written == {}
            assert own.residual_gyro_rad_s is None
            left = rig.double.residual(1, rig.now_s)
            assert np.abs(left.gyro_rad_s).max() < 20 * DEG_H
            assert np.abs(left.accel_m_s2).max() < 0.3 * MG
            assert record.pose is not None
            assert record.pose.theta_deg is not None
            assert abs(record.pose.theta_deg - 5.0) < 0.02
            assert record.site is not None
            assert record.site.source is not None
            assert "autopilot" in record.site.source
            assert rig.service.store.history() == [record]
            # A second one starts from the first: the whole bias is the same, the residual small.
            result, again = await calibrated(rig)
            assert result.outcome == "done"
            second = again.imus[0]
            assert second.residual_gyro_rad_s is not None
            assert second.gyro_bias_rad_s is not None
            assert np.abs(second.residual_gyro_rad_s).max() < 20 * DEG_H
            assert fc.gyro_bias_rad_s is not None
            np.testing.assert_allclose(second.gyro_bias_rad_s, fc.gyro_bias_rad_s, atol=20 * DEG_H)

    run_virtual(main())


@pytest.mark.parametrize("system_id", [1, 7])
def test_a_ground_station_calibrates_and_undoes(tmp_path: Path, system_id: int) -> None:
    vehicle = (system_id, 191)

    async def main() -> None:
        async with Rig(tmp_path, system_id=system_id).running() as rig:
            await rig.ready()
            before = {name: rig.double.parameter(name) for name in FC_PARAMETERS}
            await rig.until(lambda: rig.double.hears(191), 5.0)
            rig.ground.command(CALIBRATE, 0.0, target=vehicle)
            await rig.until(lambda: rig.ground.finals(CALIBRATE) == [ACCEPTED], 90.0)
            assert {name: rig.double.parameter(name) for name in FC_PARAMETERS} != before
            texts = " | ".join(rig.ground.texts())
            assert "Calibration started" in texts
            assert "Calibration done: sigma" in texts
            rig.ground.command(UNDO, target=vehicle)
            await rig.until(lambda: rig.ground.finals(UNDO) == [ACCEPTED], 30.0)
            assert {name: rig.double.parameter(name) for name in FC_PARAMETERS} == before
            await asyncio.sleep(2.0)
            assert rig.ground.finals() == [ACCEPTED, ACCEPTED]

    run_virtual(main())
