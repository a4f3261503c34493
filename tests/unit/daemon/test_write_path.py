"""`Offsets.commit`: new values stay only when their effect was seen and they can be undone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from companion.autopilot.parameters.change import Change, WriteFailedError
from companion.autopilot.vehicle.vehicle import ArmState
from companion.daemon.job import JobCancelledError
from companion.daemon.offsets.journal import WriteJournal
from companion.daemon.offsets.subsystem import Offsets
from companion.errors import AutopilotError, StorageError
from companion.estimation.machine import Machine, State
from companion.storage.changes import ChangeLog, Origin

PLANNED = [Change("INS_GYROFFS_X", 0.0, 0.001)]
MADE = [*PLANNED, Change("INS_GYR2OFFS_X", 0.0, 0.002)]
"""The firmware changed another one."""


class Writer:
    def __init__(self) -> None:
        self.restored: list[Change] = []
        self.fails: Exception | None = None

    async def restore(self, changes: Sequence[Change]) -> dict[str, Any]:
        self.restored += changes
        if self.fails is not None:
            raise self.fails
        return {}


class WritePathAircraft:
    """A write path over a real journal; writer and vehicle are stand-ins."""

    def __init__(self, folder: Path) -> None:
        self.disk_is_full = False
        self.journal = WriteJournal(ChangeLog(folder), self._offload)
        self.journal.load()
        self.writer, self.machine = Writer(), Machine()
        self.machine.state = State.WRITING
        vehicle = SimpleNamespace(system_id=1, arm_state=ArmState.DISARMED)
        path: Any = Offsets.__new__(Offsets)
        path._vehicle, path._machine, path.writer, path.journal = vehicle, self.machine, self.writer, self.journal
        self.path: Offsets = path

    async def _offload(self, function: Any, *arguments: Any) -> Any:
        if self.disk_is_full:
            raise StorageError("no space left")
        return function(*arguments)

    async def commit(self, verdict: Exception | None = None, *, full: bool = False) -> None:
        async def apply() -> list[Change]:
            assert self.journal._open is not None, "old values on disk before the first write"
            return MADE

        async def verify() -> None:
            assert self.machine.state is State.VERIFYING
            self.disk_is_full = full
            if verdict is not None:
                raise verdict

        await self.path.commit(PLANNED, Origin("calibration"), [], apply, verify)


async def test_a_verified_write_can_be_undone_with_all_that_it_changed(tmp_path: Path) -> None:
    aircraft = WritePathAircraft(tmp_path)
    await aircraft.commit()
    (step,) = aircraft.journal.steps(1)
    assert step.names == [change.parameter for change in MADE]
    assert not aircraft.writer.restored


@pytest.mark.parametrize(
    ("verdict", "full", "raised"),
    [
        (AutopilotError("not followed"), False, AutopilotError),
        (StorageError("not kept"), False, AutopilotError),
        (JobCancelledError("cancelled by test"), False, JobCancelledError),
        (None, True, AutopilotError),
    ],
    ids=["no effect", "a restart owed is not kept", "cancelled", "no undo can be kept"],
)
async def test_a_write_that_must_not_stay_is_restored_at_once(
    tmp_path: Path, verdict: Exception | None, full: bool, raised: type[Exception]
) -> None:
    aircraft = WritePathAircraft(tmp_path)
    with pytest.raises(raised, match=r"; old values restored$"):
        await aircraft.commit(verdict, full=full)
    assert aircraft.writer.restored == MADE
    assert aircraft.journal.steps(1) == ()
    assert aircraft.journal.pending is full, "a disk that cannot forget the write leaves it to the recovery"


async def test_values_that_could_not_be_restored_are_named_and_left_to_the_recovery(tmp_path: Path) -> None:
    aircraft = WritePathAircraft(tmp_path)
    aircraft.writer.fails = WriteFailedError("armed in the middle", "armed", {}, ("INS_GYROFFS_X",))
    with pytest.raises(AutopilotError, match="old values NOT restored in INS_GYROFFS_X: restored once disarmed"):
        await aircraft.commit(AutopilotError("not followed"))
    assert aircraft.journal.pending
