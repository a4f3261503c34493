"""Calibrations that nobody asked for: when they start, when they do not, and who comes first."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.component.service import Refusal
from companion.daemon.arming import automatic
from companion.daemon.job import Job
from companion.estimation.machine import State, What
from sim.imu_model import DEG_H, MG
from tests.e2e.test_calibration import FC_PARAMETERS
from tests.support.component import ACCEPTED, CALIBRATE, CANCEL, CANCELLED, UNDO
from tests.support.rig import Rig

START_WITHIN_S = 100.0
SLOW: dict[str, Any] = {"imu_rate_hz": 10.0, "device_rate_hz": 2.0, "feed_s": 0.5}
"""Streams for tests that last for minutes."""


def values(rig: Rig) -> dict[str, float]:
    return {name: rig.double.parameter(name) for name in FC_PARAMETERS}


async def calibrated_by_itself(rig: Rig, more: int = 1) -> None:
    """Wait until so many automatic calibrations have been done."""
    await rig.until(lambda: len(rig.service.calibrating.store.history()) >= more, START_WITHIN_S)
    record = rig.service.calibrating.store.history(1)[0]
    assert record.state == "done", record


async def started_by_itself(rig: Rig) -> Job:
    """Wait until an automatic calibration verifies what it wrote."""
    await rig.until(lambda: rig.service.calibrating.manager.state is State.VERIFYING, START_WITHIN_S)
    job = rig.service.calibrating.manager.job
    assert job is not None
    assert job.automatic
    return job


async def test_it_calibrates_at_the_first_opportunity_after_start_and_says_one_line(tmp_path: Path) -> None:
    async with Rig(tmp_path, at_arm="gate").running() as rig:
        await rig.until(lambda: rig.service.status()["headline"]["word"].startswith("HOLD STILL"), 10.0)
        assert rig.service.status()["headline"]["remedy"] == "", "there is nothing to press"
        await calibrated_by_itself(rig)
        left = rig.double.residual(1, rig.now_s)
        assert np.abs(left.gyro_rad_s).max() < 20 * DEG_H
        assert np.abs(left.accel_m_s2).max() < 0.3 * MG
        await asyncio.sleep(3.0)
        said = [text for text in rig.ground.texts() if "calibration" in text]
        assert len(said) == 1
        assert said[0].startswith("Auto calibration done: sigma")
        assert len(said[0]) <= 50
        assert rig.double.buzzer.heard == [], "nobody asked for it"


@pytest.mark.parametrize("more", [{"at_arm": "off"}, {"at_arm": "gate", "more": "[push]\nparameters = false\n"}])
async def test_nothing_happens_by_itself_with_at_arm_off_or_without_push(tmp_path: Path, more: dict[str, Any]) -> None:
    async with Rig(tmp_path, **more, **SLOW).running() as rig:
        await asyncio.sleep(120.0)
        assert rig.double.writes == []
        assert rig.service.calibrating.store.history() == []


async def test_offsets_that_are_right_already_are_not_written_again_after_a_restart_of_the_companion(
    tmp_path: Path,
) -> None:
    rig = Rig(tmp_path, at_arm="gate", **SLOW)
    async with rig.running():
        await calibrated_by_itself(rig)
    writes = len(rig.double.writes)
    again = Rig(tmp_path / "again", at_arm="gate", parameters=values(rig), **SLOW)
    async with again.running():
        await again.until(lambda: again.service.arming.readiness.answer().verdict == "accept", START_WITHIN_S)
        assert "offsets checked" in again.service.arming.readiness.answer().words
        await asyncio.sleep(120.0)
        assert again.double.writes == []
    assert writes == 9, "six offsets, and the gyros' again over the firmware's own calibration"


async def test_a_boot_with_ins_gyr_cal_1_throws_the_values_away_and_they_are_pushed_again(tmp_path: Path) -> None:
    async with Rig(tmp_path, at_arm="warn", parameters={"INS_GYR_CAL": 1.0}, **SLOW).running() as rig:
        await calibrated_by_itself(rig)
        first = values(rig)
        rig.double.reboot()
        await rig.until(lambda: rig.service.core.vehicle.boots == 1, 10.0)
        await rig.until(lambda: rig.service.arming.in_force.reading() is None, 20.0)
        await asyncio.sleep(0.5)
        assert values(rig)["INS_GYROFFS_X"] != first["INS_GYROFFS_X"]
        rig.double.arm()  # what is said in between must not claim our calibration
        await rig.until(lambda: any("Armed" in text for text in rig.ground.texts()), 5.0)
        assert rig.ground.texts()[-1].startswith("Armed UNCALIBRATED: boot reset gyro offsets")
        rig.double.disarm()
        await calibrated_by_itself(rig, more=2)
        left = rig.double.residual(1, rig.now_s)
        assert np.abs(left.gyro_rad_s).max() < 20 * DEG_H


async def test_values_changed_by_another_station_are_shown_and_not_overwritten(tmp_path: Path) -> None:
    async with Rig(tmp_path, at_arm="gate", **SLOW).running() as rig:
        await calibrated_by_itself(rig)
        await asyncio.sleep(2.0)
        rig.double.write_as_another_station("INS_GYROFFS_X", 0.01)
        await asyncio.sleep(90.0)
        assert rig.double.parameter("INS_GYROFFS_X") == np.float32(0.01)
        assert len(rig.service.calibrating.store.history()) == 1
        said = " | ".join(rig.ground.texts())
        assert "Auto calibration off until asked: fc was changed" in said
        answer = rig.service.arming.readiness.answer()
        assert answer.verdict == "refuse"
        assert "changed by someone else" in answer.words
        # A request is a request: it calibrates, and from then on it goes on by itself.
        job = rig.service.calibrating.manager.start_calibration(What.BOTH, "test")
        assert isinstance(job, Job)
        await job.finished
        assert rig.service.arming.automatic.stopped is None
        await rig.until(lambda: rig.service.arming.readiness.answer().verdict == "accept", 10.0)


async def test_a_change_that_nobody_announced_is_found_before_anything_is_written_over_it(tmp_path: Path) -> None:
    async with Rig(tmp_path, at_arm="gate", **SLOW).running() as rig:
        await rig.ready()
        await asyncio.sleep(5.0)
        rig.double.set_parameter("INS_ACCOFFS_X", 0.02)  # no PARAM_VALUE goes out
        await asyncio.sleep(90.0)
        assert rig.double.parameter("INS_ACCOFFS_X") == np.float32(0.02)
        assert rig.double.writes == []
        assert rig.service.arming.automatic.stopped is not None


async def test_after_an_undo_nothing_is_written_until_the_next_request(tmp_path: Path) -> None:
    async with Rig(tmp_path, at_arm="gate", **SLOW).running() as rig:
        before = values(rig)
        await calibrated_by_itself(rig)
        rig.ground.command(CALIBRATE, 0.0)
        await rig.until(lambda: rig.ground.finals(CALIBRATE) == [ACCEPTED], 60.0)
        assert not rig.service.calibrating.store.history()[0].written, "the last result is not the one to be undone"
        rig.ground.command(UNDO)
        await rig.until(lambda: rig.ground.finals(UNDO) == [ACCEPTED], 30.0)
        await asyncio.sleep(120.0)
        assert values(rig) == before
        assert "Auto calibration off until asked: undone" in " | ".join(rig.ground.texts())
        assert rig.service.arming.readiness.answer().words == "calibration was undone: calibrate"
        assert rig.service.arming.readiness.answer().verdict == "refuse"
        assert rig.service.status()["automatic"]["stopped"] == "undone"
    async with Rig(tmp_path, at_arm="gate", **SLOW).running() as rig:  # the companion starts again
        await rig.ready()
        await asyncio.sleep(120.0)
        assert rig.double.writes == []
        assert rig.service.status()["automatic"]["stopped"] == "undone"
        manager = rig.service.calibrating.manager
        assert manager.last_good is None, "what was measured with the undone offsets is void"
        job = manager.start_calibration(What.BOTH, "test")
        assert isinstance(job, Job)
        job.cancel("test")
        await job.finished
        assert rig.service.status()["automatic"]["stopped"] == "undone"
        rig.ground.command(CALIBRATE, 0.0)
        await rig.until(lambda: rig.ground.finals(CALIBRATE) == [ACCEPTED], 60.0)
        await rig.until(lambda: rig.service.arming.readiness.answer().verdict == "accept", 15.0)


async def test_a_request_during_an_automatic_calibration_takes_it_over_and_gets_its_final(tmp_path: Path) -> None:
    async with Rig(tmp_path, at_arm="gate", **SLOW).running() as rig:
        job = await started_by_itself(rig)
        rig.ground.command(CALIBRATE, 0.0)
        await rig.until(lambda: rig.ground.finals(CALIBRATE) != [], 30.0)
        assert rig.ground.finals(CALIBRATE) == [ACCEPTED]
        assert rig.ground.acks(CALIBRATE)[0] == 5  # IN_PROGRESS
        assert not job.automatic
        assert len(rig.service.calibrating.store.history()) == 1
        await asyncio.sleep(2.0)
        assert any(text.startswith("Calibration done") for text in rig.ground.texts())


async def test_an_undo_during_an_automatic_calibration_takes_that_one_back(tmp_path: Path) -> None:
    async with Rig(tmp_path, at_arm="gate", **SLOW).running() as rig:
        before = values(rig)
        await started_by_itself(rig)
        rig.ground.command(UNDO)
        await rig.until(lambda: rig.ground.finals(UNDO) != [], 30.0)
        assert rig.ground.finals(UNDO) == [ACCEPTED]
        assert values(rig) == before
        await asyncio.sleep(60.0)
        assert values(rig) == before


async def test_cancelling_an_automatic_calibration_ends_it_for_good(tmp_path: Path) -> None:
    async with Rig(tmp_path, at_arm="gate", **SLOW).running() as rig:
        before = values(rig)
        await started_by_itself(rig)
        rig.ground.command(CANCEL)
        await rig.until(lambda: rig.ground.finals(CANCEL) == [ACCEPTED], 10.0)
        await asyncio.sleep(90.0)
        assert values(rig) == before
        assert rig.service.arming.automatic.stopped == "cancelled"
        assert CANCELLED not in rig.ground.acks(CALIBRATE)


async def test_a_cancel_after_a_restart_leaves_the_offsets_from_before_in_the_headline(tmp_path: Path) -> None:
    async with Rig(tmp_path, at_arm="warn", **SLOW).running() as rig:
        await calibrated_by_itself(rig)
        await rig.restart()
        await rig.until(lambda: rig.service.calibrating.manager.blocking_reason() is None, 10.0)
        job = rig.service.calibrating.manager.start_calibration(What.BOTH, "test")
        assert isinstance(job, Job)
        job.cancel("test")
        await job.finished
        at = rig.service.calibrating.store.history()[0].started_at[:16].replace("T", " ")
        words = f"not confirmed since start (the autopilot has the offsets of {at} UTC): calibrates by itself in 5 min"
        await rig.until(lambda: rig.service.status()["headline"]["reason"] == words, 15.0)


async def test_failures_are_not_repeated_for_ever(tmp_path: Path) -> None:
    async with Rig(tmp_path, at_arm="gate", max_s=12.0, **SLOW).running() as rig:
        rig.double.faults.echo_without_effect = True
        await asyncio.sleep(500.0)
        history = rig.service.calibrating.store.history()
        assert [record.state for record in history] == ["failed"] * automatic.FAILURES
        assert rig.service.arming.automatic.stopped is not None
        assert rig.service.arming.readiness.answer().verdict == "refuse"


async def test_the_writes_of_a_day_are_bounded_also_over_restarts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(automatic, "PER_DAY", 2)

    for expected in (1, 2, 2):
        rig = Rig(tmp_path, at_arm="gate", max_s=12.0, **SLOW)  # an autopilot as it was: its offsets are wrong again
        async with rig.running():
            await asyncio.sleep(40.0)
            assert rig.service.arming.automatic.status()["writes_today"] == expected
            answer = rig.service.arming.readiness.answer()
            assert len(rig.service.calibrating.store.history()) == expected
    assert answer.verdict == "refuse"
    assert "2 writes today" in answer.words


async def test_a_check_starts_nothing(tmp_path: Path) -> None:
    async with Rig(tmp_path, at_arm="gate", **SLOW).running() as rig:
        rig.service.core.only_listening = "only a check is running"
        await asyncio.sleep(60.0)
        assert rig.double.writes == []
        manager = rig.service.calibrating.manager
        for answer in (manager.start_calibration(What.BOTH, "test"), manager.start_undo("test")):
            assert isinstance(answer, Refusal)
            assert "only a check is running" in answer.reason
