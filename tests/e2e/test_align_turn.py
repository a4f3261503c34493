"""`companion align turn` on the whole daemon: an autopilot alone, turned on a spot that slopes."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.cli.client import pose_lines
from companion.commands import Align
from companion.component.service import Refusal
from companion.daemon.job import Job
from companion.estimation.records.align_record import TurnRecord
from sim.aircraft import Pose
from sim.ardupilot.parameters import offset_names
from sim.earth import mounting_matrix
from sim.hands import Hands
from sim.imu_model import MG
from sim.px4.calibration import SensorCalibration
from tests.e2e.test_calibration import calibrated, started
from tests.support.by_hand import NOTHING, Meddle, alone, follow
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

STEEP = Pose(pitch_deg=4.0, roll_deg=-3.0, heading_deg=40.0)
FLAT = Pose(pitch_deg=0.4, roll_deg=-0.3, heading_deg=40.0)
TARGET_MG = 0.25


def rig(folder: Path, pose: Pose, firmware: str = "ardupilot", **more: Any) -> tuple[Rig, Hands]:
    return alone(folder, placement_deg=0.02, pose=pose, firmware=firmware, **{"imu_rate_hz": 25.0} | more)


FACES = {"action": "faces", "write": True, "timeout_s": 2000.0}


def turn(rig: Rig, headings: int, *, write: bool) -> Job:
    wanted = {"action": "turn", "headings": headings, "write": write}
    return started(rig.service.calibrating.start_alignment(Align.read(wanted), "test"))


async def turned(rig: Rig, hands: Hands, headings: int, *, write: bool, meddle: Meddle = NOTHING) -> TurnRecord:
    job = turn(rig, headings, write=write)
    result = await follow(rig, hands, job, meddle)
    assert result.outcome == "done", result
    assert isinstance(job.product, TurnRecord)
    return job.product


def true_mg(rig: Rig) -> Any:
    """True biases of the first IMU, whose board is aligned with the aircraft."""
    return rig.model.true_bias(rig.aircraft.time_at(rig.now_s)).accel_m_s2 / MG


def residual_mg(rig: Rig, record: TurnRecord) -> Any:
    """Bias left in the output: an offset of 0.001 m/s^2 was active."""
    (imu,) = record.imus
    before = [one.before for one in imu.written.values()] if imu.written else [0.001] * 3
    return true_mg(rig) - np.array(before) / MG


async def test_the_level_is_found_on_a_slope_and_written(tmp_path: Path) -> None:
    made, hands = rig(tmp_path, STEEP)

    async with made.running():
        await made.ready()
        names = offset_names(1, "accel")
        old = [made.double.parameter(name) for name in names]
        record = await turned(made, hands, 2, write=True)
        assert made.service.calibrating.manager.reason.endswith("written")
        assert record.checked
        assert record.slope_deg == pytest.approx(float(np.hypot(STEEP.pitch_deg, STEEP.roll_deg)), abs=0.06)
        (imu,) = record.imus
        sigma = np.array(imu.level_sigma_mg)[:2]
        # How the board leans across the slope is left open by half a turn.
        assert sigma.max() < 1.5 * TARGET_MG
        assert not any("the same way" in warning for warning in record.warnings)
        off = np.abs(np.subtract(imu.level_bias_mg, residual_mg(made, record)))[:2]
        assert (off < 2.5 * sigma).all()
        assert {one.outcome for one in imu.written.values()} == {"verified"}
        written = np.array([made.double.parameter(name) for name in names]) / MG
        assert (np.abs(written - true_mg(made))[:2] < 2.5 * sigma).all()
        undone = made.service.calibrating.manager.start_undo("test")
        assert not isinstance(undone, Refusal)
        assert (await undone.finished).outcome == "done"
        assert [made.double.parameter(name) for name in names] == old


def late(made: Rig, seconds: float) -> None:
    """ATTITUDE is so old when it is sent, as on a line with more to say than it can."""
    now, kept = made.double.estimated_angles_rad, list[tuple[float, tuple[float, float, float]]]()

    def then(loop_s: float) -> tuple[float, float, float]:
        kept.append((loop_s, now(loop_s)))
        while len(kept) > 1 and kept[1][0] <= loop_s - seconds:
            del kept[0]
        return kept[0][1]

    made.double.estimated_angles_rad = then  # type: ignore[method-assign]


def test_with_all_sides_known_the_boards_tilt_is_written_on_a_slope_and_a_restart_does_not_forget(
    tmp_path: Path,
) -> None:
    """A board that sits 1.2 deg to the right and 0.8 deg nose down; the spot slopes by 5 deg."""
    board_deg = (1.2, -0.8, 0.0)
    first, hand = rig(tmp_path, FLAT, mounting_deg=board_deg)

    async def sides() -> None:
        async with first.running():
            await first.ready()
            refused = first.service.calibrating.start_alignment(Align(action="turn", level=True), "test")
            assert isinstance(refused, Refusal)
            assert "align faces --write first" in refused.reason
            job = started(first.service.calibrating.start_alignment(Align.read(FACES), "test"))
            result = await follow(first, hand, job)
            assert result.outcome == "done", result

    async def level() -> None:
        names = (*offset_names(1, "accel"), *offset_names(1, "scale"))
        offsets = {name: float(first.double.parameter(name) or 0.0) for name in names}
        made, hands = rig(tmp_path, STEEP, mounting_deg=board_deg, parameters=offsets)
        late(made, 6.0)
        async with made.running():
            await made.ready()
            result, calibration = await calibrated(made)
            assert result.outcome == "done", result
            job = started(made.service.calibrating.start_alignment(Align(action="turn", level=True), "test"))
            result = await follow(made, hands, job)
            assert result.outcome == "done", result
            record = job.product
            assert isinstance(record, TurnRecord)
            assert record.board is not None
            assert max(record.board.sigma_deg) < 0.03
            # With all sides known it is no bias that a level base would show.
            (line,) = [words for words in pose_lines(msgspec.to_builtins(record)) if "when level" in words]
            assert line.startswith("  slant when level ")
            up = mounting_matrix(*board_deg).T @ np.array([0.0, 0.0, -1.0])
            true_deg = np.degrees([np.arctan2(-up[1], -up[2]), np.arcsin(up[0])])
            trim = np.degrees([made.double.parameter("AHRS_TRIM_X"), made.double.parameter("AHRS_TRIM_Y")])
            np.testing.assert_allclose(trim, true_deg, atol=0.05)
            assert (np.abs(trim - true_deg) < 3.0 * np.array(record.board.sigma_deg)).all()
            assert set(record.board.written) == {"AHRS_TRIM_X", "AHRS_TRIM_Y"}
            assert {one.outcome for one in record.board.written.values()} == {"verified"}
            assert offsets == {name: made.double.parameter(name) for name in offsets}, "offsets stay as they are"
            undone = made.service.calibrating.manager.start_undo("test")
            assert not isinstance(undone, Refusal)
            assert (await undone.finished).outcome == "done"
            assert made.double.parameter("AHRS_TRIM_X") == made.double.parameter("AHRS_TRIM_Y") == 0.0
            # What was calibrated before it is in force as it was.
            assert made.service.arming.in_force.calibration == calibration
            assert [one.undone_at for one in made.service.calibrating.store.history()] == [None]
            assert not any("undone" in words for words in made.ground.texts())

    run_virtual(sides())
    run_virtual(level())


async def test_px4s_board_is_levelled_on_a_slope_seen_in_its_telemetry_and_undone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A board that sits 1.2 deg to the right and 0.8 deg nose down; its attitude follows only after a restart."""
    board_deg = (1.2, -0.8, 0.0)
    made, hands = rig(tmp_path, FLAT, "px4", mounting_deg=board_deg, parameters={"SENS_BOARD_X_OFF": 0.3})
    names = ("SENS_BOARD_X_OFF", "SENS_BOARD_Y_OFF")

    async with made.running():
        await made.ready()
        old = {name: made.autopilot.parameter(name) for name in ("CAL_ACC0_XOFF", "CAL_ACC0_YOFF", "CAL_ACC0_ZOFF")}
        result = await follow(made, hands, started(made.service.calibrating.start_alignment(Align.read(FACES), "test")))
        assert result.outcome == "done", result
        hands.spot(made.aircraft.time_at(made.now_s), STEEP.pitch_deg, STEEP.roll_deg)
        await asyncio.sleep(15.0)
        with monkeypatch.context() as patched:
            patched.setattr(SensorCalibration, "_set_rotation", lambda *_: None)
            result = await follow(
                made, hands, started(made.service.calibrating.start_alignment(Align(action="turn", level=True), "test"))
            )
        assert result.outcome == "failed"
        assert result.reason == "the attitude did not follow the new level, or the aircraft moved; old values restored"
        assert made.autopilot.parameter(names[0]) == pytest.approx(0.3)
        job = started(made.service.calibrating.start_alignment(Align(action="turn", level=True), "test"))
        result = await follow(made, hands, job)
        assert result.outcome == "done", result
        record = job.product
        assert isinstance(record, TurnRecord)
        assert record.board is not None
        up = mounting_matrix(*board_deg).T @ np.array([0.0, 0.0, -1.0])
        true_deg = np.degrees([np.arctan2(-up[1], -up[2]), np.arcsin(up[0])])
        written = [made.autopilot.parameter(name) for name in names]
        np.testing.assert_allclose(written, true_deg, atol=0.05)
        assert {one.outcome for one in record.board.written.values()} == {"verified"}
        assert made.service.offsets.owed.words == "reboot PX4: tilt 1.2 deg off"
        assert made.service.status()["headline"]["word"] != "READY"
        undone = made.service.calibrating.manager.start_undo("test")
        assert not isinstance(undone, Refusal)
        assert (await undone.finished).outcome == "done"
        assert [made.autopilot.parameter(name) for name in names] == pytest.approx([0.3, 0.0])
        undone = made.service.calibrating.manager.start_undo("test")
        assert not isinstance(undone, Refusal)
        assert (await undone.finished).reason.endswith("old values restored: faces")
        assert {name: made.autopilot.parameter(name) for name in old} == old
