"""A result that contradicts earlier calibrations is reported, not written; the gate stays, people may write it."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import msgspec
import pytest

from companion.cli.show import monitor_lines, record_lines
from companion.daemon.arming import automatic
from companion.estimation.machine import State
from tests.e2e.test_automatic import calibrated_by_itself, values
from tests.e2e.test_bias_memory import knocked
from tests.e2e.test_calibration import calibrated
from tests.support.rig import Rig

SLOW: dict[str, Any] = {
    "own_imu": True, "imu_rate_hz": 10.0, "device_rate_hz": 2.0, "feed_s": 0.5, "min_still_s": 5.0, "max_s": 6.0,
}  # fmt: skip
AGAIN_WITHIN_S = 150.0


@pytest.fixture(autouse=True)
def _soon_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(automatic, "SPACING_S", 30.0)


def accelerometers(rig: Rig) -> dict[str, float]:
    return {name: value for name, value in values(rig).items() if "ACC" in name}


async def held_back(rig: Rig) -> dict[str, float]:
    """Calibrated by itself, then the gradienter slips, and the next one by itself is over; accelerometers as before."""
    await calibrated_by_itself(rig)
    before = accelerometers(rig)
    knocked(rig)
    await rig.until(lambda: len(rig.service.calibrating.store.history()) >= 2, AGAIN_WITHIN_S)
    await asyncio.sleep(10.0)
    return before


async def test_accelerometers_are_held_back_when_the_gradienter_has_moved_until_somebody_asks(tmp_path: Path) -> None:
    async with Rig(tmp_path, at_arm="gate", **SLOW).running() as rig:
        before = await held_back(rig)
        (record, first), said = rig.service.calibrating.store.history(), "".join(rig.ground.texts())
        assert record.state == "done"
        assert record.reason.endswith("accelerometers of fc held back")
        fc = record.imus[0]
        assert {"GYR" in name for name in fc.written} == {True}, "the gyros are in no doubt"
        assert {"GYR" in name for name in first.imus[0].written} == {True, False}
        assert fc.accel_bias_m_s2 is not None, "what was measured is kept"
        assert [imu.held_back for imu in record.imus] == [("accel",), ()]
        (line,) = [line for line in record_lines(msgspec.to_builtins(record)) if "held back: not written" in line]
        assert line.strip().startswith("accel bias mg")
        drawn = monitor_lines(msgspec.to_builtins(rig.service.status()))
        assert [line[:14] for line in drawn if "held back: not written" in line] == ["fc       accel"]
        assert [imu["held_back"] for imu in rig.service.status()["calibration"]["imus"]] == [["accel"], []]
        assert accelerometers(rig) == before
        assert "The gradienter has moved by 0.3" in said
        assert "Held back: accelerometers of fc; to write it, calibrate on request" in said
        # With what is in force it may arm as ever, and everybody is told.
        answer = rig.service.arming.readiness.answer()
        assert answer.verdict == "accept"
        told = "held back: accelerometers of fc (gradienter or its zero moved); calibrate to write it"
        assert answer.words.endswith(told)
        assert told in str(rig.service.status())
        # Nor does it call for another calibration; one that the gyros call for holds it back again.
        for _ in range(60):
            await asyncio.sleep(1.0)
            assert not any("accel" in found.words for found in rig.service.arming.in_force.findings(rig.now_s))
        await rig.until(lambda: rig.service.calibrating.manager.state is State.DONE, 60.0)
        assert accelerometers(rig) == before
        assert rig.service.arming.in_force.held_back is not None
        assert (await calibrated(rig))[0].outcome == "done"
        asked = rig.service.calibrating.store.history(1)[0]
        written = {"GYR" in name for name in asked.imus[0].written}
        # The gyros' are written again only where that betters them.
        assert written == ({False} if asked.imus[0].unchanged == ("gyro",) else {True, False})
        assert asked.imus[0].held_back == ()
        assert any(words.startswith("the gradienter has moved by 0.3") for words in asked.warnings)
        assert all(accelerometers(rig)[name] != value for name, value in before.items())
        await asyncio.sleep(10.0)
        assert "held back" not in rig.service.arming.readiness.answer().words


async def test_a_restart_that_keeps_the_offsets_keeps_what_is_held_back_and_the_gate_opens_again(
    tmp_path: Path,
) -> None:
    async with Rig(tmp_path, at_arm="gate", **SLOW).running() as rig:
        before = await held_back(rig)
        rig.autopilot.reboot()
        await rig.until(lambda: rig.service.core.vehicle.boots == 1, 10.0)
        await rig.until(lambda: rig.service.arming.readiness.answer().verdict == "accept", 40.0)
        assert len(rig.service.calibrating.store.history()) == 2, "nothing had to be measured anew"
        assert rig.service.arming.in_force.held_back is not None
        assert accelerometers(rig) == before
