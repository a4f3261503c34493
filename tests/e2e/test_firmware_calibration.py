"""The firmware's own gyro calibration inside a write: its EKF is right afterwards, and everything comes back."""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.component.service import JobResult, Refusal
from companion.estimation.machine import State, What
from sim.ardupilot.parameters import offset_names
from sim.imu_model import DEG_H
from tests.e2e.test_calibration import FC_PARAMETERS, calibrated, started
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

GYRO_CALIBRATION = mavlink.MAV_CMD_PREFLIGHT_CALIBRATION
FINE_DEG_H = 20.0


@dataclasses.dataclass
class Sent:
    """Messages of the companion, in order: parameter names, and the number of the calibration command."""

    rig: Rig
    log: list[str | int] = dataclasses.field(default_factory=list)
    lose_command: bool = False

    def __post_init__(self) -> None:
        real_send = self.rig.link.send

        def send(message: mavlink.MAVLink_message, *allowed: Callable[[], bool]) -> bool:
            if isinstance(message, mavlink.MAVLink_param_set_message):
                self.log.append(message.param_id)
            elif isinstance(message, mavlink.MAVLink_command_long_message) and message.command == GYRO_CALIBRATION:
                self.log.append(message.command)
                if self.lose_command:
                    return True
            return real_send(message, *allowed)

        self.rig.link.send = send  # type: ignore[method-assign]

    @property
    def commands(self) -> int:
        return self.log.count(GYRO_CALIBRATION)


def imu_parameters(rig: Rig) -> dict[str, float]:
    return {name: value for name, value in rig.double.parameters.values.items() if name.startswith("INS")}


def make(folder: Path, **more: object) -> Rig:
    values: dict[str, object] = {"max_s": 12.0, **more}
    return Rig(folder, **values)  # type: ignore[arg-type]


def gyro_error_deg_h(rig: Rig) -> float:
    return float(np.abs(rig.double.residual(1, rig.now_s).gyro_rad_s).max() / DEG_H)


async def test_accelerometers_then_the_firmwares_calibration_once_then_the_fine_gyro_offsets(tmp_path: Path) -> None:
    async with make(tmp_path, auxiliary=True, max_s=30.0).running() as rig:
        await rig.ready()
        sent = Sent(rig)
        before = imu_parameters(rig)
        result, record = await calibrated(rig)
        assert result.outcome == "done", result
        assert sent.commands == 1
        place = sent.log.index(GYRO_CALIBRATION)
        assert set(offset_names(1, "accel")) <= set(sent.log[:place])
        assert set(sent.log[place + 1 :]) == set(offset_names(1, "gyro"))
        # Over the firmware's coarse ones, of which no trace is left in ours.
        assert gyro_error_deg_h(rig) < FINE_DEG_H
        rig.double.update_estimator(rig.now_s)
        assert np.abs(rig.double.estimator.omega_i).max() < 72 * DEG_H
        written = record.imus[0].written
        assert list(written) == FC_PARAMETERS
        assert {name: what.before for name, what in written.items()} == {n: before[n] for n in FC_PARAMETERS}
        assert {what.outcome for what in written.values()} == {"verified"}
        # Everything else that the firmware has changed is named, and comes back.
        others = {n for n, value in imu_parameters(rig).items() if value != before[n]} - set(FC_PARAMETERS)
        assert {"INS_GYR2OFFS_X", "INS4_GYROFFS_Z", "INS_GYR1_CALTEMP"} <= others
        words = " ".join(record.warnings)
        assert all(name in words for name in others)
        started(rig.service.calibrating.manager.start_undo("test"))
        await rig.until(lambda: imu_parameters(rig) == before, 20.0)


