"""Autopilots, pilots and people that get in the way: detected, said by name, old values back."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from companion.autopilot.vehicle.vehicle import ArmState
from companion.calibration.machine import State
from companion.calibration.means.windows import Window
from companion.calibration.records.record import Record
from companion.calibration.request import What
from companion.component.service import JobResult, Refusal
from companion.daemon.job import Job
from companion.daemon.stands.measuring import Measuring
from companion.errors import ParameterTimeoutError
from companion.storage.changes import Changed, ChangeLog, ChangeSet, Undoable
from sim.ardupilot.double import ArduPilotDouble, offset_names
from sim.imu_model import DEG_H, MG
from sim.motions import Handling, SlowTurn
from tests.e2e.test_calibration import FC_PARAMETERS, calibrated, started
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual


def values(double: ArduPilotDouble) -> dict[str, float]:
    return {name: double.parameter(name) for name in FC_PARAMETERS}


def outcomes(record: Record) -> set[str]:
    return {written.outcome for written in record.imus[0].written.values()}


async def _with_fault(folder: Path, fault: Callable[[Rig], None]) -> tuple[JobResult, Record, bool]:
    """A calibration with a fault switched on before it; whether the old values are in force at its end."""
    async with Rig(folder, max_s=12.0).running() as rig:
        await rig.ready()
        before = values(rig.double)
        fault(rig)
        result, record = await calibrated(rig)
        return result, record, values(rig.double) == before


def test_an_autopilot_that_echoes_but_does_not_use_the_value(tmp_path: Path) -> None:
    def fault(rig: Rig) -> None:
        rig.double.faults.echo_without_effect = True

    result, record, back = run_virtual(_with_fault(tmp_path, fault))
    assert result.outcome == record.state == "failed"
    assert "INS_ACCOFFS_X" in record.reason
    assert "does not use" in record.reason
    assert back
    assert outcomes(record) == {"rolled_back"}


def test_what_somebody_changed_is_named_although_the_autopilot_falls_silent_right_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def main() -> None:
        async with Rig(tmp_path, max_s=12.0).running() as rig:
            await rig.ready()
            seen: list[str] = []

            async def falling_silent(name: str) -> float:
                seen.append(name)
                if len(seen) == 2:
                    raise ParameterTimeoutError("silent")
                return 0.25

            monkeypatch.setattr(rig.service.offsets.pusher, "_parameters", SimpleNamespace(read=falling_silent))
            job = started(rig.service.calibrating.conductor.start_calibration(What.BOTH, "test", None))
            result = await job.finished
            assert result.outcome == "failed"
            assert f"{seen[0]} is 0.25, somebody changed it right after the write; silent" in result.reason

    run_virtual(main())


def test_a_restart_while_the_telemetry_is_watched_puts_the_old_values_back(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, max_s=12.0).running() as rig:
            await rig.ready()
            before = values(rig.double)
            conductor = rig.service.calibrating.conductor
            job = started(conductor.start_calibration(What.BOTH, "test", None))
            await rig.until(lambda: conductor.state is State.VERIFYING, 60.0)
            rig.double.reboot()
            result = await job.finished
            assert result.outcome == "failed"
            assert "the autopilot rebooted right after the write" in result.reason
            await rig.until(lambda: not rig.service.offsets.ledger.pending, 60.0)
            assert values(rig.double) == before

    run_virtual(main())


def test_an_autopilot_that_refuses_one_parameter(tmp_path: Path) -> None:
    def fault(rig: Rig) -> None:
        rig.double.faults.refuse = {"INS_GYROFFS_Y"}

    result, record, back = run_virtual(_with_fault(tmp_path, fault))
    assert result.outcome == "failed"
    assert "refuse" in record.reason
    assert "INS_GYROFFS_Y" in record.reason
    assert back
    written = record.imus[0].written
    assert written["INS_ACCOFFS_X"].outcome == "rolled_back"
    assert written["INS_GYROFFS_Y"].outcome in ("failed", "rolled_back")


@pytest.mark.parametrize("version", ["4.8", "4.5"])
def test_an_autopilot_that_does_not_answer_for_one_parameter(tmp_path: Path, version: str) -> None:
    async def main() -> None:
        async with Rig(tmp_path, max_s=12.0, version=version).running() as rig:
            await rig.ready()
            before = values(rig.double)
            job = started(rig.service.calibrating.conductor.start_calibration(What.BOTH, "test"))
            await rig.until(lambda: rig.service.calibrating.conductor.state is State.WRITING, 60.0)
            rig.double.faults.ignore = {"INS_ACCOFFS_Y"}
            result = await job.finished
            assert result.outcome == "failed"
            assert "INS_ACCOFFS_Y" in result.reason
            assert "no answer" in result.reason
            rig.double.faults.ignore = set()
            await rig.until(lambda: values(rig.double) == before, 60.0)
            await rig.until(lambda: not rig.service.offsets.ledger.pending, 60.0)

    run_virtual(main())


def test_an_autopilot_that_answers_another_value(tmp_path: Path) -> None:
    def fault(rig: Rig) -> None:
        rig.double.faults.wrong_echo = {"INS_ACCOFFS_Z"}

    result, record, _ = run_virtual(_with_fault(tmp_path, fault))
    assert result.outcome == "failed"
    assert "INS_ACCOFFS_Z" in record.reason


def test_an_autopilot_that_answers_nothing_is_a_fault_and_not_an_endless_wait(tmp_path: Path) -> None:
    async def main() -> JobResult:
        rig = Rig(tmp_path)
        rig.double.faults.silent = True
        async with rig.running():
            await rig.until(lambda: rig.service.core.vehicle.system_id == 1, 10.0)
            result, record = await calibrated(rig)
            assert record.imus == ()
            assert rig.double.writes == []
            return result

    result = run_virtual(main())
    assert result.outcome == "failed"
    assert "does not answer" in result.reason or "answers neither" in result.reason
    assert "fc" in result.reason


def test_arming_in_the_middle_of_the_write_is_reported_and_mended_once_disarmed(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, max_s=12.0).running() as rig:
            await rig.ready()
            before = values(rig.double)
            rig.double.faults.arm_after_writes = 2
            result, record = await calibrated(rig)
            assert result.outcome == "failed"
            assert "armed" in result.reason
            left = {name for name, value in values(rig.double).items() if value != before[name]}
            assert left
            for name in left:
                assert name in result.reason
                assert record.imus[0].written[name].outcome == "failed"
            assert len(rig.double.writes) == 2  # the arming came with the second write; there was no third
            assert rig.service.offsets.ledger.pending
            refusal = rig.service.calibrating.conductor.start_calibration(What.BOTH, "test")
            assert isinstance(refusal, Refusal)
            assert refusal.kind == "armed"
            writes = len(rig.double.writes)
            await asyncio.sleep(20.0)
            assert len(rig.double.writes) == writes  # armed: hands off, however long it takes
            rig.double.disarm()
            await rig.until(lambda: not rig.service.offsets.ledger.pending, 20.0)
            assert values(rig.double) == before
            await rig.until(lambda: any("old values back" in text for text in rig.ground.texts()), 5.0)

    run_virtual(main())


def test_a_write_interrupted_by_a_power_cut_is_mended_at_the_next_start(tmp_path: Path) -> None:
    # What a daemon leaves that died after the second of three writes.
    names = offset_names(1, "gyro")
    afters = [float(np.float32(0.001 * (k + 1))) for k in range(3)]
    changes = tuple(Changed(name, before=0.0, after=after) for name, after in zip(names, afters, strict=True))
    ChangeLog(tmp_path).journal.write(ChangeSet(1, changes))

    async def main() -> None:
        half_written = dict(zip(names[:2], afters[:2], strict=True))
        async with Rig(tmp_path, parameters={**dict.fromkeys(names, 0.0), **half_written}).running() as rig:
            await rig.until(lambda: not rig.service.offsets.ledger.pending, 20.0)
            assert [rig.double.parameter(name) for name in names] == [0.0, 0.0, 0.0]
            assert ChangeLog(tmp_path).journal.read() is None

    run_virtual(main())


@pytest.mark.parametrize("after", [0.0025, None])
def test_a_write_interrupted_on_another_aircraft_is_named_and_nothing_of_it_put_back_here(
    tmp_path: Path, after: float | None
) -> None:
    names = offset_names(1, "gyro")
    changes = tuple(Changed(name, before=0.0, after=after) for name in names)
    ChangeLog(tmp_path).journal.write(ChangeSet(7, changes))

    async def main() -> None:
        async with Rig(tmp_path, parameters=dict.fromkeys(names, 0.0025)).running() as rig:
            await rig.until(lambda: not rig.service.offsets.ledger.pending, 60.0)
            await asyncio.sleep(2.0)
            assert rig.double.writes == []
            assert any("Interrupted write on system 7" in text for text in rig.ground.texts())

    run_virtual(main())


def test_an_interrupted_write_waits_while_armed_without_trying(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    names = offset_names(1, "gyro")
    changes = tuple(Changed(name, before=0.0, after=0.0025) for name in names)
    ChangeLog(tmp_path).journal.write(ChangeSet(1, changes))

    async def main() -> None:
        rig = Rig(tmp_path, parameters=dict.fromkeys(names, 0.0025))
        rig.double.arm()
        async with rig.running():
            await asyncio.sleep(15.0)
            assert rig.double.writes == []
            assert rig.service.offsets.ledger.pending
            assert not any("trying again" in words for words in caplog.messages)
            rig.double.disarm()
            await rig.until(lambda: not rig.service.offsets.ledger.pending, 20.0)
            assert [rig.double.parameter(name) for name in names] == [0.0, 0.0, 0.0]

    run_virtual(main())


def test_values_that_somebody_else_has_set_since_are_left_alone(tmp_path: Path) -> None:
    names = offset_names(1, "gyro")
    changes = tuple(Changed(name, before=0.0, after=0.25) for name in names)
    ChangeLog(tmp_path).journal.write(ChangeSet(1, changes))

    async def main() -> None:
        async with Rig(tmp_path, parameters=dict.fromkeys(names, 0.0025)).running() as rig:
            await rig.until(lambda: not rig.service.offsets.ledger.pending, 20.0)
            assert rig.double.writes == []
            assert any("left alone" in text for text in rig.ground.texts())

    run_virtual(main())


def test_offsets_that_change_unheard_after_the_measurement_are_measured_under_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are read afresh before anything is written: what was measured under others would be off by the change."""

    async def main() -> None:
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

    run_virtual(main())


