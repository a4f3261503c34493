"""Integer streams of the autopilot's second IMU, whose noise is too small, with and without offset dither."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from companion.config.sections import Imu, Push
from companion.daemon.job import Job
from companion.estimation.means.dither import STEPS
from companion.estimation.request import What
from companion.storage.changes import ChangeLog
from sim.ardupilot.double import ArduPilotDouble, offset_names
from sim.imu_model import DEG_H, MG, AxisNoise, ImuModel, ImuSpec
from tests.e2e.test_calibration import calibrated, started
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual
from tests.support.wire import Wire

NAMES = [*offset_names(2, "accel"), *offset_names(2, "gyro")]
UNDITHERED = ImuSpec(name="quiet", gyro=AxisNoise(white=7.1 * DEG_H), accel=AxisNoise(white=49.5e-3 * MG))
"""Behind the autopilot's filter 0.23 LSB of the gyros, as measured on a real one (autopilots 9.3.1)."""
CASE_A = ((100.0, -60.0, 170.0), (1.0, -2.0, 3.0))
"""deg/h and mg, autopilots 9.3: inside the dead band of the integers."""


def second_imu_only(
    folder: Path, part: ImuSpec, *, dither: bool = False, max_s: float = 60.0, seed: int = 3, coarse: bool = False
) -> Rig:
    """A daemon that knows only IMU 2; `coarse`: at low rates, where only what is written matters."""
    rates = {"imu_rate_hz": 10.0, "device_rate_hz": 5.0, "feed_s": 0.4} if coarse else {}
    rig = Rig(folder, max_s=max_s, min_still_s=min(max_s, 10.0), seed=seed, **rates)  # type: ignore[arg-type]
    imus = [Imu(name="second", source="autopilot", instance=2, profile="icm42688p")]
    rig.config = msgspec.structs.replace(rig.config, imu=imus, push=Push(dither=dither))
    gyro, accel = CASE_A
    model = ImuModel(
        rig.aircraft,
        part,
        seed=seed + 10,
        gyro_bias_rad_s=[value * DEG_H for value in gyro],
        accel_bias_m_s2=[value * MG for value in accel],
    )
    # On for an hour: the figures asked of it are without what a warm-up might do.
    rig.autopilot = ArduPilotDouble(
        rig.aircraft, [rig.model, model], parameters={"INS_GYR_CAL": 0.0}, seed=seed, up_s=3600.0
    )
    rig.wire, rig.radio = Wire(rig.link, rig.double, seed=seed), Wire(rig.ground, rig.double.ground, seed=seed + 1)
    return rig


async def ready(rig: Rig) -> None:
    imu = rig.service.devices.imus["second"]
    await rig.until(lambda: imu.calibration is not None and imu.stream.samples > 0, 15.0)


def offsets(rig: Rig) -> dict[str, float]:
    return {name: rig.double.parameter(name) for name in NAMES}


def left_over(rig: Rig) -> tuple[float, float]:
    """The largest residual of the second IMU, deg/h and mg."""
    left = rig.double.residual(2, rig.now_s)
    return float(np.abs(left.gyro_rad_s).max()) / DEG_H, float(np.abs(left.accel_m_s2).max()) / MG


def test_an_undithered_second_imu_is_left_alone_with_the_way_out(tmp_path: Path) -> None:
    async def main() -> None:
        async with second_imu_only(tmp_path, UNDITHERED, max_s=12.0).running() as rig:
            await ready(rig)
            before = offsets(rig)
            result, record = await calibrated(rig, What.GYROS)
            assert result.outcome == "failed"
            assert "gyro second" in result.reason
            assert "push.dither" in result.reason
            assert record.imus == ()
            assert offsets(rig) == before
            assert rig.double.writes == []

    run_virtual(main())


def test_who_has_switched_writing_off_gets_no_dither_either(tmp_path: Path) -> None:
    async def main() -> None:
        async with second_imu_only(tmp_path, UNDITHERED, dither=True, max_s=12.0).running() as rig:
            await ready(rig)
            rig.service.core.wanted.switch(push=False)
            result, _ = await calibrated(rig, What.GYROS)
            assert result.outcome == "failed"
            assert rig.double.writes == []

    run_virtual(main())


