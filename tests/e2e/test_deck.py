"""A calibration on a deck, from the request to offsets seen in the telemetry: the whole daemon on virtual time."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path
from typing import Any

import numpy as np

from companion.commands import Align
from companion.component.service import Refusal
from companion.estimation.machine import What
from companion.lab.replay import replay
from sim.imu_model import DEG_H, MG
from sim.motions import DAY_S, Sea, SlowTurn, Wave
from tests.e2e.test_arm_gate import AUTHORISED_BY_US, texts, try_to_arm
from tests.e2e.test_calibration import started
from tests.e2e.test_record_replay import ring, same
from tests.support.rig import Rig

DECK = '[vehicle]\nplatform = "deck"\n'
BOAT = (Sea(start_s=-20.0, waves=(Wave(0.2, 5.0), Wave(0.05, 1.0)), seed=4),)
TURNING = (*BOAT, SlowTurn(start_s=-20.0, duration_s=DAY_S, rate_deg_s=0.3))


def boat(folder: Path, motions: Any = TURNING, more: str = DECK, **rest: Any) -> Rig:
    rig = Rig(folder, more=more, **{"imu_rate_hz": 50.0, **rest})
    for motion in motions:
        rig.aircraft.add(motion)
    return rig


async def test_a_boat_is_calibrated_while_it_sways_and_turns(tmp_path: Path) -> None:
    async with boat(tmp_path).running() as rig:
        await rig.ready()
        rig.service.core.wanted.retarget(target_gyro_sigma_rad_s=20 * DEG_H, target_accel_sigma_m_s2=0.5 * MG)
        job = started(rig.service.calibrating.manager.start_calibration(What.BOTH, "test", 900.0))
        result = await job.finished
        record = job.record
        assert record is not None
        assert result.outcome == "done", result
        said = rig.ground.texts()
        assert any(re.fullmatch(r"At least \d+ s more", words) for words in said), said
        imu = record.imus[0]
        assert {one.outcome for one in imu.written.values()} == {"verified"}
        assert imu.gyro_sigma_use_rad_s is not None
        assert max(imu.gyro_sigma_use_rad_s) <= 20 * DEG_H
        left = rig.double.residual(1, rig.now_s)
        assert np.abs(left.gyro_rad_s).max() < 40 * DEG_H
        assert np.abs(left.accel_m_s2).max() < 1.0 * MG
        # The firmware's own gyro calibration would have taken the deck's rate for the bias of every gyro.
        assert rig.double.parameters.values["INS_GYR2OFFS_X"] == 0.0


async def test_px4_on_a_boat_is_calibrated_by_itself_and_then_arms(tmp_path: Path) -> None:
    # Its own gyro calibration would take the boat's turn for a bias.
    parameters = {**AUTHORISED_BY_US, "IMU_GYRO_CAL_EN": 0.0}
    async with boat(tmp_path, firmware="px4", at_arm="gate", parameters=parameters, imu_rate_hz=25.0).running() as rig:
        await rig.ready()
        rig.service.core.wanted.retarget(target_gyro_sigma_rad_s=20 * DEG_H, target_accel_sigma_m_s2=0.5 * MG)
        readiness = rig.service.arming.readiness
        said: set[str] = set()

        def accepts() -> bool:
            answer = readiness.answer()
            said.add(answer.words)
            return answer.verdict == "accept"

        await rig.until(lambda: readiness.answer().words.startswith("wait: at least"), 30.0)
        assert await try_to_arm(rig) == 1
        assert "Not armed: wait: at least" in texts(rig)
        await rig.until(accepts, 200.0)
        # Nobody can hold a boat still, and a sway that turns back is no end of a range.
        assert not any("still" in words or "range" in words for words in said), said
        left = rig.px4.residual(1, rig.now_s)
        assert np.abs(left.gyro_rad_s).max() < 40 * DEG_H
        assert np.abs(left.accel_m_s2).max() < 1.0 * MG
        assert await try_to_arm(rig) == 0
        assert "Armed: calibrated" in texts(rig)


async def test_a_replay_on_a_deck_gives_the_same_records(tmp_path: Path) -> None:
    async with boat(
        tmp_path, more=f"{DECK}[push]\nparameters = false\n", recordings_mb=64, imu_rate_hz=25.0
    ).running() as rig:
        await rig.ready()
        rig.service.core.wanted.retarget(target_gyro_sigma_rad_s=20 * DEG_H, target_accel_sigma_m_s2=0.5 * MG)
        for _ in range(2):
            job = started(rig.service.calibrating.manager.start_calibration(What.BOTH, "test", 300.0))
            result = await job.finished
            assert result.outcome == "done", result
            await asyncio.sleep(40.0)
    records = rig.service.calibrating.store.history()[::-1]
    assert len(records) == 2
    same(replay(ring(tmp_path)), records)


async def test_no_zero_of_a_gradienter_is_measured_on_a_deck(tmp_path: Path) -> None:
    async with boat(tmp_path).running() as rig:
        await rig.ready()
        refused = rig.service.calibrating.start_alignment(Align(action="zero", timeout_s=60.0), "test")
        assert isinstance(refused, Refusal)
        assert "ashore" in refused.reason
