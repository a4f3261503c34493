"""The daemon on PX4's double: what PX4 really uses is the judge, not what its parameters say."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.estimation.machine import What
from companion.storage.changes import ChangeLog
from sim.imu_model import DEG_H
from tests.e2e.test_calibration import calibrated, started
from tests.support.rig import Rig

NO_RIVALS = {"IMU_GYRO_CAL_EN": 0.0, "SENS_IMU_AUTOCAL": 0.0}


def names(sensor: str, slot: int = 0) -> list[str]:
    return [f"CAL_{sensor}{slot}_{axis}OFF" for axis in "XYZ"]


ALL = [*names("ACC"), *names("GYRO")]


def px4_rig(folder: Path, **options: Any) -> Rig:
    """Quick: few samples, of a part whose noise moves the integers, and nothing streamed that nobody asked for."""
    options["parameters"] = NO_RIVALS | options.get("parameters", {})
    quick: dict[str, Any] = {
        "min_still_s": 4.0,
        "max_s": 8.0,
        "default_streams": False,
        "feed_s": 0.2,
        "imu_rate_hz": 50.0,
        "part": "bmi088",
    }
    return Rig(folder, firmware="px4", **(quick | options))


def values(rig: Rig, wanted: list[str] = ALL) -> dict[str, float]:
    return {name: rig.px4.parameter(name) for name in wanted}


def uses(rig: Rig, instance: int = 1) -> tuple[list[float], list[float]]:
    """Gyro and accelerometer offsets that PX4 really takes off."""
    imu = rig.px4.vehicle_imus[instance - 1]
    return imu.gyro.offset.tolist(), imu.accel.offset.tolist()


def in_use_as_stored(rig: Rig, instance: int = 1, slot: int = 0) -> bool:
    gyro, accel = uses(rig, instance)
    return gyro == [*values(rig, names("GYRO", slot)).values()] and accel == [*values(rig, names("ACC", slot)).values()]


async def test_offsets_that_px4_would_ignore_are_in_use_after_a_calibration_and_out_after_an_undo(
    tmp_path: Path,
) -> None:
    async with px4_rig(tmp_path).running() as rig:
        await rig.ready()
        result, record = await calibrated(rig)
        assert result.outcome == "done", result
        (fc,) = record.imus
        assert list(fc.written) == ALL
        assert {written.outcome for written in fc.written.values()} == {"verified"}
        gyro, _ = uses(rig)
        assert 0.0 < np.linalg.norm(gyro) < 0.01  # the whole vector is one that a plain write would not bring in
        assert in_use_as_stored(rig)
        left = rig.px4.residual(1, rig.now_s)
        assert fc.gyro_sigma_use_rad_s is not None
        assert fc.accel_sigma_use_m_s2 is not None
        assert np.abs(left.gyro_rad_s / fc.gyro_sigma_use_rad_s).max() < 3.5
        assert np.abs(left.accel_m_s2 / fc.accel_sigma_use_m_s2).max() < 3.5
        undo = started(rig.service.calibrating.manager.start_undo("test"))
        assert (await undo.finished).outcome == "done"
        await asyncio.sleep(1.5)
        assert set(values(rig).values()) == {0.0}
        assert in_use_as_stored(rig)


async def test_a_small_accelerometer_vector_is_brought_into_use_before_anything_is_measured(tmp_path: Path) -> None:
    rig = px4_rig(tmp_path, parameters={"CAL_ACC0_XOFF": 0.006, "CAL_ACC0_YOFF": -0.005})
    async with rig.running():
        await rig.ready()
        assert uses(rig)[1] == [0.0, 0.0, 0.0]  # as PX4 starts
        result, record = await calibrated(rig)
        assert result.outcome == "done", result
        (fc,) = record.imus
        assert in_use_as_stored(rig)
        assert not [text for text in rig.ground.texts() if "Interrupted write" in text]
        left = rig.px4.residual(1, rig.now_s)
        assert fc.accel_sigma_use_m_s2 is not None
        assert np.abs(left.accel_m_s2 / fc.accel_sigma_use_m_s2).max() < 3.5
        undo = started(rig.service.calibrating.manager.start_undo("test"))
        assert (await undo.finished).outcome == "done"
        assert values(rig)["CAL_ACC0_XOFF"] == np.float32(0.006)


# --- what may come in between


async def test_power_cut_of_the_companion_between_the_steps_is_mended(tmp_path: Path) -> None:
    parameters = {"CAL_GYRO0_XOFF": 0.004, "CAL_ACC0_ZOFF": 0.25}
    rig = px4_rig(tmp_path, parameters=parameters)
    before: dict[str, float] = {}
    async with rig.running():
        await rig.ready()
        before |= values(rig)
        started(rig.service.calibrating.manager.start_calibration(What.BOTH, "test"))
        await rig.until(lambda: len(rig.px4.writes) >= 7, 60.0)
        rig.wire.cut = True  # the companion is gone for good
        journal = (tmp_path / "journal.json").read_bytes()
        assert ChangeLog(tmp_path).journal.read() is not None
    (tmp_path / "journal.json").write_bytes(journal)
    again = px4_rig(tmp_path, parameters=NO_RIVALS)
    for name in before:
        again.px4.set_parameter(name, rig.px4.parameter(name))
    async with again.running():
        await again.until(lambda: not again.service.offsets.journal.pending, 40.0)
        await asyncio.sleep(1.5)
        assert values(again) == before
        assert in_use_as_stored(again)


@pytest.mark.parametrize("writes", [0, 5, 7])
async def test_a_reboot_at_any_phase_leaves_the_old_values_or_the_new_ones_in_use(tmp_path: Path, writes: int) -> None:
    async with px4_rig(tmp_path, parameters={"CAL_ACC0_ZOFF": 0.25}).running() as rig:
        await rig.ready()
        before = values(rig)
        job = started(rig.service.calibrating.manager.start_calibration(What.BOTH, "test"))
        await rig.until(lambda: rig.service.calibrating.manager.state.value == "collecting", 30.0)
        await rig.until(lambda: len(rig.px4.writes) >= writes, 60.0)
        rig.px4.reboot()
        result = await job.finished
        await rig.until(lambda: not rig.service.offsets.journal.pending, 60.0)
        await asyncio.sleep(3.0)
        if result.outcome == "done":
            assert writes == 0
        else:
            assert values(rig) == before
        assert in_use_as_stored(rig)


# --- a restart, when it is asked for


async def test_the_autopilot_is_rebooted_only_when_asked_and_what_was_written_is_confirmed(tmp_path: Path) -> None:
    async with px4_rig(tmp_path).running() as rig:
        await rig.ready()
        result, record = await calibrated(rig, reboot=True)
        assert result.outcome == "done", result
        assert "rebooted, offsets active" in record.reason
        assert rig.service.core.vehicle.boots == 1
        assert in_use_as_stored(rig)
        assert not any("attitude stays wrong" in warning for warning in record.warnings)
        result, record = await calibrated(rig)
        assert rig.service.core.vehicle.boots == 1


# --- rivals


async def test_rivals_are_stopped_with_the_biases_and_the_undo_starts_them_again(tmp_path: Path) -> None:
    rivals = {"IMU_GYRO_CAL_EN": 1.0, "SENS_IMU_AUTOCAL": 1.0}
    async with px4_rig(tmp_path, parameters=rivals, more="[push]\nstop_rivals = true\n").running() as rig:
        await rig.ready()
        result, record = await calibrated(rig)
        assert result.outcome == "done", result
        assert [rig.px4.parameter(name) for name in rivals] == [0, 0]
        assert list(record.imus[0].written)[:2] == list(rivals)
        # Switched off, but only a boot looks at it.
        await rig.until(lambda: any("gyro calibration still runs" in text for text in rig.ground.texts()), 10.0)
        (warning,) = rig.service.status()["warnings"]
        assert "IMU_GYRO_CAL_EN is off from the next boot on" in warning
        undo = started(rig.service.calibrating.manager.start_undo("test"))
        assert (await undo.finished).outcome == "done"
        assert [rig.px4.parameter(name) for name in rivals] == [1, 1]
        assert set(values(rig).values()) == {0.0}


async def test_a_second_calibration_soon_after_a_write_reads_floats_too(tmp_path: Path) -> None:
    """The EKF's bias is not read for a minute, so that the stream is integers: 9 deg/h without the console's means."""
    rig = px4_rig(tmp_path, part="icm42688p", min_still_s=20.0, max_s=30.0, imu_rate_hz=100.0)
    async with rig.running():
        await rig.ready()
        for pause_s in (0.0, 30.0):
            await asyncio.sleep(pause_s)
            result, record = await calibrated(rig)
            assert result.outcome == "done", result
            (fc,) = record.imus
            assert fc.gyro_sigma_stat_rad_s is not None
            assert max(fc.gyro_sigma_stat_rad_s) < 5.0 * DEG_H