def test_undo_is_refused_when_somebody_else_has_changed_a_value_since(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, max_s=12.0).running() as rig:
            await rig.ready()
            assert (await calibrated(rig))[0].outcome == "done"
            rig.double.write_as_another_station("INS_GYROFFS_Z", 0.001)
            now = values(rig.double)
            job = started(rig.service.calibrating.conductor.start_undo("test"))
            result = await job.finished
            assert result.outcome == "failed"
            assert "INS_GYROFFS_Z" in result.reason
            assert values(rig.double) == now

    run_virtual(main())


def test_undo_survives_a_restart_and_works_once(tmp_path: Path) -> None:
    async def main() -> None:
        rig = Rig(tmp_path, max_s=12.0)
        before = values(rig.double)
        async with rig.running():
            await rig.ready()
            assert (await calibrated(rig))[0].outcome == "done"
        rig.wire.__init__(rig.link, rig.double)  # type: ignore[misc]
        rig.radio.__init__(rig.ground, rig.double.ground)  # type: ignore[misc]
        async with rig.running():
            await rig.ready()
            result = await started(rig.service.calibrating.conductor.start_undo("test")).finished
            assert result.outcome == "done", result
            assert values(rig.double) == before
            refusal = rig.service.calibrating.conductor.start_undo("test")
            assert isinstance(refusal, Refusal)
            assert refusal.kind == "nothing_to_undo"

    run_virtual(main())


