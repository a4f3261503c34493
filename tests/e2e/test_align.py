"""`companion align` on the whole daemon: the zero that it finds, what it is good for, and what it refuses."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.commands import Align
from companion.component.service import JobResult, Refusal
from companion.daemon.job import Job
from companion.estimation.machine import What
from companion.estimation.records.record import Record
from sim.aircraft import Pose
from sim.ardupilot.parameters import offset_names
from sim.devices import HMR3300, Gradienter
from sim.hands import Hands
from sim.imu_model import MG
from tests.e2e.test_calibration import calibrated, started
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

SPOT = Pose(pitch_deg=0.5, roll_deg=-0.4, heading_deg=40.0)
ZERO_DEG = (0.117, -0.083)
TARGET_MG = 0.25


def rig(
    folder: Path, *, seed: int = 1, placement_deg: float = 0.02, pose: Pose = SPOT, **more: Any
) -> tuple[Rig, Hands]:
    made = Rig(folder, pose=pose, seed=seed, **({"imu_rate_hz": 10.0} | more))
    made.config = replaced(made.config, gradienter={"sigma_deg": 0.1})
    made.devices["gradienter"] = Gradienter(made.aircraft, seed=seed, law="slope", offset_deg=ZERO_DEG)
    made.devices["compass"] = HMR3300(made.aircraft, seed=seed, heading_error_deg=0.7)
    return made, Hands(made.aircraft, placement_deg=placement_deg, seed=seed)


def replaced(config: Any, **sections: dict[str, Any]) -> Any:
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


async def aligned(rig: Rig, hands: Hands) -> JobResult:
    return await follow(rig, hands, started(rig.service.calibrating.start_alignment(Align(action="zero"), "test")))


async def test_the_horizontal_accelerometers_become_as_good_as_the_turn(tmp_path: Path) -> None:
    made, hands = rig(tmp_path)

    async with made.running():
        await made.ready()
        result, before = await calibrated(made)
        assert result.outcome == "done", result
        assert before.alignment is None
        off_mg, sigma_mg = worst_horizontal(before, made)
        assert 1.7 < sigma_mg < 1.8
        assert 1.0 < off_mg < 2.5
        result = await aligned(made, hands)
        assert result.outcome == "done", result
        record = made.service.calibrating.alignment.record
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


async def test_a_zero_from_a_slope_does_not_replace_a_better_one(tmp_path: Path) -> None:
    made, hands = rig(tmp_path, pose=Pose(pitch_deg=4.0, roll_deg=-4.0, heading_deg=40.0))
    made.config = replaced(made.config, gradienter={"sigma_deg": 0.01})
    made.devices["gradienter"] = Gradienter(made.aircraft, seed=1, law="slope")
    async with made.running():
        await made.ready()
        result = await aligned(made, hands)
        assert result.outcome == "done"
        assert "the active zero agrees and has 0.010: kept" in result.reason
        assert made.service.calibrating.alignment.record is None
        assert any("better on flatter ground" in words for words in made.ground.texts())


async def moved(rig: Rig, hands: Hands, job: Job, stand: int, degrees: float) -> None:
    """Wait for the words that ask for that stand, and turn."""
    await rig.until(lambda: job.words.startswith(f"{stand} of") and "waiting for it to move" in job.words, 60.0)
    hands.turn(rig.aircraft.time_at(rig.now_s), degrees)


def test_it_outlives_a_restart_and_is_not_used_with_another_configuration(tmp_path: Path) -> None:
    made, hands = rig(tmp_path)

    async def measure() -> None:
        async with made.running():
            await made.ready()
            assert (await aligned(made, hands)).outcome == "done"

    run_virtual(measure())

    async def again(changes: dict[str, Any], words: str | None, *, forget: bool = False) -> tuple[float, Record | None]:
        fresh, _ = rig(tmp_path, placement_deg=0.0)
        fresh.config = replaced(fresh.config, gradienter=changes, calibration={"at_arm": "warn" if words else "off"})
        async with fresh.running():
            await fresh.ready()
            status = fresh.service.status()["alignment"]
            if words is None:
                assert status["in_force"] is True
            else:
                assert status["in_force"] is False
                assert words in status["unused_because"]
            stays_off = fresh.service.arming.automatic.why_not()
            result, record = await calibrated(fresh)
            assert result.outcome == "done", result
            assert (record.alignment is None) == (words is not None)
            for shown in (stays_off or "", fresh.service.status()["headline"]["reason"], " ".join(record.warnings)):
                assert ("alignment not used" in shown) == (words is not None)
            if forget:
                replies = [r async for r in fresh.service.faces.answer({"command": "align", "action": "forget"})]
                assert replies[-1]["state"] == "done"
                assert fresh.service.status()["alignment"] is None
                assert not (tmp_path / "alignment.json").exists()
            return worst_horizontal(record, fresh)[1], record

    assert run_virtual(again({}, None))[0] <= TARGET_MG
    sigma_mg, _ = run_virtual(again({"offset_deg": (0.1, -0.1)}, "another gradienter.offset_deg"))
    assert sigma_mg > 1.7
    run_virtual(again({"mounting": "ROTATION_YAW_180", "port": "/elsewhere"}, "gradienter.port, gradienter.mounting"))
    run_virtual(again({}, None, forget=True))


async def test_a_mounting_that_contradicts_the_turn_is_not_trusted(tmp_path: Path) -> None:
    made, hands = rig(tmp_path)
    made.config = replaced(made.config, gradienter={"mounting": "ROTATION_YAW_90"})
    async with made.running():
        await made.ready()
        result = await aligned(made, hands)
        assert result.outcome == "failed"
        assert "gradienter not trusted" in made.service.status()["warnings"][0]
        refused = made.service.calibrating.manager.start_calibration(What.BOTH, "test")
        assert isinstance(refused, Refusal)
        assert refused.reason.startswith("gradienter not trusted")
        job = started(made.service.calibrating.manager.start_calibration(What.GYROS, "test"))
        assert (await job.finished).outcome == "done"
        headline = made.service.status()["headline"]
        assert headline["tone"] != "good"
        assert "gradienter not trusted" in headline["reason"]
        assert headline["remedy"].startswith("Correct both"), "there may be nothing to undo"


async def test_armed_in_the_middle_it_ends(tmp_path: Path) -> None:
    made, _ = rig(tmp_path)

    async with made.running():
        await made.ready()
        job = started(made.service.calibrating.start_alignment(Align(action="zero"), "test"))
        await made.until(lambda: "measuring" in job.words, 60.0)
        made.double.arm()
        result = await job.finished
        assert result.outcome == "failed"
        assert "armed during the alignment" in result.reason
        refused = made.service.calibrating.start_alignment(Align(action="zero"), "test")
        assert isinstance(refused, Refusal)
        assert refused.kind == "armed"


@pytest.mark.parametrize("told", [True, False])
async def test_offsets_that_somebody_changes_in_between_are_noticed(tmp_path: Path, told: bool) -> None:
    made, hands = rig(tmp_path)

    async with made.running():
        await made.ready()
        job = started(made.service.calibrating.start_alignment(Align(action="zero"), "test"))
        await made.until(lambda: "waiting for it to move" in job.words, 60.0)
        if told:
            made.double.write_as_another_station(offset_names(1, "accel")[0], 0.03)
        else:
            made.double.set_parameter(offset_names(1, "accel")[0], 0.03)
            await moved(made, hands, job, 2, 180.0)
            await moved(made, hands, job, 3, 180.0)
        result = await job.finished
        assert result.outcome == "failed"
        assert "were changed in between: align again" in result.reason
        assert made.service.calibrating.alignment.record is None
