"""History of alignments: their results, and the parameters that they wrote; for `companion history` and `status`."""

from __future__ import annotations

import logging
from collections.abc import Mapping

import msgspec

from companion.autopilot.parameters.wire import same_float32
from companion.component.service import JobResult
from companion.daemon.core import Core
from companion.daemon.devices.autopilot_imu import AutopilotImu
from companion.daemon.job import Job
from companion.errors import StorageError
from companion.estimation.records.align_record import AlignmentRecord, FacesRecord, TurnRecord
from companion.formats import Object, utc_now
from companion.storage.changes import PREDICTION, ChangeSet
from companion.storage.learned import KEEP_DONE, Done, alignments_in

logger = logging.getLogger(__name__)


class ByHand:
    """The latest alignments, on disk and in memory."""

    def __init__(self, core: Core, imus: Mapping[str, AutopilotImu]) -> None:
        self._file = alignments_in(core.config.storage.path)
        self._vehicle, self._offload, self._imus = core.vehicle, core.offload, imus
        self._done: list[Done] = []

    def load(self) -> None:
        """Read the file; blocking."""
        self._done = self._file.read()

    async def keep(self, job: Job, result: JobResult) -> None:
        """Add an alignment that has delivered a record, unless it was cancelled."""
        record = job.product
        if result.outcome == "cancelled" or not isinstance(record, AlignmentRecord | FacesRecord | TurnRecord):
            return
        board = record.board.written if isinstance(record, TurnRecord) and record.board is not None else {}
        parts = [board, *([] if isinstance(record, AlignmentRecord) else [imu.written for imu in record.imus])]
        kept = [(name, one) for part in parts for name, one in part.items() if one.outcome in ("verified", "stored")]
        done = Done(
            what="level" if board else record.kind,
            state=result.outcome,
            measured_at=record.measured_at,
            reason=result.reason,
            system_id=self._vehicle.system_id,
            written={name: one.after for name, one in kept},
        )
        await self._write([*self._done, done][-KEEP_DONE:])

    async def undone(self, step: ChangeSet) -> None:
        """Note that the writes of a step were undone."""
        now = utc_now()
        await self._write(
            [
                msgspec.structs.replace(each, undone_at=now) if each.measured_at == step.origin.at else each
                for each in self._done
            ]
        )

    async def _write(self, done: list[Done]) -> None:
        self._done = done
        try:
            await self._offload(self._file.write, done)
        except StorageError as error:
            logger.error("the history does not show it: %s", error)  # noqa: TRY400 - one line

    def history(self) -> list[Object]:
        """List all alignments, the latest first, each with whether it is in force."""
        return [self._shown(done) for done in reversed(self._done)]

    def latest(self) -> list[Object]:
        """List the last alignment of each kind on this aircraft, the latest first."""
        here = {done.what: done for done in self._done if done.system_id == self._vehicle.system_id}
        here.pop(PREDICTION, None)
        return [self._shown(done) for done in sorted(here.values(), key=self._done.index, reverse=True)]

    def _shown(self, done: Done) -> Object:
        return {**msgspec.to_builtins(done), "in_force": self._in_force(done)}

    def _in_force(self, done: Done) -> bool | None:
        """Whether the autopilot holds all written values; None where none is read from it."""
        if done.undone_at is not None:
            return False
        if done.system_id != self._vehicle.system_id:
            return None
        now: dict[str, float] = {}
        for imu in self._imus.values():
            now |= {} if imu.calibration is None else imu.calibration.corrections
        seen = [same_float32(now[name], value) for name, value in done.written.items() if name in now]
        return all(seen) if seen else None
