"""A write that was cut off, or an undo: the history says so, while the old values are awaited and after."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from companion.cli.show import history_lines
from companion.estimation.records.validity import Why
from tests.e2e.test_calibration import calibrated, started
from tests.e2e.test_faults import values
from tests.support.rig import Rig

QUICK: dict[str, Any] = {"min_still_s": 4.0, "max_s": 8.0}


async def history(rig: Rig) -> list[str]:
    (reply,) = [dict(each) async for each in rig.service.faces.answer({"command": "history"}, "test")]
    reply.pop("kind")
    return history_lines(**reply)


async def told(rig: Rig) -> str:
    lines = await history(rig)
    (heading,) = [at for at, line in enumerate(lines) if "interrupted (UTC)" in line]
    return lines[heading + 1]


async def test_an_undo_that_armed_in_its_middle_is_brought_to_its_end_and_told_as_one(tmp_path: Path) -> None:
    async with Rig(tmp_path, **QUICK).running() as rig:
        await rig.ready()
        before = values(rig.double)
        assert (await calibrated(rig))[0].outcome == "done"
        rig.double.faults.arm_after_writes = 2
        failed = await started(rig.service.calibrating.manager.start_undo("test")).finished
        assert failed.outcome == "failed"
        assert "undone in part (" in failed.reason
        assert failed.reason.endswith("the rest follows once disarmed")
        assert "calibration, 11 parameters: old values not restored yet" in await told(rig)
        rig.double.disarm()
        await rig.until(lambda: not rig.service.offsets.journal.pending, 30.0)
        assert values(rig.double) == before
        assert rig.service.status()["undoable"] == []
        assert " old values restored, 20" in await told(rig)
        (record,) = rig.service.calibrating.store.history()
        assert record.undone_at
        await rig.until(
            lambda: {each.why for each in rig.service.arming.in_force.findings(rig.now_s)} == {Why.UNDONE}, 5.0
        )