def test_a_foreign_write_during_the_measurement_starts_it_afresh(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, max_s=12.0).running() as rig:
            await rig.ready()
            job = started(rig.service.calibrating.conductor.start_calibration(What.BOTH, "test"))
            await rig.until(lambda: rig.service.calibrating.conductor.state is State.COLLECTING, 30.0)
            rig.double.write_as_another_station("INS_GYROFFS_X", 0.003)
            result = await job.finished
            assert result.outcome == "done", result
            left = rig.double.residual(1, rig.now_s)
            assert np.abs(left.gyro_rad_s).max() < 25 * DEG_H

    run_virtual(main())


def test_movement_is_waited_out_and_named(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, max_s=12.0).running() as rig:
            await rig.ready()
            start_s = rig.aircraft.time_at(rig.now_s)
            rig.aircraft.add(Handling(start_s=start_s + 1.0, duration_s=15.0, seed=3))
            job = started(rig.service.calibrating.conductor.start_calibration(What.BOTH, "test"))
            said: set[str] = set()
            while not job.finished.done():
                said.add(job.words)
                await asyncio.sleep(0.5)
            assert (await job.finished).outcome == "done"
            assert any("deg/s" in words and "fc" in words for words in said), said
            assert job.record is not None
            assert job.record.duration_s > 20.0
            left = rig.double.residual(1, rig.now_s)
            assert np.abs(left.gyro_rad_s).max() < 25 * DEG_H
            assert np.abs(left.accel_m_s2).max() < 0.4 * MG

    run_virtual(main())