def test_with_push_dither_the_undithered_imu_comes_within_a_few_deg_h(tmp_path: Path) -> None:
    async def main() -> None:
        async with second_imu_only(tmp_path, UNDITHERED, dither=True).running() as rig:
            await ready(rig)
            job = started(rig.service.calibrating.manager.start_calibration(What.BOTH, "test"))
            seen: set[str] = set()
            while not job.finished.done():
                seen.add(job.words)
                await asyncio.sleep(0.1)
            result, record = await job.finished, job.record
            assert result.outcome == "done", result
            assert record is not None
            assert {f"dithering IMU 2: step {k + 1}/{STEPS}" for k in range(STEPS)} <= seen
            gyro_deg_h, accel_mg = left_over(rig)
            print(
                f"left {gyro_deg_h:.1f} deg/h and {accel_mg * 1e3:.0f} ug; sigma {record.imus[0].gyro_sigma_use_rad_s}"
            )
            assert gyro_deg_h < 8.0
            assert accel_mg < 0.15
            imu = record.imus[0]
            # Six offsets, and the gyros' again over the firmware's own calibration.
            steps = len(rig.double.writes) - 9
            assert f"imu second: offsets dithered and put back, {steps} parameter writes" in imu.warnings
            # Ten times six and six back, but for one axis far from zero that need not move at the first step.
            assert 60 <= steps <= 66
            assert imu.gyro_bias_rad_s is not None
            assert imu.gyro_sigma_use_rad_s is not None
            true = rig.double.imus[1].true_bias(rig.aircraft.time_at(rig.now_s))
            off = np.abs(np.subtract(imu.gyro_bias_rad_s, true.gyro_rad_s))
            assert np.all(off < 3.5 * np.array(imu.gyro_sigma_use_rad_s))
            # What an undo would bring back is the old offsets, not a step of the dither.
            undone = started(rig.service.calibrating.manager.start_undo("test"))
            assert (await undone.finished).outcome == "done"
            assert ChangeLog(tmp_path).journal.read() is None

    run_virtual(main())


async def _until_step(rig: Rig, job: Job, step: int) -> None:
    words = f"dithering IMU 2: step {step}/{STEPS}"
    await rig.until(lambda: job.words == words, 200.0)
    await asyncio.sleep(2.0 if step % 2 else 0.05)  # in its seconds, or in its writes


Fate = Callable[[Rig, Job], None]


def cancelled(rig: Rig, job: Job) -> None:
    job.cancel("test")


def armed(rig: Rig, job: Job) -> None:
    rig.double.arm()
    asyncio.get_running_loop().call_later(5.0, rig.double.disarm)


def rebooted(rig: Rig, job: Job) -> None:
    rig.double.reboot()


def link_lost(rig: Rig, job: Job) -> None:
    rig.wire.cut = True
    asyncio.get_running_loop().call_later(8.0, lambda: setattr(rig.wire, "cut", False))


@pytest.mark.parametrize(
    ("fate", "step"),
    [(cancelled, 6), (armed, 7), (rebooted, 7), (link_lost, STEPS)],
)
def test_a_dither_that_is_interrupted_leaves_the_offsets_as_they_were(tmp_path: Path, fate: Fate, step: int) -> None:
    async def main() -> None:
        async with second_imu_only(tmp_path, UNDITHERED, dither=True, max_s=3.0, coarse=True).running() as rig:
            await ready(rig)
            before = offsets(rig)
            job = started(rig.service.calibrating.manager.start_calibration(What.BOTH, "test"))
            await _until_step(rig, job, step)
            assert ChangeLog(tmp_path).journal.read() is not None
            assert step == 1 or offsets(rig) != before
            fate(rig, job)
            result = await job.finished
            assert result.outcome == ("cancelled" if fate is cancelled else "failed"), result
            assert "values back" in result.reason or "NOT back" in result.reason
            await rig.until(lambda: not rig.service.offsets.ledger.pending, 120.0)
            assert offsets(rig) == before
            assert ChangeLog(tmp_path).journal.read() is None
            if fate is cancelled:
                assert job.record is not None

    run_virtual(main())
