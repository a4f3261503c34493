"""`companion align` on the whole daemon: the zero that it finds, what it is good for, and what it refuses."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.calibration.record import Record
from companion.component.service import JobResult
from companion.daemon.align_steps import Plan
from companion.daemon.job import Job
from sim.aircraft import Pose
from sim.devices import HMR3300, Gradienter
from sim.hands import Hands
from sim.imu_model import MG
from tests.e2e.test_calibration import calibrated, started
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

SPOT = Pose(pitch_deg=0.5, roll_deg=-0.4, heading_deg=40.0)
ZERO_DEG = (0.117, -0.083)
TARGET_MG = 0.25


def rig(folder: Path, *, seed: int = 1, placement_deg: float = 0.02, **more: Any) -> tuple[Rig, Hands]:
    made = Rig(folder, pose=SPOT, seed=seed, **more)
    made.config = replaced(made.config, gradienter={"sigma_deg": 0.1})
    made.devices["gradienter"] = Gradienter(made.aircraft, seed=seed, law="slope", offset_deg=ZERO_DEG)
    made.devices["compass"] = HMR3300(made.aircraft, seed=seed, heading_error_deg=0.7)
    return made, Hands(made.aircraft, placement_deg=placement_deg, seed=seed)


def replaced(config: Any, **sections: dict[str, Any]) -> Any:
    import msgspec

    changed = {name: msgspec.structs.replace(getattr(config, name), **keys) for name, keys in sections.items()}
    return msgspec.structs.replace(config, **changed)


def worst_horizontal(record: Record, rig: Rig) -> tuple[float, float]:
    """Largest error of the two horizontal accelerometers against the truth, and their largest sigma_use, in mg."""
    (imu,) = record.imus
    assert imu.accel_bias_m_s2 is not None
    assert imu.accel_sigma_use_m_s2 is not None
    true = rig.model.true_bias(rig.aircraft.time_at(rig.now_s)).accel_m_s2
    off = np.abs(np.subtract(imu.accel_bias_m_s2, true))[:2] / MG
    return float(off.max()), float(max(imu.accel_sigma_use_m_s2[:2])) / MG


async def follow(rig: Rig, hands: Hands, job: Job) -> JobResult:
    """Turn the aircraft whenever the words ask for it."""
    done = 1
    while not job.finished.done():
        if job.words.startswith(f"{done + 1} of") and "waiting for it to move" in job.words:
            done += 1
            now_s = rig.aircraft.time_at(rig.now_s)
            hands.turn(now_s, 90.0 if "by 90" in job.words else 180.0)
        await asyncio.sleep(0.5)
    return job.finished.result()


async def aligned(rig: Rig, hands: Hands, plan: Plan) -> JobResult:
    return await follow(rig, hands, started(rig.service.conductor.start_alignment(plan, "test", 900.0)))


@pytest.mark.parametrize("plan", [Plan("zero"), Plan("zero", headings=4)], ids=["there-and-back", "four"])
def test_the_horizontal_accelerometers_become_as_good_as_the_turn(tmp_path: Path, plan: Plan) -> None:
    made, hands = rig(tmp_path)

    async def main() -> None:
        async with made.running():
            await made.ready()
            result, before = await calibrated(made)
            assert result.outcome == "done", result
            assert before.alignment is None
            off_mg, sigma_mg = worst_horizontal(before, made)
            assert 1.7 < sigma_mg < 1.8
            assert 1.0 < off_mg < 2.5
            result = await aligned(made, hands, plan)
            assert result.outcome == "done", result
            record = made.service.alignment.record
            assert record is not None
            assert record.checked
            off = np.abs(np.subtract(record.offset_deg, ZERO_DEG))
            assert off.max() < 2.5 * record.sigma_deg
            result, after = await calibrated(made)
            assert result.outcome == "done", result
            assert after.alignment is not None
            assert after.alignment.offset_deg == record.offset_deg
            off_mg, sigma_mg = worst_horizontal(after, made)
            assert sigma_mg <= TARGET_MG
            assert off_mg < 2.5 * sigma_mg
            assert made.service.status()["alignment"]["in_force"] is True

    run_virtual(main())
