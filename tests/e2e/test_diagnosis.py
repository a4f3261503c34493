"""Why the autopilot does not arm: the culprit is named, the remedy carried out on request, and then it arms."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion import summary
from companion.errors import CalibrationRefusedError
from sim.ardupilot.double import ArduPilotDouble
from sim.imu_model import DEG_H
from tests.e2e.test_calibration import calibrated
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

SECOND = '[[imu]]\nname = "fc2"\nsource = "autopilot"\ninstance = 2\nprofile = "icm42688p"\n'
WITHIN_S = 60.0
DEG_S = 3600.0 * DEG_H
UNBIASED = (0.0, 0.0, 0.0)


def findings(rig: Rig) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = rig.service.status()["diagnosis"]
    return found


async def until_line(rig: Rig, words: str) -> dict[str, Any]:
    await rig.until(lambda: any(words in one["line"] for one in findings(rig)), WITHIN_S)
    return next(one for one in findings(rig) if words in one["line"])


async def ask(rig: Rig, command: str) -> list[dict[str, Any]]:
    return [reply async for reply in rig.service.faces.answer({"command": command, "wait": True})]


async def ready(rig: Rig) -> None:
    await rig.ready()
    if isinstance(rig.autopilot, ArduPilotDouble):
        rig.autopilot.repeats_failures = True


def armable(rig: Rig) -> Callable[[], bool]:
    return lambda: not rig.autopilot.prearm_failures(rig.now_s) and not findings(rig)


@pytest.mark.parametrize(
    ("firmware", "gyro_deg_s", "accel", "words", "done"),
    [
        ("ardupilot", (0.0, 0.0, 6.0), UNBIASED, "IMU 2 z is 6.0 deg/s off (limit 5.0), IMU 1 agrees", "its gyros"),
        ("ardupilot", UNBIASED, (0.0, 0.9, 0.0), "IMU 2 y is 0.89 m/s^2 off (limit 0.75), IMU 1 agrees", "mg"),
        ("px4", UNBIASED, (0.0, 0.9, 0.0), "IMU 2 y is 0.90 m/s^2 off (limit 0.70), IMU 1 agrees", "mg"),
    ],
)
def test_the_odd_imu_is_named_and_fix_mends_it(
    tmp_path: Path, firmware: Any, gyro_deg_s: tuple[float, ...], accel: tuple[float, ...], words: str, done: str
) -> None:
    async def main() -> None:
        streams: dict[str, Any] = {"default_streams": True} if firmware == "px4" else {}
        async with Rig(tmp_path, firmware=firmware, more=SECOND, max_s=12.0, **streams).running() as rig:
            await ready(rig)
            rig.models[1].turn_on(np.multiply(gyro_deg_s, DEG_S), accel)
            found = await until_line(rig, words)
            assert "companion fix" in found["remedy"]
            status = rig.service.status()
            assert status["headline"]["word"] == "WILL NOT ARM"
            assert status["headline"]["reason"] == found["line"]
            assert status["headline"]["remedy"] == found["remedy"]
            assert ("wrong", summary.REFUSES, found["line"], found["remedy"]) in summary.rows(status)
            values: Any = rig.autopilot
            before = dict(values.parameters.values)
            replies = await ask(rig, "fix")
            result = replies[-1].get("record", replies[-1])
            assert result["state"] == "done", result
            assert done in result["reason"]
            await rig.until(armable(rig), WITHIN_S)
            assert (await ask(rig, "undo"))[-1]["state"] == "done"
            assert values.parameters.values == before

    run_virtual(main())


def test_a_gyro_that_changed_since_its_calibration_is_to_be_replaced(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, max_s=12.0).running() as rig:
            await ready(rig)
            await calibrated(rig)
            rig.model.turn_on((0.0, 0.0, 6.0 * DEG_S), UNBIASED)
            found = await until_line(rig, "changed by 6.0 deg/s since its calibration")
            assert "IMU 1 z is 6.0 deg/s off" in found["line"]
            assert found["remedy"] == "replace IMU 1 or set INS_USE = 0"
            assert found["fix"] == ""
            with pytest.raises(CalibrationRefusedError):
                await ask(rig, "fix")

    run_virtual(main())


def test_an_imu_that_is_not_configured_is_named_too(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, max_s=12.0).running() as rig:
            await ready(rig)
            rig.models[1].turn_on(UNBIASED, (0.9, 0.0, 0.0))
            found = await until_line(rig, "IMU 2 x is 0.90 m/s^2 off")
            assert "instance = 2" in found["remedy"]
            assert found["fix"] == ""

    run_virtual(main())


def test_texts_without_a_cause_are_passed_on_and_vanish_with_their_cause(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, max_s=12.0).running() as rig:
            await ready(rig)
            real, reasons = rig.double.prearm_failures, ["Hardware safety switch", "heater temp low (21.5 < 45)"]
            rig.double.prearm_failures = lambda loop_s: [*real(loop_s), *reasons]  # type: ignore[method-assign]
            found = await until_line(rig, "Hardware safety switch")
            assert (found["line"], found["remedy"]) == ("PreArm: Hardware safety switch", "")
            cold = await until_line(rig, "heater temp low")
            assert cold["waits"]
            assert "BRD_HEAT_TARG" in cold["remedy"]
            assert findings(rig)[0] == cold
            assert summary.rows(rig.service.status())[0][3] == cold["remedy"]
            reasons.clear()
            await rig.until(lambda: not findings(rig), WITHIN_S)

    run_virtual(main())


def test_a_long_text_is_joined_and_nothing_is_diagnosed_while_armed(tmp_path: Path) -> None:
    async def main() -> None:
        async with Rig(tmp_path, max_s=12.0).running() as rig:
            await ready(rig)
            text = "AHRS: EKF3 Yaw inconsistent 51 deg. Wait or reboot"
            rig.double.prearm_failures = lambda loop_s: [text]  # type: ignore[method-assign]
            found = await until_line(rig, text)
            assert "restart the autopilot" in found["remedy"]
            assert len(findings(rig)) == 1
            rig.double.arm()
            await rig.until(lambda: not findings(rig), WITHIN_S)

    run_virtual(main())
