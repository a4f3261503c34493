"""`companion align turn` on the whole daemon: an autopilot alone, turned on a spot that slopes."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import pytest

from companion.calibration.solution.turn_record import TurnRecord
from companion.component.service import JobResult, Refusal
from companion.daemon.job import Job
from sim.aircraft import Pose
from sim.ardupilot.double import offset_names
from sim.hands import Hands
from sim.imu_model import MG
from tests.e2e.test_calibration import started
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

STEEP = Pose(pitch_deg=4.0, roll_deg=-3.0, heading_deg=40.0)
FLAT = Pose(pitch_deg=0.4, roll_deg=-0.3, heading_deg=40.0)
TARGET_MG = 0.25


def rig(folder: Path, pose: Pose, firmware: Literal["ardupilot", "px4"] = "ardupilot") -> tuple[Rig, Hands]:
    """An autopilot and nothing else."""
    made = Rig(folder, pose=pose, firmware=firmware, imu_rate_hz=25.0)
    made.config = msgspec.structs.replace(made.config, gradienter=None, compass=None)
    made.devices.clear()
    return made, Hands(made.aircraft, placement_deg=0.02, seed=4)


async def follow(rig: Rig, hands: Hands, job: Job, bump_before: int = 0) -> JobResult:
    """Turn it whenever the words ask for it."""
    done = 1
    while not job.finished.done():
        if job.words.startswith(f"{done + 1} of") and "waiting for it to move" in job.words:
            done += 1
            if done == bump_before:
                hands.bump(0.4, 0.0)
            hands.turn(rig.aircraft.time_at(rig.now_s), 90.0 if "by 90" in job.words else 180.0)
        await asyncio.sleep(0.5)
    return job.finished.result()


def turn(rig: Rig, headings: int, *, write: bool) -> Job:
    return started(rig.service.calibrating.conductor.start_turn(headings, "test", 900.0, write=write))


def true_mg(rig: Rig) -> Any:
    """Of the first IMU, whose board sits straight in the aircraft."""
    return rig.model.true_bias(rig.aircraft.time_at(rig.now_s)).accel_m_s2 / MG


def residual_mg(rig: Rig, record: TurnRecord) -> Any:
    """What the output had left of the bias: an offset of 0.001 m/s^2 was in force."""
    (imu,) = record.imus
    before = [one.before for one in imu.written.values()] if imu.written else [0.001] * 3
    return true_mg(rig) - np.array(before) / MG


@pytest.mark.parametrize(("headings", "pose"), [(4, STEEP), (2, FLAT)], ids=["four on 5 deg", "half a turn"])
def test_the_level_is_found_on_a_slope_and_written(tmp_path: Path, headings: int, pose: Pose) -> None:
    made, hands = rig(tmp_path, pose)

    async def main() -> None:
        async with made.running():
            await made.ready()
            names = offset_names(1, "accel")
            old = [made.double.parameter(name) for name in names]
            job = turn(made, headings, write=True)
            result = await follow(made, hands, job)
            assert result.outcome == "done", result
            assert result.reason.endswith("written")
            record = job.product
            assert isinstance(record, TurnRecord)
            assert record.checked
            assert record.slope_deg == pytest.approx(float(np.hypot(pose.pitch_deg, pose.roll_deg)), abs=0.06)
            (imu,) = record.imus
            sigma = np.array(imu.level_sigma_mg)[:2]
            assert sigma.max() < 1.15 * TARGET_MG
            off = np.abs(np.subtract(imu.level_bias_mg, residual_mg(made, record)))[:2]
            assert (off < 2.5 * sigma).all()
            assert {one.outcome for one in imu.written.values()} == {"verified"}
            written = np.array([made.double.parameter(name) for name in names]) / MG
            assert (np.abs(written - true_mg(made))[:2] < 2.5 * sigma).all()
            undone = made.service.calibrating.conductor.start_undo("test")
            assert not isinstance(undone, Refusal)
            assert (await undone.finished).outcome == "done"
            assert [made.double.parameter(name) for name in names] == old

    run_virtual(main())


def test_half_a_turn_on_a_steep_slope_says_how_little_it_knows(tmp_path: Path) -> None:
    made, hands = rig(tmp_path, STEEP)

    async def main() -> None:
        async with made.running():
            await made.ready()
            job = turn(made, 2, write=False)
            result = await follow(made, hands, job)
            assert result.outcome == "done", result
            record = job.product
            assert isinstance(record, TurnRecord)
            assert "four headings" in record.warnings[-1]
            (imu,) = record.imus
            assert max(imu.level_sigma_mg[:2]) > 0.5
            off = np.abs(np.subtract(imu.level_bias_mg, residual_mg(made, record)))[:2]
            assert (off < 3.0 * np.array(imu.level_sigma_mg)[:2]).all()

    run_virtual(main())


def test_a_spot_that_moved_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    made, hands = rig(tmp_path, FLAT)

    async def main() -> None:
        async with made.running():
            await made.ready()
            old = [made.double.parameter(name) for name in offset_names(1, "accel")]
            job = turn(made, 2, write=True)
            result = await follow(made, hands, job, bump_before=3)
            assert result.outcome == "failed"
            assert "the spot moved" in result.reason
            assert [made.double.parameter(name) for name in offset_names(1, "accel")] == old

    run_virtual(main())


def test_px4s_offsets_are_written_too(tmp_path: Path) -> None:
    made, hands = rig(tmp_path, FLAT, "px4")

    async def main() -> None:
        async with made.running():
            await made.ready()
            job = turn(made, 4, write=True)
            result = await follow(made, hands, job)
            assert result.outcome == "done", result
            record = job.product
            assert isinstance(record, TurnRecord)
            (imu,) = record.imus
            assert set(imu.written) == {"CAL_ACC0_XOFF", "CAL_ACC0_YOFF", "CAL_ACC0_ZOFF"}
            assert {one.outcome for one in imu.written.values()} == {"verified"}

    run_virtual(main())