def test_a_slow_steady_turn_is_not_taken_for_a_bias(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, max_s=12.0).running() as rig:
            await rig.ready()
            start_s = rig.aircraft.time_at(rig.now_s)
            rig.aircraft.add(SlowTurn(start_s=start_s, duration_s=60.0, rate_deg_s=0.5))
            result, _ = await calibrated(rig, timeout_s=45.0)
            assert result.outcome == "failed"
            assert rig.double.writes == []

    run_virtual(main())


def test_a_timeout_says_for_what_it_waited(tmp_path: Path) -> None:
    async def main() -> None:
        rig = Rig(tmp_path)
        rig.unplugged = {"gradienter"}
        async with rig.running():
            await rig.ready()
            result, record = await calibrated(rig, timeout_s=20.0)
            assert result.outcome == record.state == "failed"
            assert "gradienter" in result.reason
            assert record.duration_s == pytest.approx(20.0, abs=0.5)

    run_virtual(main())


@pytest.mark.parametrize("state", [State.WAITING, State.COLLECTING, State.WRITING, State.VERIFYING])
def test_cancelled_anywhere_nothing_is_left_changed(tmp_path: Path, state: State) -> None:
    async def main() -> None:
        async with Rig(tmp_path, max_s=14.0).running() as rig:
            await rig.ready()
            before = values(rig.double)
            job = started(rig.service.calibrating.conductor.start_calibration(What.BOTH, "test"))
            await rig.until(lambda: rig.service.calibrating.conductor.state is state, 60.0)
            assert rig.service.calibrating.conductor.cancel("the test")
            result = await job.finished
            assert result.outcome == "cancelled"
            assert "the test" in result.reason
            assert values(rig.double) == before
            assert not rig.service.offsets.ledger.pending
            assert rig.service.calibrating.conductor.state is State.CANCELLED
            assert not rig.service.calibrating.conductor.cancel("the test")

    run_virtual(main())


def test_cancelled_and_armed_at_once_the_old_values_come_back_once_disarmed(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, max_s=14.0).running() as rig:
            await rig.ready()
            before = values(rig.double)
            job = started(rig.service.calibrating.conductor.start_calibration(What.BOTH, "test"))
            await rig.until(lambda: rig.service.calibrating.conductor.state is State.VERIFYING, 60.0)
            rig.double.arm()
            await rig.until(lambda: rig.service.core.vehicle.arm_state is ArmState.ARMED, 5.0)
            assert rig.service.calibrating.conductor.cancel("the test")
            result = await job.finished
            assert result.outcome == "cancelled"
            assert "old values NOT back in INS_" in result.reason
            assert result.reason.endswith(": will be once disarmed")
            assert values(rig.double) != before
            assert rig.service.offsets.ledger.pending
            rig.double.disarm()
            await rig.until(lambda: not rig.service.offsets.ledger.pending, 20.0)
            assert values(rig.double) == before

    run_virtual(main())


def test_a_fc_only_set_up_with_a_turned_board(tmp_path: Path) -> None:
    # AHRS_ORIENTATION 2 is YAW_90: offsets live in the board's axes, residuals in the vehicle's.
    async def main() -> None:
        rig = Rig(tmp_path, max_s=15.0, parameters={"AHRS_ORIENTATION": 2.0, "INS_ACCSCAL_X": 1.02})
        rig.model.mounting[:] = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        rig.model._gyro_matrix = rig.model.mounting.T.copy()
        rig.model._accel_matrix = np.diag([1 / 1.02, 1.0, 1.0]) @ rig.model.mounting.T
        async with rig.running():
            await rig.ready()
            result, record = await calibrated(rig)
            assert result.outcome == "done", result
            left = rig.double.residual(1, rig.now_s)
            assert np.abs(left.gyro_rad_s).max() < 20 * DEG_H
            assert np.abs(left.accel_m_s2).max() < 0.4 * MG
            # The whole bias is in the vehicle's axes, the parameters in the board's.
            true = rig.model.true_bias_in_vehicle(rig.aircraft.time_at(rig.now_s))
            assert record.imus[0].gyro_bias_rad_s is not None
            np.testing.assert_allclose(record.imus[0].gyro_bias_rad_s, true.gyro_rad_s, atol=20 * DEG_H)
            assert rig.double.parameter("INS_GYROFFS_X") == pytest.approx(162 * DEG_H, abs=20 * DEG_H)

    run_virtual(main())


