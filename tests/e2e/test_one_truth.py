"""What page, status, ground station and the answer at arming say at one moment never contradicts."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np

from companion.cli import show
from companion.estimation.machine import State
from sim.motions import Handling
from tests.e2e.test_calibration import calibrated
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual


class Faces:
    """What every face says, as often as the page is renewed."""

    def __init__(self, rig: Rig) -> None:
        self.headlines: list[tuple[str, str]] = []
        """Word without figures, and tone."""
        self.progress: list[str] = []
        """What the shell calls what goes on."""
        self._rig = rig
        self._task = asyncio.create_task(self._look())

    async def _look(self) -> None:
        manager = self._rig.service.calibrating.manager
        while True:
            headline = self._rig.service.status()["headline"]
            seen = headline["word"].rstrip("0123456789 s%"), headline["tone"]
            if self.headlines[-1:] != [seen]:
                self.headlines.append(seen)
            if manager.running is not None:
                self.progress.append(manager.state.word)
            await asyncio.sleep(0.1)

    def stop(self) -> list[tuple[str, str]]:
        self._task.cancel()
        return self.headlines


def told(rig: Rig) -> str:
    return " | ".join(rig.ground.texts())


def test_where_nothing_has_to_be_rebooted_nobody_says_so(tmp_path: Path) -> None:
    """A step of 3 mg: EKF2 is as far off as it was before, 0.2 deg (autopilots 9.3)."""

    async def main() -> None:
        async with Rig(tmp_path, firmware="px4", at_arm="warn", max_s=12.0).running() as rig:
            await rig.ready()
            await asyncio.sleep(12.0)
            faces = Faces(rig)
            result, record = await calibrated(rig)
            assert result.outcome == "done"
            # Its offsets step far and back: that is no movement.
            assert ("HOLD STILL", "wait") not in faces.stop()
            assert " moves " not in told(rig)
            await rig.until(lambda: rig.service.status()["headline"]["word"] == "READY", 5.0)
            await asyncio.sleep(3.0)
            assert "eboot" not in told(rig)
            assert not any("reboot" in warning for warning in record.warnings)

    run_virtual(main())


def test_after_a_success_nothing_turns_red_on_the_way_to_ready(tmp_path: Path) -> None:
    """A step that telemetry hardly shows: what has not been seen to work yet is looked at, not complained of."""

    async def main() -> None:
        async with Rig(tmp_path, at_arm="gate", max_s=12.0).running() as rig:
            await rig.ready()
            await calibrated(rig)
            was = rig.double.parameter("INS_GYROFFS_Y")
            rig.double.write_as_another_station("INS_GYROFFS_Y", was + 1.5e-4)
            await asyncio.sleep(20.0)
            faces = Faces(rig)
            result, record = await calibrated(rig)
            assert result.outcome == "done"
            assert [written.outcome for imu in record.imus for written in imu.written.values()] == ["stored"] * 3
            (hidden,) = [line for line in record.imus[0].warnings if "telemetry" in line]
            assert "INS_GYROFFS_X, INS_GYROFFS_Y, INS_GYROFFS_Z" in hidden
            await rig.until(lambda: rig.service.status()["headline"]["word"] == "READY", 5.0)
            await asyncio.sleep(3.0)
            seen = faces.stop()
            assert ("SETTLING", "busy") in seen
            assert "bad" not in {tone for _, tone in seen[seen.index(("SETTLING", "busy")) :]}, seen
            # The shell speaks the page's words.
            busy = {word for word, tone in seen if tone == "busy"}
            assert busy <= {word.upper() for word in faces.progress}

    run_virtual(main())


def test_words_for_people_are_one_for_each_state_and_those_for_programs_stay() -> None:
    assert State.COLLECTING.word == State.SOLVING.word == "measuring"
    assert (State.COLLECTING.shown, State.VERIFYING.shown, State.SETTLING.shown) == (
        "collecting",
        "verifying",
        "verifying",
    )


def test_after_a_restart_of_the_daemon_a_calibration_is_not_denied(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, max_s=12.0).running() as rig:
            await rig.ready()
            assert rig.service.status()["arming"]["in_force"] == "not calibrated yet"
            # Nothing is claimed beside "not yet".
            assert "ready" not in " ".join(show.status_lines(rig.service.status())).lower()
            await calibrated(rig)
        async with Rig(tmp_path, max_s=12.0).running() as rig:
            await rig.ready()
            status = rig.service.status()
            assert status["arming"]["in_force"] == "not confirmed since start"
            assert "not calibrated yet" not in " ".join(show.status_lines(status))

    run_virtual(main())


def test_a_repeat_that_finds_only_noise_writes_nothing_and_says_so(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, firmware="px4", imus=1, max_s=12.0).running() as rig:
            await rig.ready()
            _, first = await calibrated(rig)
            written = len(rig.autopilot.writes)
            await asyncio.sleep(30.0)
            result, record = await calibrated(rig)
            (fc,) = record.imus
            assert len(rig.autopilot.writes) == written
            assert (fc.written, fc.unchanged) == ({}, ("accel", "gyro"))
            assert result.reason.startswith("unchanged, ")
            await rig.until(lambda: f"Calibration done: {result.reason}" in rig.ground.texts(), 5.0)
            status = rig.service.status()
            assert status["headline"]["word"] == "READY"
            assert not [line for line in fc.warnings if "telemetry" in line or "shelter" in line]
            # The offsets are off by no more than is said of them.
            left = rig.autopilot.residual(1, rig.now_s)
            held = rig.service.arming.in_force
            gyro, accel = held.sigma("gyro"), held.sigma("accel")
            assert gyro is not None
            assert accel is not None
            assert np.abs(left.gyro_rad_s).max() < 3.0 * gyro
            assert np.abs(left.accel_m_s2).max() < 3.0 * accel
            # A second look does not make known offsets worse known.
            assert gyro < 1.3 * max(first.imus[0].gyro_sigma_use_rad_s or ())

    run_virtual(main())


def test_whoever_moves_it_while_the_new_offsets_are_looked_at_is_told(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, max_s=12.0).running() as rig:
            await rig.ready()
            faces = Faces(rig)
            manager = rig.service.calibrating.manager
            calibration = asyncio.create_task(calibrated(rig))
            await rig.until(lambda: manager.state is State.VERIFYING, 60.0)
            rig.aircraft.add(Handling(start_s=rig.aircraft.time_at(rig.now_s) + 4.0, duration_s=6.0, seed=3))
            result, _ = await calibration
            assert result.outcome == "done"
            seen = faces.stop()
            assert ("HOLD STILL", "wait") in seen[seen.index(("CHECKING", "busy")) :]
            assert any(" moves " in line for line in rig.ground.texts())

    run_virtual(main())
