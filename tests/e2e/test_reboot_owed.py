"""A pending restart of PX4 survives a restart of the companion; a done one is forgotten."""

from __future__ import annotations

import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from companion.autopilot.firmware.px4 import PX4
from companion.autopilot.parameters.change import Change
from companion.daemon.offsets.reboot import RequiredReboot, owed_in
from tests.e2e.test_calibration import calibrated
from tests.support.rig import Rig, inline

LARGE = (Change("CAL_ACC0_XOFF", 0.3, 0.0),)


@pytest.mark.parametrize("restarted", [False, True])
async def test_no_face_says_ready_after_a_restart_of_the_companion_until_px4_was_restarted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, restarted: bool
) -> None:
    rig = Rig(tmp_path, firmware="px4", max_s=12.0, parameters={"CAL_ACC0_XOFF": 0.3})
    monkeypatch.setenv("COMPANION_BOOT_ID", "before")
    async with rig.running():
        await rig.ready()
        assert (await calibrated(rig))[0].outcome == "done"
        assert "reboot PX4: tilt " in rig.service.status()["headline"]["reason"]
    rig.wire.__init__(rig.link, rig.px4)  # type: ignore[misc]
    rig.radio.__init__(rig.ground, rig.px4.ground)  # type: ignore[misc]
    monkeypatch.setenv("COMPANION_BOOT_ID", "after")  # the board was off, too
    if restarted:
        rig.px4.reboot()
        await asyncio.sleep(4.0)
    async with rig.running():
        words = set()
        for _ in range(40):
            words.add(rig.service.status()["headline"]["word"])
            await asyncio.sleep(1.0)
        status = rig.service.status()
        assert ("READY" in words) is restarted
        assert owed_in(tmp_path).path.exists() is not restarted
        if not restarted:
            assert "reboot PX4: tilt " in status["headline"]["reason"]
            assert status["arming"]["verdict"] != "accept"
            rig.px4.reboot()
            await rig.until(lambda: rig.service.status()["headline"]["word"] == "READY", 60.0)
            assert not owed_in(tmp_path).path.exists()


@pytest.mark.parametrize(
    ("boot_s", "later_s", "same_board", "owed"),
    [
        (130.0, 30.0, True, True),  # nothing has happened
        (20.0, 30.0, True, False),  # it is younger than it was
        (110.0, 200.0, True, False),  # it is older, but began later
        (130.0, 30.0, False, True),
        (20.0, 30.0, False, False),
        (110.0, 200.0, False, True),  # nobody can tell
        (None, 30.0, True, True),  # not heard yet
    ],
)
async def test_a_restart_that_nobody_saw_shows_in_the_time_since_boot(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    boot_s: float | None,
    later_s: float,
    *,
    same_board: bool,
    owed: bool,
) -> None:
    def known(boot_s: float | None, host: str) -> RequiredReboot:
        monkeypatch.setenv("COMPANION_BOOT_ID", host)
        now_s = asyncio.get_running_loop().time()
        boot = SimpleNamespace(latest=None if boot_s is None else (boot_s, now_s))
        vehicle = SimpleNamespace(kind=PX4(), system_id=1, boots=0, boot=boot)
        config = SimpleNamespace(storage=SimpleNamespace(path=tmp_path))
        core: Any = SimpleNamespace(config=config, vehicle=vehicle, offload=inline)
        made = RequiredReboot(core)
        made.load()
        return made

    await asyncio.sleep(1000.0)
    before = known(100.0, "one")
    await before.after(LARGE)
    await before.after([Change("CAL_ACC0_XOFF", 0.0, 0.001)])
    assert before.words == "reboot PX4: tilt 1.8 deg off"
    await asyncio.sleep(later_s)
    again = known(boot_s, "one" if same_board else "other")
    assert again.words == (before.words if owed else None)