def test_refusals_before_anything_starts(tmp_path: Path) -> None:
    async def main() -> None:
        rig = Rig(tmp_path, at_arm="warn")
        rig.double.faults.heartbeat_off = True
        async with rig.running():
            early = rig.service.calibrating.conductor.start_calibration(What.BOTH, "test")
            assert isinstance(early, Refusal)
            assert early.kind == "unknown"
            assert "no autopilot heard" in early.reason
            rig.double.faults.heartbeat_off = False
            await rig.ready()
            rig.double.arm()
            await asyncio.sleep(2.0)
            armed = rig.service.calibrating.conductor.start_calibration(What.BOTH, "test")
            assert isinstance(armed, Refusal)
            assert armed.kind == "armed"
            assert any("Armed UNCALIBRATED: not calibrated yet" in text for text in rig.ground.texts())
            rig.double.disarm()
            rig.double.faults.heartbeat_off = True
            await asyncio.sleep(4.0)
            lost = rig.service.calibrating.conductor.start_calibration(What.BOTH, "test")
            assert isinstance(lost, Refusal)
            assert lost.kind == "unknown"
            rig.double.faults.heartbeat_off = False
            await asyncio.sleep(3.0)
            started(rig.service.calibrating.conductor.start_calibration(What.BOTH, "test"))
            busy = rig.service.calibrating.conductor.start_calibration(What.GYROS, "another")
            assert isinstance(busy, Refusal)
            assert busy.kind == "busy"

    run_virtual(main())


@pytest.mark.parametrize("version", ["4.8", "4.5"])
def test_on_a_board_with_integer_messages_only_what_the_noise_does_not_tell_is_left_alone(
    tmp_path: Path, version: str
) -> None:
    async def main() -> None:
        rig = Rig(tmp_path, max_s=12.0, version=version)
        before = values(rig.double)
        rig.double.faults.int_only = True
        async with rig.running():
            await rig.until(lambda: rig.service.devices.imus["fc"].calibration is not None, 15.0)
            await rig.until(lambda: rig.service.devices.imus["fc"].stream.samples > 0, 30.0)
            result, record = await calibrated(rig, timeout_s=120.0)
            assert result.outcome == "done"
            assert "gyro fc" in result.reason
            imu = record.imus[0]
            # Gyro noise of a fifth of a step around zero: unknown, so nothing is written, and what to do is said.
            assert imu.gyro_bias_rad_s is None
            assert any("push.dither" in words for words in imu.warnings)
            assert imu.accel_bias_m_s2 is not None
            assert imu.accel_sigma_use_m_s2 is not None
            true = rig.model.true_bias(rig.aircraft.time_at(rig.now_s))
            off = np.abs(np.subtract(imu.accel_bias_m_s2, true.accel_m_s2))
            assert np.all(off < 3 * np.array(imu.accel_sigma_use_m_s2))
            assert off.max() < 0.15 * MG
            changed = {name for name, value in values(rig.double).items() if value != before[name]}
            assert changed == set(offset_names(1, "accel"))

    run_virtual(main())


