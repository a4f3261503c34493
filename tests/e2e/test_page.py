"""The page's answers and the big word, on the whole daemon: the same words and refusals as everywhere else."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncGenerator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.cli.show import record_lines
from companion.estimation.machine import What
from companion.estimation.records.validity import Held
from sim.motions import Handling
from tests.e2e.test_calibration import calibrated, started
from tests.support import page
from tests.support.rig import Rig


async def press(rig: Rig, button: str, /, **body: Any) -> tuple[int, str]:
    async def ask(request: dict[str, Any]) -> AsyncGenerator[dict[str, Any], None]:
        async for reply in rig.service.faces.answer(request | {"face": "page"}):
            yield reply

    return await page.press(ask, button, **body)


async def at_the_socket(rig: Rig, command: str) -> str:
    """The reason that the control socket gives for the same."""
    try:
        replies = [reply async for reply in rig.service.faces.answer({"command": command})]
    except Exception as error:  # noqa: BLE001 - refusals are exceptions there
        return str(error)
    return str(replies[-1]["reason"])


def headline(rig: Rig) -> tuple[str, str, str]:
    found = rig.service.status()["headline"]
    return found["tone"], found["word"], found["reason"]


class Watch:
    """Every big word in its order, without figures."""

    def __init__(self, rig: Rig) -> None:
        self.words: list[str] = []
        self.seconds: list[int] = []
        self.percents: list[int | None] = []
        self._rig = rig
        self._task = asyncio.create_task(self._look())

    async def _look(self) -> None:
        while True:
            word = headline(self._rig)[1]
            self.percents.append(self._rig.service.status()["progress"])
            if word.startswith("HOLD STILL") and (match := re.search(r"\d+", word)):
                self.seconds.append(int(match[0]))
            short = re.sub(r" \d+ (%|s)$", "", word)
            if self.words[-1:] != [short]:
                self.words.append(short)
            await asyncio.sleep(0.1)

    async def stop(self) -> list[str]:
        await asyncio.sleep(0.3)
        self._task.cancel()
        return self.words


async def test_buttons_do_what_the_command_line_does_and_are_refused_in_the_same_words(tmp_path: Path) -> None:
    async with Rig(tmp_path, max_s=12.0).running() as rig:
        await rig.ready()
        assert rig.service.status()["why_no_undo"] is not None
        assert await press(rig, "undo") == (409, await at_the_socket(rig, "undo"))
        assert await press(rig, "cancel") == (200, "nothing was running")

        rig.double.arm()
        await rig.until(lambda: rig.service.core.vehicle.arm_state.value == "armed", 3.0)
        status, words = await press(rig, "calibrate")
        assert (status, words) == (409, await at_the_socket(rig, "calibrate"))
        assert "armed" in words
        rig.double.disarm()
        await rig.until(lambda: rig.service.core.vehicle.arm_state.value == "disarmed", 3.0)

        allowed = '"both", "gyros", "accelerometers"'
        wrong = f"calibrate: 'what': found \"nothing\"; allowed: {allowed}"
        assert await press(rig, "calibrate", what="nothing") == (409, wrong)
        assert await press(rig, "calibrate") == (200, "calibration started")
        job = rig.service.calibrating.manager.job
        assert job is not None
        assert job.what is What.BOTH
        busy = await press(rig, "calibrate")
        assert busy[0] == 409
        assert "running" in busy[1]
        assert await press(rig, "cancel") == (200, "cancelled by the page; nothing written")
        assert (await job.finished).outcome == "cancelled"

        before = rig.double.parameter("INS_GYROFFS_X")
        assert await press(rig, "calibrate", what="gyros") == (200, "calibration started")
        job = rig.service.calibrating.manager.job
        assert job is not None
        assert job.what is What.GYROS
        assert (await job.finished).outcome == "done"
        assert rig.double.parameter("INS_GYROFFS_X") != before
        assert rig.service.status()["why_no_undo"] is None
        status, words = await press(rig, "undo")
        assert status == 200
        assert "old values restored" in words
        assert rig.double.parameter("INS_GYROFFS_X") == before


async def test_the_big_word_through_a_calibration_with_nervous_hands(tmp_path: Path) -> None:
    async with Rig(tmp_path, max_s=12.0).running() as rig:
        await rig.ready()
        await rig.until(lambda: headline(rig)[1] == "NOT CALIBRATED", 5.0)
        assert headline(rig) == ("bad", "NOT CALIBRATED", "not calibrated yet: calibrate")
        watch = Watch(rig)
        rig.aircraft.add(Handling(start_s=rig.aircraft.time_at(rig.now_s) + 1.0, duration_s=8.0, seed=3))
        result, record = await calibrated(rig)
        await rig.until(lambda: headline(rig)[1] == "READY", 5.0)
        assert result.outcome == "done"
        # A movement begins the measurement again, and its percentage with it.
        percents = [percent for percent in watch.percents if percent is not None]
        last = max(k for k, percent in enumerate(percents) if percent == 0)
        assert max(percents[:last]) > 0
        assert percents[last:] == sorted(percents[last:])
        words = await watch.stop()
        assert words[-5:] == ["HOLD STILL", "MEASURING", "WRITING", "CHECKING", "READY"] or words[-6:] == [
            "HOLD STILL", "MEASURING", "WRITING", "CHECKING", "SETTLING", "READY",
        ], words  # fmt: skip
        tone, _, reason = headline(rig)
        assert tone == "good"
        assert re.match(r"calibrated \d+ s ago, \d+\.\d deg/h, \d\.\d\d mg", reason)

        rig.double.arm()
        await rig.until(lambda: headline(rig)[1] == "ARMED", 3.0)
        assert headline(rig)[0] == "good"
        rig.double.disarm()
        await rig.until(lambda: headline(rig)[1] == "READY", 3.0)

        job = started(rig.service.calibrating.manager.start_undo("test"))
        await rig.until(lambda: headline(rig)[1] == "RESTORING", 3.0)
        assert (await job.finished).outcome == "done"
        await rig.until(lambda: headline(rig)[1] == "NOT CALIBRATED", 3.0)
        assert rig.service.status()["calibration"] is None
        assert record.state == "done"

        rig.double.arm()
        await rig.until(lambda: headline(rig)[:2] == ("bad", "ARMED"), 3.0)
        assert "not calibrated" in headline(rig)[2]
        assert "disarm" in rig.service.status()["headline"]["remedy"]


async def test_the_bars_have_the_sigma_of_the_headline_where_old_offsets_stay(tmp_path: Path) -> None:
    async with Rig(tmp_path, max_s=12.0).running() as rig:
        await rig.ready()
        assert (await calibrated(rig))[0].outcome == "done"
        await rig.until(lambda: headline(rig)[1] == "READY", 5.0)
        result, record = await calibrated(rig)
        assert record.imus[0].unchanged == ("accel", "gyro"), result
        await rig.until(lambda: headline(rig)[1] == "READY", 5.0)
        status = rig.service.status()
        (bars,) = status["calibration"]["imus"]
        sigma = max(bars["gyro_sigma_deg_h"])
        assert f", {sigma:.{1 if sigma < 10.0 else 0}f} deg/h, {max(bars['accel_sigma_mg']):.2f} mg" in headline(rig)[2]
        shown = [line for line in record_lines(msgspec.to_builtins(record)) if line.startswith("  gyro  bias")]
        assert max(float(one) for one in re.findall(r"\+- ([\d.]+)", shown[0])) == pytest.approx(sigma, abs=0.06)


async def test_left_alone_it_says_how_long_to_hold_still_until_it_is_ready(tmp_path: Path) -> None:
    async with Rig(tmp_path, max_s=15.0, at_arm="gate").running() as rig:
        watch = Watch(rig)
        await rig.until(lambda: headline(rig)[1] == "READY", 120.0)
        words = await watch.stop()
        assert {"HOLD STILL", "WRITING", "READY"} <= set(words)
        # In the first second devices have said nothing yet; from then on nobody has to do anything.
        assert not {"NOT CALIBRATED", "NOT READY", "FAILED"} & set(words[words.index("HOLD STILL") :]), words
        counted = watch.seconds
        assert len(set(counted)) > 5
        assert counted == sorted(counted, reverse=True)


async def test_noise_at_the_threshold_does_not_change_the_word_every_second(tmp_path: Path) -> None:
    async with Rig(tmp_path, max_s=12.0).running() as rig:
        await rig.ready()
        await calibrated(rig)
        await rig.until(lambda: headline(rig)[1] == "READY", 5.0)
        in_force, core = rig.service.arming.readiness.in_force, rig.service.core
        state = in_force._triads["fc", "gyro"]
        held = state.held
        assert isinstance(held, Held)
        words = []
        for off_sigmas in (2.9, 3.1, 2.9, 2.1, 1.9, 2.9):
            window = await core.window()
            solution, *_ = await in_force._estimator.solve(window, in_force.what)
            (imu,) = [imu for imu in solution.imus if imu.name == "fc"]
            both = np.hypot(held.sigma, np.sqrt(np.diag(imu.covariance))[:3])
            expected = np.array(imu.gyro_rad_s) - off_sigmas * both
            state.held = msgspec.structs.replace(held, expected=tuple(expected.tolist()))
            in_force._note(solution, window.end_s, 12.0)
            words.append(headline(rig)[1])
        assert words == ["READY", *["NOT CALIBRATED"] * 3, "READY", "READY"]