async def test_with_a_temperature_calibration_on_any_imu_it_is_left_out_and_the_ekf_waited_for(tmp_path: Path) -> None:
    async with make(tmp_path, parameters={"INS_TCAL2_ENABLE": 1.0}).running() as rig:
        await rig.ready()
        sent = Sent(rig)
        words: set[str] = set()
        job = started(rig.service.calibrating.manager.start_calibration(What.BOTH, "test"))
        while not job.finished.done():
            words.add(job.words)
            await asyncio.sleep(0.5)
        assert job.finished.result().outcome == "done"
        assert sent.commands == 0
        assert job.record is not None
        assert "INS_TCAL2_ENABLE is on" in " ".join(job.record.warnings)
        assert any(each.startswith("EKF adjusting: ") for each in words), words
        rig.double.update_estimator(rig.now_s)
        assert np.abs(rig.double.estimator.omega_i).max() < 80 * DEG_H


def test_arming_or_a_cancel_while_the_ekf_settles_ends_the_waiting_and_not_the_result(tmp_path: Path) -> None:
    async def settling(folder: Path, act: Callable[[Rig], object]) -> tuple[JobResult, str, bool]:
        async with make(folder, parameters={"INS_TCAL1_ENABLE": 1.0}).running() as rig:
            await rig.ready()
            before = imu_parameters(rig)
            job = started(rig.service.calibrating.manager.start_calibration(What.BOTH, "test"))
            await rig.until(lambda: job.words.startswith("EKF adjusting"), 90.0)
            act(rig)
            await rig.until(job.finished.done, 3.0)
            assert job.record is not None
            return job.finished.result(), " ".join(job.record.warnings), imu_parameters(rig) != before

    result, words, changed = run_virtual(settling(tmp_path / "armed", lambda rig: rig.double.arm()))
    assert (result.outcome, changed) == ("done", True)
    assert "armed before the EKF had settled" in words
    cancel = settling(tmp_path / "cancelled", lambda rig: rig.service.calibrating.manager.cancel("test"))
    result, words, changed = run_virtual(cancel)
    assert (result.outcome, changed) == ("done", True)
    assert "wait 2 min before take-off: cancelled by test" in words


async def test_a_calibration_of_the_firmware_that_fails_is_said_and_ours_stays(tmp_path: Path) -> None:
    async with make(tmp_path).running() as rig:
        await rig.ready()
        sent = Sent(rig)
        rig.double.faults.gyro_calibration_fails = True
        result, record = await calibrated(rig)
        assert result.outcome == "done", result
        assert sent.commands == 1
        assert "Gyros not calibrated" in " ".join(record.warnings)
        assert "Gyros not calibrated" in rig.double.prearm_failures(rig.now_s)
        rig.double.prearm_failures = lambda loop_s: []  # type: ignore[method-assign]
        failed = "the firmware's gyro calibration failed"
        await rig.until(lambda: rig.service.status()["headline"]["reason"].startswith(failed), 60.0)
        assert rig.service.status()["headline"]["remedy"].startswith("Hold still, calibrate again")
        rig.double.reboot(down_s=1.0)
        await rig.until(lambda: rig.service.status()["headline"]["reason"].startswith("calibrated"), 60.0)
        assert gyro_error_deg_h(rig) < FINE_DEG_H


PHASES: dict[str, Callable[[Rig, Sent], bool]] = {
    "in the middle of the first write": lambda rig, sent: len(sent.log) == 3,
    "during the firmware's calibration": lambda rig, sent: rig.double.calibrating,
    "in the middle of the fine offsets": lambda rig, sent: sent.log[-2:-1] == [GYRO_CALIBRATION],
    "while the effect is looked at": lambda rig, sent: rig.service.calibrating.manager.state is State.VERIFYING,
}