def test_a_storage_that_cannot_be_written_refuses_with_the_reason_before_anything_is_measured(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")

    async def main() -> None:
        async with Rig(tmp_path / "file").running() as rig:
            await rig.until(lambda: rig.service.core.vehicle.alive, 10.0)
            refusal = rig.service.calibrating.conductor.start_calibration(What.BOTH, "test")
            assert isinstance(refusal, Refusal)
            assert "cannot be written" in refusal.reason
            assert rig.service.calibrating.conductor.mav_state == 5  # MAV_STATE_CRITICAL

    run_virtual(main())


def test_a_disk_that_fills_up_during_the_calibration_leaves_the_old_values(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def main() -> None:
        async with Rig(tmp_path, max_s=12.0).running() as rig:
            await rig.ready()
            before = values(rig.double)
            job = started(rig.service.calibrating.conductor.start_calibration(What.BOTH, "test"))
            await rig.until(lambda: rig.service.calibrating.conductor.state is State.VERIFYING, 60.0)
            assert values(rig.double) != before

            def full(*_: object) -> None:
                raise OSError(28, "No space left on device")

            monkeypatch.setattr(os, "replace", full)
            result = await job.finished
            assert result.outcome == "failed"
            assert "No space left on device" in result.reason
            assert job.record is not None
            assert outcomes(job.record) == {"rolled_back"}
            await rig.until(lambda: values(rig.double) == before and not rig.service.offsets.ledger.pending, 30.0)

    run_virtual(main())


def test_a_foreign_write_during_the_verification_is_never_called_verified(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, max_s=12.0).running() as rig:
            await rig.ready()
            before = values(rig.double)
            job = started(rig.service.calibrating.conductor.start_calibration(What.BOTH, "test"))
            await rig.until(lambda: rig.service.calibrating.conductor.state is State.VERIFYING, 60.0)
            await asyncio.sleep(1.5)
            foreign = rig.double.parameter("INS_GYROFFS_X") + 6e-5
            rig.double.write_as_another_station("INS_GYROFFS_X", foreign)
            result = await job.finished
            assert result.outcome == "failed"
            assert "somebody" in result.reason
            assert "INS_GYROFFS_X" in result.reason
            now = values(rig.double)
            assert now.pop("INS_GYROFFS_X") == pytest.approx(foreign)
            before.pop("INS_GYROFFS_X")
            assert now == before

    run_virtual(main())


def test_an_undo_that_a_power_cut_interrupted_is_finished_and_is_not_there_to_undo_again(tmp_path: Path) -> None:
    names = offset_names(1, "gyro")
    changes = ChangeSet(1, tuple(Changed(name, before=0.0, after=0.0078125) for name in names))
    ChangeLog(tmp_path).journal.write(changes)
    ChangeLog(tmp_path).undo_of(1).write(Undoable(1, (changes,)))

    async def main() -> None:
        async with Rig(tmp_path, parameters={names[0]: 0.0, names[1]: 0.0078125, names[2]: 0.0078125}).running() as rig:
            await rig.until(lambda: not rig.service.offsets.ledger.pending, 20.0)
            assert [rig.double.parameter(name) for name in names] == [0.0, 0.0, 0.0]
            refusal = rig.service.calibrating.conductor.start_undo("test")
            assert isinstance(refusal, Refusal)
            assert refusal.kind == "nothing_to_undo"

    run_virtual(main())


def test_a_check_that_only_listens_starts_nothing(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path).running() as rig:
            await rig.ready()
            rig.service.core.only_listening = "only a check is running"
            for answer in (
                rig.service.calibrating.conductor.start_calibration(What.BOTH, "test"),
                rig.service.calibrating.conductor.start_undo("test"),
            ):
                assert isinstance(answer, Refusal)
                assert "check" in answer.reason

    run_virtual(main())


def test_every_imu_that_does_not_take_its_offsets_is_named(tmp_path: Path) -> None:
    async def main() -> None:
        second = '[[imu]]\nname = "fc2"\nsource = "autopilot"\ninstance = 2\nprofile = "icm42688p"\n'
        rig = Rig(tmp_path, max_s=12.0, more=second, parameters={"INS_ACC2OFFS_X": 0.1})
        async with rig.running():
            await rig.ready()
            rig.double.faults.echo_without_effect = True
            result, record = await calibrated(rig)
            assert result.outcome == "failed"
            assert "imu fc: the autopilot stored" in result.reason
            assert "imu fc2: the autopilot stored INS_ACC2OFFS_X but does not use it" in result.reason
            assert {w.outcome for imu in record.imus for w in imu.written.values()} == {"rolled_back"}

    run_virtual(main())


@pytest.mark.parametrize("runs_s", [0.6, 6.0, 29.0])
def test_a_daemon_that_died_while_the_firmware_calibrated_its_gyros_puts_their_offsets_back_too(
    tmp_path: Path, runs_s: float
) -> None:
    """What the firmware finds is stored at its end, when the next daemon is long there; until then all reads zero."""
    names = offset_names(1, "gyro")
    changes = tuple(Changed(name, before=0.0, after=None) for name in names)
    ChangeLog(tmp_path).journal.write(ChangeSet(1, changes))

    async def main() -> None:
        async with Rig(tmp_path, parameters=dict.fromkeys(names, 0.0)).running() as rig:
            await asyncio.sleep(runs_s)
            for name in names:
                rig.double.set_parameter(name, 0.001)
            await rig.until(lambda: not rig.service.offsets.ledger.pending, 60.0)
            await asyncio.sleep(1.0)
            assert [rig.double.parameter(name) for name in names] == [0.0, 0.0, 0.0]

    run_virtual(main())
