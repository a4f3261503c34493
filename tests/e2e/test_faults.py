"""Faults around a write that neither the campaign nor a unit test shows.

The campaign (tests/campaign) plays each fault in each phase; tests/unit/autopilot/test_writer.py and
tests/unit/daemon/test_ledger.py show how old values are restored.
"""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from companion.component.service import Refusal
from companion.daemon.job import Job
from companion.daemon.poses.measuring import Measuring
from companion.estimation.machine import What
from companion.estimation.means.windows import Window
from companion.storage.changes import Changed, ChangeLog, ChangeSet
from sim.ardupilot.double import ArduPilotDouble
from sim.ardupilot.parameters import offset_names
from sim.imu_model import DEG_H
from tests.e2e.test_calibration import FC_PARAMETERS, calibrated
from tests.support.rig import Rig


def values(double: ArduPilotDouble) -> dict[str, float]:
    return {name: double.parameter(name) for name in FC_PARAMETERS}


@pytest.mark.parametrize("after", [0.0025, None])
async def test_a_write_interrupted_on_another_aircraft_is_named_and_nothing_of_it_put_back_here(
    tmp_path: Path, after: float | None
) -> None:
    names = offset_names(1, "gyro")
    changes = tuple(Changed(name, before=0.0, after=after) for name in names)
    ChangeLog(tmp_path).journal.write(ChangeSet(7, changes))

    async with Rig(tmp_path, parameters=dict.fromkeys(names, 0.0025)).running() as rig:
        await rig.until(lambda: not rig.service.offsets.journal.pending, 60.0)
        await asyncio.sleep(2.0)
        assert rig.double.writes == []
        assert any("Interrupted write on system 7" in text for text in rig.ground.texts())


async def test_an_interrupted_write_waits_while_armed_without_trying(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    names = offset_names(1, "gyro")
    changes = tuple(Changed(name, before=0.0, after=0.0025) for name in names)
    ChangeLog(tmp_path).journal.write(ChangeSet(1, changes))

    rig = Rig(tmp_path, parameters=dict.fromkeys(names, 0.0025))
    rig.double.arm()
    async with rig.running():
        await asyncio.sleep(15.0)
        assert rig.double.writes == []
        assert rig.service.offsets.journal.pending
        assert not any("trying again" in words for words in caplog.messages)
        rig.double.disarm()
        await rig.until(lambda: not rig.service.offsets.journal.pending, 20.0)
        assert [rig.double.parameter(name) for name in names] == [0.0, 0.0, 0.0]


async def test_offsets_that_change_unheard_after_the_measurement_are_measured_under_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The daemon reads the offsets again before it writes: biases measured under other offsets would be wrong."""

    async with Rig(tmp_path, max_s=12.0).running() as rig:
        await rig.ready()
        measure, windows = Measuring.measure, list[Window]()

        async def changing(measuring: Measuring, job: Job) -> Window:
            windows.append(await measure(measuring, job))
            if len(windows) == 1:
                rig.double.set_parameter("INS_GYROFFS_X", rig.double.parameter("INS_GYROFFS_X") + 0.002)
            return windows[-1]

        monkeypatch.setattr(Measuring, "measure", changing)
        result, _ = await calibrated(rig)
        assert result.outcome == "done", result
        assert len(windows) == 2
        left = rig.double.residual(1, rig.now_s)
        assert max(abs(each) for each in left.gyro_rad_s) < 60.0 * DEG_H


async def test_a_storage_that_cannot_be_written_refuses_with_the_reason_before_anything_is_measured(
    tmp_path: Path,
) -> None:
    (tmp_path / "file").write_text("in the way")

    async with Rig(tmp_path / "file").running() as rig:
        await rig.until(lambda: rig.service.core.vehicle.alive, 10.0)
        refusal = rig.service.calibrating.manager.start_calibration(What.BOTH, "test")
        assert isinstance(refusal, Refusal)
        assert "cannot be written" in refusal.reason
        assert rig.service.calibrating.manager.mav_state == 5  # MAV_STATE_CRITICAL
