"""`companion align faces` on the whole daemon: an autopilot alone, held on every side by hand."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.cli.client import pose_lines
from companion.cli.show import status_lines
from companion.commands import Align
from companion.component.service import Refusal
from companion.daemon.job import Job
from companion.daemon.poses.alignment import ByHand
from companion.estimation.machine import What
from companion.estimation.records.align_record import FacesRecord
from companion.estimation.records.record import Record
from sim.ardupilot.parameters import offset_names
from sim.hands import Hands
from sim.imu_model import MG
from tests.e2e.test_calibration import calibrated, started
from tests.e2e.test_page import Watch
from tests.support.by_hand import alone, follow
from tests.support.rig import ACCEL_BIAS_MG, Rig

SCALES = {"INS_ACCSCAL_X": 1.004, "INS_ACCSCAL_Y": 0.997, "INS_ACCSCAL_Z": 1.002}


def rig(folder: Path, **more: Any) -> tuple[Rig, Hands]:
    """An aircraft with wrong scales whose offsets have never been measured."""
    options: dict[str, Any] = {"imu_rate_hz": 10.0, "parameters": SCALES} | more
    return alone(folder, propped_deg=4.0, **options)


def faced(rig: Rig, *, write: bool) -> Job:
    wanted = {"action": "faces", "write": write, "timeout_s": 120.0}  # of each pose, not of all
    return started(rig.service.calibrating.start_alignment(Align.read(wanted), "test"))


def read(rig: Rig, what: str) -> np.ndarray[Any, Any]:
    return np.array([rig.double.parameter(name) for name in offset_names(1, what)])  # type: ignore[arg-type]


def accel_sigma_mg(rig: Rig) -> Any:
    return rig.service.status()["arming"]["quality"]["accel"]["sigma"]


async def test_bias_and_scale_are_measured_written_seen_and_undone_to_the_bit(tmp_path: Path) -> None:
    offsets = dict(zip(offset_names(1, "accel"), (0.1, -0.08, 0.05), strict=True))
    made, hands = rig(tmp_path, parameters=SCALES | offsets)

    async with made.running():
        await made.ready()
        assert (await calibrated(made, What.GYROS))[0].outcome == "done"  # its biases end with the new scales
        old = {name: made.double.parameter(name) for what in ("accel", "scale") for name in offset_names(1, what)}
        watch, job = Watch(made), faced(made, write=True)
        result = await follow(made, hands, job)
        assert result.outcome == "done", result
        assert result.reason.endswith(": written")
        big = (await watch.stop())[-6:-1]
        assert big == ["TURN IT", "HOLD STILL", "MEASURING", "WRITING", "CHECKING"]
        status = made.service.status()
        stands, (step, _) = status["stands"], status["undoable"]
        assert (stands["what"], stands["write"], stands["outcome"], step["before"]) == ("faces", True, "done", old)
        assert stands["number"] == stands["total"] == len(stands["done"]), "the last pose is seen as the last"
        record = job.product
        assert isinstance(record, FacesRecord)
        assert 10 <= sum(one.seconds < 10.0 for one in record.stands) <= 13, "all but the first pose are short"
        (imu,) = record.imus
        assert not imu.left_out
        # With scales undone the sensor is what it is: a bias, and nothing wrong with its scale.
        np.testing.assert_allclose(read(made, "scale"), 1.0, atol=2e-4)
        true_mg = made.model.true_bias(made.aircraft.time_at(made.now_s)).accel_m_s2 / MG
        np.testing.assert_allclose(read(made, "accel") / MG, true_mg, atol=0.15)
        assert np.abs(true_mg - ACCEL_BIAS_MG).max() < 0.2
        # What is told is what was written, the whole; and beside it what of that is new.
        assert imu.whole_bias_mg is not None
        np.testing.assert_allclose(imu.whole_bias_mg, true_mg, atol=0.15)
        (bias, change) = [line for line in pose_lines(msgspec.to_builtins(record)) if " mg   " in line]
        assert f"x {imu.whole_bias_mg[0]:+.3f} +- " in bias
        told_mg = [float(value) for value in re.findall(r"[xyz] ([-+][\d.]+)", change)]
        np.testing.assert_allclose(told_mg, true_mg - np.array(list(offsets.values())) / MG, atol=0.2)
        wrong = np.array(list(SCALES.values())) - 1.0
        np.testing.assert_allclose(imu.accel_scale.value, wrong, atol=2e-4)
        assert {one.outcome for one in imu.written.values()} == {"verified"}
        assert set(imu.written) == set(old)
        (shown,) = made.service.status()["by_hand"]
        assert (shown["what"], shown["reason"], shown["in_force"]) == ("faces", result.reason, True)
        assert set(shown["written"]) == set(old)
        (answer,) = [one async for one in made.service.faces.answer({"command": "align", "action": "forget"})]
        assert answer["reason"].startswith("there was no zero to forget; the faces alignment stays")
        # A calibration of the gyros afterwards does not put them out of reach, nor warn of them.
        gyros = {name: made.double.parameter(name) for name in offset_names(1, "gyro")}
        made.service.calibrating.manager._ended = None  # or the gyros of just now count as calibrated
        done, after = await calibrated(made, What.GYROS)
        assert done.outcome == "done"
        assert not re.search("scale", " ".join([*after.warnings, *after.imus[0].warnings]))
        assert made.service.status()["stands"] is None, "somebody has started something else"
        left_mg = (read(made, "accel") - made.model.true_bias(made.aircraft.time_at(made.now_s)).accel_m_s2) / MG
        assert accel_sigma_mg(made) is not None
        assert np.abs(left_mg).max() / 4.0 < accel_sigma_mg(made) < 0.3
        for what in ("calibration", "faces"):
            undone = made.service.calibrating.manager.start_undo("test")
            assert not isinstance(undone, Refusal)
            result = await undone.finished
            assert result.reason.endswith(f"old values restored: {what}")
            assert {name: made.double.parameter(name) for name in gyros} == gyros
        assert accel_sigma_mg(made) is None
        assert (await calibrated(made, What.GYROS))[0].outcome == "done"
        lacks = "; accel not calibrated: companion align faces --write"
        await made.until(lambda: made.service.status()["headline"]["reason"].endswith(lacks), 10.0)
        assert {name: made.double.parameter(name) for name in old} == old
        again = ByHand(made.service.core, made.service.devices.imus)
        again.load()
        for kept in (made.service.calibrating.by_hand, again):
            (shown,) = kept.history()
            assert shown["undone_at"] is not None
            assert shown["in_force"] is False
        (words,) = [line for line in status_lines(made.service.status()) if line.startswith("by hand, ")]
        assert re.search(
            r" UTC: faces: accel bias known to .*: written; 6 parameters written, undone 20",
            words,
        )


async def test_who_asks_for_what_cannot_be_is_told_at_once(tmp_path: Path) -> None:
    made, _ = rig(tmp_path)
    made.config = msgspec.structs.replace(made.config, push=msgspec.structs.replace(made.config.push, parameters=False))

    async with made.running():
        await made.ready()
        refused = made.service.calibrating.start_alignment(Align(action="faces", write=True), "test")
        assert isinstance(refused, Refusal)
        assert "push.parameters is false" in refused.reason


async def test_px4s_offsets_and_scales_are_written_and_undone(tmp_path: Path) -> None:
    made, hands = rig(tmp_path, firmware="px4", parameters={}, accel_scale=(0.015, -0.012, 0.004))

    async with made.running():
        await made.ready()
        names = [f"CAL_ACC0_{axis}{what}" for what in ("OFF", "SCALE") for axis in "XYZ"]
        old = {name: made.autopilot.parameter(name) for name in names}
        job = faced(made, write=True)
        result = await follow(made, hands, job)
        assert result.outcome == "done", result
        record = job.product
        assert isinstance(record, FacesRecord)
        (imu,) = record.imus
        assert set(imu.written) == set(names)
        assert {one.outcome for one in imu.written.values()} == {"verified"}
        made.px4.reboot()
        await asyncio.sleep(20.0)
        hands.spot(made.aircraft.time_at(made.now_s), 0.0, 0.0)
        await asyncio.sleep(10.0)
        left_mg = np.array(made.autopilot.residual(1, made.now_s).accel_m_s2) / MG
        np.testing.assert_allclose(left_mg, 0.0, atol=0.2)
        undone = made.service.calibrating.manager.start_undo("test")
        assert not isinstance(undone, Refusal)
        assert (await undone.finished).outcome == "done"
        assert {name: made.autopilot.parameter(name) for name in names} == old


async def test_with_all_sides_known_later_calibrations_have_a_tilt_and_the_autopilots_heading(tmp_path: Path) -> None:
    made, hands = rig(tmp_path)

    async def calibration() -> Record:
        result, record = await calibrated(made, What.GYROS)
        assert result.outcome == "done", result
        return record

    async with made.running():
        await made.ready()
        before, scales = await calibration(), read(made, "scale").tolist()
        assert before.pose is not None
        assert {before.pose.tilt_from, before.pose.heading_from, before.pose.theta_deg} == {None}
        result = await follow(made, hands, faced(made, write=False))
        assert result.outcome == "done", result
        assert result.reason.endswith("not written (--write does)")
        assert read(made, "scale").tolist() == scales, "nothing is written unless wanted"
        hands.spot(made.aircraft.time_at(made.now_s), 3.0, -4.0)
        made.autopilot.has_compass = True
        await asyncio.sleep(30.0)
        after = await calibration()
        pose = after.pose
        yaw = made.aircraft.angles_rad(made.aircraft.time_at(made.now_s))[2]
        assert pose is not None
        assert (pose.tilt_from, pose.heading_from) == ("accelerometers", "autopilot")
        assert pose.theta_deg == pytest.approx(3.0, abs=0.03)
        assert pose.gamma_deg == pytest.approx(-4.0, abs=0.03)
        assert 0.0 < (pose.sigma_deg.theta or 0.0) < 0.02
        assert pose.psi_deg == pytest.approx(np.degrees(yaw) % 360.0, abs=0.5)
        assert pose.sigma_deg.psi == pytest.approx(10.0)
        assert any("after a faces alignment" in words for words in after.warnings)
