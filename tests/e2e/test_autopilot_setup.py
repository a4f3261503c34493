"""`companion autopilot-setup`: the doubles' parameters, bit for bit, and what they then make of the stream."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any, Literal

import pytest

from companion.autopilot.vehicle.vehicle import ArmState
from companion.cli.setup import setup_lines
from companion.errors import CompanionError
from tests.e2e.test_attitude_push import flight
from tests.support.rig import Rig
from tests.support.virtual_time import run_virtual

Firmware = Literal["ardupilot", "px4"]
BEFORE: dict[Firmware, dict[str, float]] = {
    "ardupilot": {"VISO_TYPE": 0.0, "EK3_SRC1_YAW": 1.0},
    "px4": {"EKF2_EV_CTRL": 3.0, "EKF2_EV_NOISE_MD": 1.0, "EKF2_EVA_NOISE": 0.1234, "EKF2_EV_DELAY": 12.5},
}
AFTER: dict[Firmware, dict[str, float]] = {
    "ardupilot": {"VISO_TYPE": 1.0, "EK3_SRC1_YAW": 6.0},
    "px4": {"EKF2_EV_CTRL": 11.0, "EKF2_EV_NOISE_MD": 0.0, "EKF2_EVA_NOISE": 0.05, "EKF2_EV_DELAY": 0.0},
}


async def ask(rig: Rig, action: str, **more: Any) -> dict[str, Any]:
    request = {"command": "autopilot-setup", "action": action, **more}
    (reply,) = [reply async for reply in rig.service.faces.answers.answer(request)]
    return reply


def values(rig: Rig, firmware: Firmware) -> dict[str, float]:
    return {name: rig.autopilot.parameter(name) for name in BEFORE[firmware]}


@pytest.mark.parametrize("firmware", ["ardupilot", "px4"])
def test_show_apply_undo(tmp_path: Path, firmware: Firmware) -> None:
    async def main() -> None:
        async with flight(
            tmp_path, firmware=firmware, calibrated=False, used=False, parameters=BEFORE[firmware]
        ) as flying:
            rig = flying.rig
            before = values(rig, firmware)
            shown = await ask(rig, "show")
            assert shown["state"] == "not applied"
            assert {row["parameter"]: row["wanted"] for row in shown["parameters"]} == pytest.approx(AFTER[firmware])
            assert shown["risks"]
            assert setup_lines(shown)
            assert values(rig, firmware) == before
            applied = await ask(rig, "apply")
            assert applied["state"] == "applied"
            assert {one["outcome"] for one in applied["written"].values()} == {"stored"}
            assert values(rig, firmware) == pytest.approx(AFTER[firmware])
            assert (await ask(rig, "show"))["state"] == "applied"
            assert "nothing was written" in (await ask(rig, "apply"))["reason"]
            # A calibration's undo is another's: it must not take this with it.
            await flying.calibrate()
            undone = await ask(rig, "undo")
            assert undone["state"] == "undone"
            assert values(rig, firmware) == before
            with pytest.raises(CompanionError, match="nothing to undo"):
                await ask(rig, "undo")
            assert rig.service.offsets.ledger.undoable  # the calibration's

    run_virtual(main())


def test_only_disarmed_and_only_with_a_stream_to_come(tmp_path: Path) -> None:
    async def main() -> None:
        async with flight(tmp_path, calibrated=False, used=False) as flying:
            flying.rig.autopilot.arm()
            await asyncio.sleep(1.5)
            with pytest.raises(CompanionError, match="armed"):
                await ask(flying.rig, "apply")
            assert not [write for write in flying.rig.double.writes if "EK3" in write.name or "VISO" in write.name]
            flying.rig.autopilot.disarm()
            await flying.rig.until(lambda: flying.rig.service.core.vehicle.arm_state is ArmState.DISARMED, 10.0)
            # Nothing was written, so nothing is looked after first.
            assert (await ask(flying.rig, "apply"))["state"] == "applied"
            assert not [text for text in flying.rig.ground.texts() if "Interrupted write" in text]
        rig = Rig(tmp_path / "off")
        async with rig.running():
            await rig.ready()
            with pytest.raises(CompanionError, match=r'push\.attitude is "off"'):
                await ask(rig, "apply")

    run_virtual(main())


@pytest.mark.parametrize("firmware", ["ardupilot", "px4"])
def test_a_daemon_that_dies_in_the_middle_leaves_the_old_values(tmp_path: Path, firmware: Firmware) -> None:
    """The second write never gets through; the next daemon puts the first back by itself."""

    async def main() -> None:
        first = flight(tmp_path, firmware=firmware, calibrated=False, used=False, parameters=BEFORE[firmware])
        async with first as flying:
            rig = flying.rig
            before = values(rig, firmware)
            asking = asyncio.ensure_future(ask(rig, "apply"))
            name = next(iter(BEFORE[firmware]))
            await rig.until(lambda: rig.autopilot.parameter(name) != before[name], 10.0)
            kept = (tmp_path / "setup/journal.json").read_bytes()
            asking.cancel()
            await asyncio.gather(asking, return_exceptions=True)
            halfway = values(rig, firmware) | {name: AFTER[firmware][name]}
        (tmp_path / "setup/journal.json").write_bytes(kept)  # as the power cut found it
        second = flight(tmp_path, firmware=firmware, calibrated=False, used=False, parameters=halfway)
        async with second as flying:
            await flying.rig.until(lambda: values(flying.rig, firmware) == before, 30.0)
            await flying.rig.until(lambda: not (tmp_path / "setup/journal.json").exists(), 5.0)

    run_virtual(main())


def test_the_set_up_and_the_stream_together(tmp_path: Path) -> None:
    """Apply, restart, calibrate: EKF3 has our heading."""

    async def main() -> None:
        async with flight(tmp_path, calibrated=False, used=False) as flying:
            rig = flying.rig
            await ask(rig, "apply")
            rig.double.reboot()
            await rig.until(lambda: rig.service.core.vehicle.boots == 1, 20.0)
            assert rig.double.external_nav.selected
            await flying.sleep(15.0)
            await flying.calibrate()
            await flying.pushing()
            await flying.sleep(3.0)
            assert rig.double.external_nav.in_use(rig.now_s)
            assert flying.theirs_deg() < 2.0

    run_virtual(main())