@pytest.mark.parametrize(
    ("phase", "gyr_cal"), [*((phase, 0.0) for phase in PHASES), ("while the effect is looked at", 1.0)]
)
async def test_a_reboot_in_any_phase_leaves_the_old_values_or_says_what_the_boot_has_measured(
    tmp_path: Path, phase: str, gyr_cal: float
) -> None:
    async with make(tmp_path, parameters={"INS_GYR_CAL": gyr_cal}).running() as rig:
        await rig.ready()
        # The boot has just measured them; another offset makes the step worth the firmware's calibration.
        rig.double.write_as_another_station("INS_GYROFFS_X", 0.004)
        rig.double.write_as_another_station("INS_GYR2OFFS_Y", 0.002)
        await asyncio.sleep(1.0)
        sent = Sent(rig)
        before = imu_parameters(rig)
        job = started(rig.service.calibrating.manager.start_calibration(What.BOTH, "test"))
        while not PHASES[phase](rig, sent):
            await asyncio.sleep(0.005)
            assert not job.finished.done(), job.finished.result()
        rig.double.reboot(down_s=1.0)
        result = await job.finished
        assert result.outcome == "failed", result
        await rig.until(lambda: not rig.service.offsets.journal.pending, 60.0)
        after = imu_parameters(rig)
        differ = {name for name in before if after[name] != before[name]}
        if gyr_cal:
            # What the start-up calibration wrote is its own; nothing of ours is left.
            gyros = {name for name in before if ("GYR" in name and "OFFS" in name) or "CALTEMP" in name}
            assert differ <= gyros
            assert job.record is not None
            written = job.record.imus[0].written
            assert all(after[name] != written[name].after for name in written)
        else:
            assert differ == set()
        assert rig.service.offsets.recovery.why_no_undo() == "nothing to undo"
        assert sent.commands <= 1


def test_a_daemon_that_died_during_the_firmwares_calibration_puts_everything_back_when_it_comes_again(
    tmp_path: Path,
) -> None:
    async def until_it_dies() -> tuple[dict[str, float], dict[str, float], bytes]:
        async with make(tmp_path / "first", auxiliary=True).running() as rig:
            await rig.ready()
            before = imu_parameters(rig)
            started(rig.service.calibrating.manager.start_calibration(What.BOTH, "test"))
            await rig.until(lambda: rig.double.calibrating, 90.0)
            return before, imu_parameters(rig), (tmp_path / "first" / "journal.json").read_bytes()

    async def again(before: dict[str, float], left: dict[str, float], journal: bytes, coarse: float) -> None:
        folder = tmp_path / f"again {coarse}"
        folder.mkdir()
        (folder / "journal.json").write_bytes(journal)
        left = {name: coarse if "GYR" in name and "OFFS" in name else value for name, value in left.items()}
        async with make(folder, auxiliary=True, parameters=left).running() as rig:
            await rig.until(lambda: not rig.service.offsets.journal.pending, 60.0)
            assert imu_parameters(rig) == before
            assert not (folder / "journal.json").exists()

    kept = run_virtual(until_it_dies())
    for coarse in (0.0, 3e-4):
        run_virtual(again(*kept, coarse))


def test_the_undo_of_one_vehicle_is_never_written_to_another_and_waits_for_its_own(tmp_path: Path) -> None:
    async def calibrate(system_id: int) -> dict[str, float]:
        async with make(tmp_path, system_id=system_id).running() as rig:
            await rig.ready()
            assert (await calibrated(rig))[0].outcome == "done"
            return imu_parameters(rig)

    async def undo(system_id: int, after: dict[str, float]) -> None:
        async with make(tmp_path, system_id=system_id, parameters=after).running() as rig:
            await rig.ready()
            answer = rig.service.calibrating.manager.start_undo("test")
            if system_id == 3:
                assert isinstance(answer, Refusal)
                assert "only on system 1, 2" in answer.reason
                return
            assert (await started(answer).finished).outcome == "done"
            assert rig.double.parameter("INS_GYROFFS_X") == 0.0

    one, two = run_virtual(calibrate(1)), run_virtual(calibrate(2))
    run_virtual(undo(3, one))
    run_virtual(undo(1, one))
    run_virtual(undo(2, two))
