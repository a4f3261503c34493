"""The whole chain from bytes to parameters: the daemon against the simulator's truth."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.component.service import JobResult, Refusal
from companion.daemon.job import Job
from companion.estimation.machine import What
from companion.estimation.records.record import Record
from sim.ardupilot.parameters import offset_names
from sim.imu_model import DEG_H, MG
from tests.support.rig import Rig

FC_PARAMETERS = [*offset_names(1, "accel"), *offset_names(1, "gyro")]
QUICK: dict[str, Any] = {"min_still_s": 3.0, "max_s": 6.0}
"""For tests that look at what happens around a calibration, not at how good it is."""


def started(answer: Job | Refusal) -> Job:
    assert isinstance(answer, Job), answer
    return answer


async def calibrated(
    rig: Rig, what: What = What.BOTH, timeout_s: float | None = None, *, reboot: bool = False
) -> tuple[JobResult, Record]:
    """Calibrate to the end, as a person who asks for it."""
    job = started(rig.service.calibrating.manager.start_calibration(what, "test", timeout_s, reboot=reboot))
    result = await job.finished
    assert job.record is not None
    return result, job.record


async def test_both_imus_are_calibrated_at_once_and_the_autopilot_is_right_afterwards(tmp_path: Path) -> None:
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
        await asyncio.sleep(0.1)
        assert rig.double.buzzer.heard == ["1 long note", "4 short notes, rising"]
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
        assert rig.service.calibrating.store.history() == [record]
        # A second one starts from the first: the whole bias is the same, the residual small.
        result, again = await calibrated(rig)
        assert result.outcome == "done"
        second = again.imus[0]
        assert second.residual_gyro_rad_s is not None
        assert second.gyro_bias_rad_s is not None
        assert np.abs(second.residual_gyro_rad_s).max() < 20 * DEG_H
        assert fc.gyro_bias_rad_s is not None
        np.testing.assert_allclose(second.gyro_bias_rad_s, fc.gyro_bias_rad_s, atol=20 * DEG_H)


async def test_after_a_minute_of_rest_the_result_is_there_at_once_and_nothing_is_written_unless_wanted(
    tmp_path: Path,
) -> None:
    async with Rig(tmp_path, imu_rate_hz=100.0, more="[push]\nparameters = false\n").running() as rig:
        await rig.ready()
        await asyncio.sleep(60.0)
        result, record = await calibrated(rig)
        assert result.outcome == "done"
        # Nothing is measured any more: 17 parameters are read, and an ArduPilot takes up to 95 ms for each.
        assert record.duration_s < 17 * 0.1
        assert record.imus[0].samples > 2000
        assert record.imus[0].written == {}
        assert rig.double.writes == []


@pytest.mark.parametrize("what", [What.GYROS, What.ACCELEROMETERS])
async def test_only_what_was_asked_for_is_written(tmp_path: Path, what: What) -> None:
    async with Rig(tmp_path, **QUICK).running() as rig:
        await rig.ready()
        result, record = await calibrated(rig, what)
        assert result.outcome == "done"
        kind = "GYR" if what is What.GYROS else "ACC"
        assert {write.name for write in rig.double.writes} == {name for name in FC_PARAMETERS if kind in name}
        imu = record.imus[0]
        assert (imu.gyro_bias_rad_s is None) == (what is What.ACCELEROMETERS)
        assert (imu.accel_bias_m_s2 is None) == (what is What.GYROS)
        assert imu.covariance is not None
        assert (imu.covariance[0][0] is None) == (what is What.ACCELEROMETERS)
        assert (imu.covariance[5][5] is None) == (what is What.GYROS)


@pytest.mark.parametrize(("source", "heading_from"), [(1.0, "autopilot"), (6.0, None)], ids=["compass", "nobody's"])
async def test_without_a_compass_the_autopilots_heading_counts_if_its_own_compass_gives_it(
    tmp_path: Path, source: float, heading_from: str | None
) -> None:
    """An EKF3 that waits for a heading from outside holds 0 deg and calls it as good as any (the real one, too)."""

    rig = Rig(tmp_path, imus=1, parameters={"VISO_TYPE": 1.0, "EK3_SRC1_YAW": source}, **QUICK)
    rig.config = msgspec.structs.replace(rig.config, compass=None)
    del rig.devices["compass"]
    rig.autopilot.has_compass = True
    async with rig.running():
        await rig.ready()
        await asyncio.sleep(10.0)
        result, record = await calibrated(rig)
        assert result.outcome == "done", result
        assert record.pose is not None
        assert record.pose.heading_from == heading_from
        psi_deg = record.pose.psi_deg
        if heading_from is None:
            assert psi_deg is None
        else:
            yaw = math.degrees(rig.aircraft.angles_rad(rig.aircraft.time_at(rig.now_s))[2])
            assert psi_deg == pytest.approx(yaw % 360.0, abs=0.5)


async def test_a_serial_imu_that_the_autopilot_consumes_gets_its_offsets_there_and_they_count_as_stored(
    tmp_path: Path,
) -> None:
    rig = Rig(tmp_path, own_imu=True, **QUICK)
    own = msgspec.structs.replace(rig.config.imu[1], autopilot_instance=2)
    rig.config = msgspec.structs.replace(rig.config, imu=[rig.config.imu[0], own])
    async with rig.running():
        await rig.ready()
        result, record = await calibrated(rig)
        assert result.outcome == "done", result
        own_record = record.imus[1]
        assert set(own_record.written) == {*offset_names(2, "accel"), *offset_names(2, "gyro")}
        assert {written.outcome for written in own_record.written.values()} == {"stored"}
        assert any("not verified" in warning for warning in own_record.warnings)
        assert own_record.gyro_bias_rad_s is not None
        written = [rig.double.parameter(name) for name in offset_names(2, "gyro")]
        np.testing.assert_allclose(written, own_record.gyro_bias_rad_s, atol=1e-9)
        assert {w.outcome for w in record.imus[0].written.values()} == {"verified"}


async def test_a_hover_bias_that_the_autopilot_learned_follows_the_offsets_and_an_undo(tmp_path: Path) -> None:
    name, vibration_m_s2 = "INS_ACC_VRFB_Z", 0.15
    values = {"AHRS_ORIENTATION": 8.0, "INS_ACCOFFS_Z": 0.08, name: 0.1, "INS_ACC2_VRFB_Z": 0.0}
    async with Rig(tmp_path, **QUICK, mounting_deg=(180.0, 0.0, 0.0), parameters=values).running() as rig:
        double, undo = rig.double, rig.service.calibrating.manager.start_undo

        def unlearned_m_s2() -> float:
            """Learned bias, less what the offsets leave: the vibration's own part."""
            return float(double.parameter(name) - double.residual(1, rig.now_s).accel_m_s2[2])

        await rig.ready()
        residual_m_s2 = float(double.residual(1, rig.now_s).accel_m_s2[2])
        assert abs(residual_m_s2) > 5.0 * MG
        learned_m_s2 = residual_m_s2 + vibration_m_s2
        double.set_parameter(name, learned_m_s2)
        result, record = await calibrated(rig, What.ACCELEROMETERS)
        assert result.outcome == "done", result
        assert double.parameter(name) == pytest.approx(vibration_m_s2, abs=1.0 * MG)
        assert unlearned_m_s2() == pytest.approx(vibration_m_s2, abs=0.05 * MG)
        assert record.imus[0].written[name].before == pytest.approx(learned_m_s2)
        # The next flight learns anew, and an undo keeps what it learned.
        double.set_parameter(name, vibration_m_s2 + 0.03)
        before_undo_m_s2 = unlearned_m_s2()
        assert (await started(undo("test")).finished).outcome == "done"
        assert unlearned_m_s2() == pytest.approx(before_undo_m_s2, abs=0.05 * MG)
        assert double.parameter(name) == pytest.approx(learned_m_s2 + 0.03, abs=1.0 * MG)
        assert double.parameter("INS_ACC2_VRFB_Z") == 0.0
