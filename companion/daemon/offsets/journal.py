"""Journal of writes to the autopilot, in memory and on disk; recovery of interrupted writes, and undo of finished ones.

A write is "open" while it is in progress. It is "orphaned" if it was interrupted: the daemon died, or not all old
values could be restored. `Recovery` ends an orphaned write. The last finished writes on each vehicle are "undoable".
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Mapping, Sequence
from typing import Final

import msgspec

from companion.autopilot.firmware.firmwares import LEARNED
from companion.autopilot.parameters.change import Change, NothingWrittenError, WriteFailedError, same_float32
from companion.autopilot.vehicle.gyro_calibration import wait_until_over
from companion.autopilot.vehicle.parameter_writer import ParameterWriter
from companion.autopilot.vehicle.vehicle import ArmState
from companion.component.statustext import Severity, Weight
from companion.daemon.core import Core, Offload
from companion.daemon.devices.autopilot_imu import AutopilotImu, changing
from companion.daemon.offsets.reboot import RequiredReboot
from companion.errors import AutopilotError, ParameterRefusedError, StorageError
from companion.estimation.records.record import WrittenParameter
from companion.formats import Object, utc_now
from companion.messages import message
from companion.storage.changes import ChangeLog, ChangeSet, Interruption, Undoable, interruptions_in

logger = logging.getLogger(__name__)

RETRY_S: Final = 3.0
POLL_S: Final = 0.2


class WriteJournal:
    """Write journal and undo steps of one storage folder."""

    def __init__(self, log: ChangeLog, offload: Offload, why_yield: Callable[[], str | None] = lambda: None) -> None:
        self._log, self._offload, self.why_yield = log, offload, why_yield
        """`why_yield` returns the reason not to write while another companion writes on the same link, or None."""
        self.fault: str | None = None
        """Reason why no old value can be saved on disk, so that no parameter may be written; None: no fault."""
        self._open: ChangeSet | None = None
        self._orphaned = asyncio.Event()
        self._undoable: dict[int, Undoable] = {}
        self.unusable: tuple[str, ...] = ()  # Damaged files that were set aside, one line of text each
        self.lost_write = False  # True: the journal was damaged, so an interrupted write cannot be restored

    @property
    def pending(self) -> bool:
        return self._orphaned.is_set()

    def load(self) -> None:
        """Load journal and undo files, set damaged ones aside, and check that files can be written; blocks."""
        try:
            self._log.check_writable()
        except StorageError as error:
            self.fault = message("no_writes_without_storage", reason=error)
        journal, undos = self._log.journal, self._log.undos()
        self._open = journal.load()
        kept = [file.load() for file in undos]
        self._undoable = {each.system_id: each for each in kept if each is not None}
        met = (journal.unusable, *(file.unusable for file in undos))
        self.unusable += tuple(words for words in met if words is not None)
        self.lost_write |= journal.unusable is not None
        self._leave_to_recovery()

    @property
    def undoable(self) -> list[int]:
        return sorted(system_id for system_id, each in self._undoable.items() if each.all)

    def steps(self, system_id: int | None) -> tuple[ChangeSet, ...]:
        found = self._undoable.get(system_id or 0)
        return () if found is None else found.all

    @property
    def orphaned(self) -> ChangeSet | None:
        return self._open if self.pending else None

    def is_undoable(self, changes: ChangeSet) -> bool:
        kept = self._undoable.get(changes.system_id)
        return kept is not None and kept.without(changes) is not kept

    async def interrupted(self) -> ChangeSet:
        while self._open is None or not self.pending:
            await self._orphaned.wait()
        return self._open

    @contextlib.asynccontextmanager
    async def transaction(self, changes: ChangeSet) -> AsyncIterator[None]:
        """Enclose a write to the autopilot, so that its old values are restored if it does not finish.

        The old values are on disk before the block begins. The block calls `done` or `undone` at its end. If it raises
        an error of the writer that left no parameter changed, the autopilot is as before. After any other end (a value
        left changed, a cancellation, a program error, neither call), `Recovery` checks and restores the parameters.
        `changes`: the changes planned in the block; `update_pending` replaces them.

        Raises:
            AutopilotError: an earlier write is still open, or another companion writes; the block does not run.
            StorageError: the changes cannot be saved, or include a forbidden name or value; the block does not run.
        """
        if self._open is not None:
            raise AutopilotError(message("restoring_old_values", reason="an earlier write is still open"))
        if (why := self.why_yield()) is not None:
            raise AutopilotError(message("nothing_written", reason=why))
        await self.update_pending(changes)
        try:
            yield
        except (WriteFailedError, NothingWrittenError) as error:
            if not error.left_changed:
                with contextlib.suppress(StorageError):
                    await self.unchanged()
            raise
        finally:
            self._leave_to_recovery()

    def _leave_to_recovery(self) -> None:
        """Leave a write that is still open to `Recovery`, which restores its old values once disarmed."""
        if self._open is not None:
            self._orphaned.set()

    async def update_pending(self, changes: ChangeSet) -> None:
        """Save the changes of a write before they are made; after a StorageError the file keeps its earlier content."""
        if self._open is not None:
            changes = msgspec.structs.replace(changes, origin=self._open.origin)
        await self._offload(self._log.journal.write, changes)
        self._open = changes

    async def done(self, changes: ChangeSet) -> None:
        """End a transaction whose new values stay, and save its undo step. A StorageError leaves it open."""
        kept = self._undoable.get(changes.system_id, Undoable(changes.system_id))
        await self._keep(kept.and_then(changes))
        await self.unchanged()

    async def undone(self) -> None:
        """End a transaction after which the old values are active again. A StorageError leaves it open."""
        if self._open is not None and (kept := self._undoable.get(self._open.system_id)) is not None:
            # The open entry is an undo, or a finished write whose journal was not cleared: drop its undo step.
            left = kept.without(self._open)
            if left is not kept:
                await self._keep(left)
        await self.unchanged()

    async def _keep(self, undoable: Undoable) -> None:
        file = self._log.undo_of(undoable.system_id)
        await (self._offload(file.write, undoable) if undoable.steps else self._offload(file.clear))
        self._undoable[undoable.system_id] = undoable

    async def unchanged(self) -> None:
        """End a transaction and leave the undo steps unchanged. A StorageError leaves it open."""
        await self._offload(self._log.journal.clear)
        self._open = None
        self._orphaned.clear()


class Recovery:
    """Recovery of interrupted writes, and undo of finished ones: both write old values back to the autopilot."""

    def __init__(
        self,
        core: Core,
        writer: ParameterWriter,
        journal: WriteJournal,
        imus: Mapping[str, AutopilotImu],
        owed: RequiredReboot,
    ) -> None:
        self._vehicle, self._parameters, self._say = core.vehicle, core.parameters, core.say
        self._writer, self.journal, self._imus, self._owed = writer, journal, imus, owed
        self._offload, self._interruptions = core.offload, interruptions_in(core.config.storage.path)
        self.on_recovered: Callable[..., Awaitable[object]] | None = None
        """Callback after a recovery: changes of the write, text for people, and whether this used up an undo step."""

    def interruptions(self) -> list[Object]:
        """List interrupted writes, the latest first; reads the disk and blocks."""
        pending = [] if self.journal.orphaned is None else [Interruption.of(self.journal.orphaned)]
        return [msgspec.to_builtins(each) for each in (*pending, *reversed(self._interruptions.read()))]

    def why_no_undo(self) -> str | None:
        if self.journal.steps(self._vehicle.system_id):
            return None
        where = "; the undo file was damaged" if self.journal.unusable else ""
        if elsewhere := self.journal.undoable:
            where = f" here, only on system {', '.join(map(str, elsewhere))}"
        return message("nothing_to_undo_found", where=where)

    async def run(self) -> None:
        if self.journal.lost_write:
            self._say(Severity.WARNING, message("interrupted_write_lost"), Weight.RESULT)
        while True:
            open_set = await self.journal.interrupted()
            try:
                await self._recover(open_set)
            except (AutopilotError, StorageError) as error:
                logger.warning("%s", message("restoring_old_values", reason=error))
                await asyncio.sleep(RETRY_S)

    async def _recover(self, open_set: ChangeSet) -> None:
        await self._vehicle.found.wait()
        ever_written = self._vehicle.kind.ranges
        if not ever_written.keys() >= set(open_set.names) or open_set.system_id != self._vehicle.system_id:
            system_id, names = open_set.system_id, ", ".join(open_set.names)
            words = message("interrupted_write_elsewhere", system=system_id, parameters=names)
            logger.warning("%s", words)
            self._say(Severity.WARNING, words, Weight.REFUSAL)
            await self._keep(open_set, words)
            await self.journal.unchanged()
            return
        while self._vehicle.arm_state is not ArmState.DISARMED:
            await asyncio.sleep(POLL_S)
        unknown = {changed.parameter: changed.before for changed in open_set.changes if changed.after is None}
        if unknown:
            # Wait for the end of the firmware's calibration, which would overwrite values restored before it.
            await wait_until_over(self._parameters, unknown)
        ours, foreign = await self._sort(open_set)
        if ours:
            with changing(self._imus.values()):
                await self._writer.restore(ours)
        found = f"{len(ours)} old values restored" if ours else "nothing to restore"
        if foreign:
            found += "; " + message("changed_by_others", values=", ".join(foreign))
        words = message("interrupted_write_ended", result=found)
        if self.on_recovered is not None:
            await self.on_recovered(open_set, words, undone=self.journal.is_undoable(open_set))
        await self._keep(open_set, found)
        await self.journal.undone()
        logger.warning("%s", words)
        self._say(Severity.WARNING, words, Weight.RESULT)

    async def _keep(self, open_set: ChangeSet, reason: str) -> None:
        try:
            await self._offload(self._interruptions.append, Interruption.of(open_set, reason, utc_now()))
        except StorageError as error:
            logger.warning("%s", message("history_not_kept", what="interrupted write", reason=error))

    async def undo(self, *, force: bool = False) -> tuple[ChangeSet, dict[str, WrittenParameter]]:
        """Restore the values from before the last write; return the write's changes and the restored parameters.

        If somebody else changed some values since, nothing is restored. An AutopilotError lists each with its present
        value, ours and the old one. With `force`, these stay and the others are restored. After another AutopilotError
        or a StorageError the new values stay; if some were restored, `Recovery` completes the undo once disarmed.
        """
        if (why := self.why_no_undo()) is not None:
            raise AutopilotError(why)
        step = self.journal.steps(self._vehicle.system_id)[0]
        name = step.origin.what or "last write"
        ours, foreign = await self._sort(step, learned=LEARNED)
        if foreign and not force:
            effect = "restores the others" if ours else "skips this step"
            values = "; ".join(foreign)
            raise AutopilotError(message("undo_of_changed_values", step=name, values=values, effect=effect))
        if foreign:
            logger.warning("%s", message("changed_by_others", values="; ".join(foreign)))
        try:
            async with self.journal.transaction(step):
                with changing(self._imus.values()):
                    written = await self._writer.undo(ours)
                await self._owed.after(ours)
                await self.journal.undone()
        except (WriteFailedError, NothingWrittenError) as error:
            # The error's own text would mislead: the writer's "old values" are those from before the undo.
            cause = f"{error.kind}: {error.reason}" if isinstance(error, WriteFailedError) else str(error)
            if left := ", ".join(error.left_changed):
                raise AutopilotError(message("undone_in_part", reason=cause, parameters=left)) from error
            raise AutopilotError(message("undo_failed", reason=cause, step=name)) from error
        self._owed.say()
        return step, written

    async def _sort(self, changes: ChangeSet, learned: Collection[str] = ()) -> tuple[Sequence[Change], Sequence[str]]:
        """Split changes into those still active in the autopilot, and texts about values that others have replaced.

        A parameter of `learned` that has another value by now is changed back by the difference of our write.
        """
        ours: list[Change] = []
        foreign: list[str] = []
        found = await self._read(changes.names)
        for changed in changes.changes:
            name, before, after = changed.parameter, changed.before, changed.after
            now = found.get(name)
            if now is None:
                foreign.append(f"{name} cannot be read any more (before: {before:.6g})")
            elif after is None:
                if not same_float32(now, before):
                    ours.append(Change(name, before, now))
            elif any(same_float32(now, own) for own in (after, changed.via) if own is not None):
                ours.append(Change(name, before, after, changed.via))
            elif any(same_float32(now, own) for own in changed.also):
                ours.append(Change(name, before, now, changed.via))
            elif name in learned and not foreign:
                ours.append(Change(name, now + before - after, now))
            elif not same_float32(now, before):
                foreign.append(f"{name} is {now:.6g}, we had set {after:.6g} (before: {before:.6g})")
        return ours, foreign

    async def _read(self, names: Sequence[str]) -> dict[str, float]:
        """Read parameters, except those that the autopilot refuses; raise AutopilotError if it does not answer."""
        with contextlib.suppress(ParameterRefusedError):
            return await self._parameters.read_many(names)
        found: dict[str, float] = {}
        for name in names:
            with contextlib.suppress(ParameterRefusedError):
                found[name] = await self._parameters.read(name)
        return found
