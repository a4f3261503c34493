"""The daemon starts with damaged or hostile state files, names them, and writes nothing from them."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from companion.component.service import Refusal
from companion.storage.changes import Changed, ChangeLog, ChangeSet
from companion.storage.state import sealed
from tests.support.rig import Rig


def changes(name: str, before: float) -> bytes:
    return sealed(msgspec.json.encode(ChangeSet(1, (Changed(name, before=before, after=0.001),))))


@pytest.mark.parametrize(
    ("name", "damage", "reason"),
    [
        ("journal.json", lambda path: path.write_bytes(changes("INS_GYROFFS_X", 9.5)), "used"),
        ("undo-1.json", os.mkfifo, "read"),
    ],
    ids=["journal", "undo"],
)
async def test_a_damaged_file_is_named_and_nothing_of_it_is_written(
    tmp_path: Path, name: str, damage: Callable[[Path], Any], reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    """tests/unit/storage/test_state.py has the other contents and the other files."""
    path = tmp_path / name
    damage(path)

    rig = Rig(tmp_path, version="4.6", parameters={"INS_GYROFFS_X": 0.001})
    async with rig.running():
        await rig.ready()
        await asyncio.sleep(10.0)
        (said,) = [words for words in caplog.messages if path.name in words]
        assert said in rig.service.status()["warnings"]
        assert said.startswith(f"{path}: cannot be {reason}: ")
        assert rig.service.offsets.journal.fault is None
        assert not rig.service.offsets.journal.pending
        if name == "undo-1.json":
            answer = rig.service.calibrating.manager.start_undo("test")
            assert isinstance(answer, Refusal)
            assert answer.reason == "nothing to undo; the undo file was damaged"
        else:
            assert "Interrupted write, file damaged: calibrate" in rig.ground.texts()
        assert rig.double.writes == []


@pytest.mark.parametrize(("version", "name"), [("4.6", "CAL_GYRO0_XOFF"), ("4.8", "INS5_GYROFFS_X")])
async def test_a_journal_of_parameters_that_this_autopilot_has_not_is_brought_to_an_end(
    tmp_path: Path, version: str, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    """A journal of another firmware, or of an IMU that is gone: recovery ends, and existing parameters are restored."""
    there = "INS_GYROFFS_X" if name.startswith("INS") else name
    found = ChangeSet(1, tuple(Changed(each, before=0.0, after=0.001) for each in dict.fromkeys((name, there))))
    ChangeLog(tmp_path).journal.write(found)

    async with Rig(tmp_path, version=version, parameters={"INS_GYROFFS_X": 0.001}).running() as rig:
        await rig.until(lambda: not rig.service.offsets.journal.pending, 20.0)
        ours = name.startswith("INS")
        assert rig.double.parameter("INS_GYROFFS_X") == pytest.approx(0.0 if ours else 0.001)
        assert len(rig.double.writes) == int(ours)
        assert any(name in words for words in caplog.messages)
