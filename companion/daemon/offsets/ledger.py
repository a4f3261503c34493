"""What was changed in the autopilot, in memory and on disk at once.

Open: a write is under way. Orphaned: a write was interrupted (the daemon died, or the old values could not all be
put back), and the recovery has to bring it to an end. Undoable: the last finished writes on each vehicle.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from typing import Final

import msgspec

from companion.autopilot.firmware.firmwares import CALIBRATION
from companion.autopilot.firmware.gyro_calibration import wait_until_over
from companion.autopilot.parameters.change import Change, NothingWrittenError, WriteFailedError
from companion.autopilot.parameters.wire import same_float32
from companion.autopilot.parameters.writer import ParameterWriter
from companion.autopilot.vehicle.vehicle import ArmState
from companion.component.statustext import Severity, Weight
from companion.daemon.core import Core, Offload
from companion.daemon.devices.autopilot_imu import AutopilotImu, changing
from companion.daemon.offsets.reboot import RebootOwed
from companion.errors import AutopilotError, ParameterRefusedError, StorageError
from companion.estimation.records.record import WrittenParameter
from companion.formats import Object, utc_now
from companion.storage.changes import ChangeLog, ChangeSet, Interruptions, Undoable

logger = logging.getLogger(__name__)

RETRY_S: Final = 3.0
POLL_S: Final = 0.2


class Ledger:
    """The change files of one storage folder and what they say."""

    def __init__(self, log: ChangeLog, offload: Offload, why_yield: Callable[[], str | None] = lambda: None) -> None:
        self._log, self._offload, self.why_yield = log, offload, why_yield
        """`why_yield`: why another companion writes here, and this one does not."""
        self.fault: str | None = None
        """Why nothing may be written at all, for people; None while all is well."""
        self._open: ChangeSet | None = None
        self._orphaned = asyncio.Event()
        self._undoable: dict[int, Undoable] = {}
        self.unusable: tuple[str, ...] = ()
        """Files that were there and were set aside, each in a line; none of it was written anywhere."""
        self.lost_write = False
        """One of them was the journal: an interrupted write stays as it is."""

    @property
    def pending(self) -> bool:
        """Whether an interrupted write waits for the recovery."""
        return self._orphaned.is_set()

    def load(self) -> None:
        """Read the files at start, and find out whether they can be written; what cannot be used is set aside."""
        try:
            self._log.check_writable()
        except StorageError as error:
            self.fault = f"{error}; nothing can be kept, so nothing is written; mend it and restart the companion"
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
        """The vehicles, by system id, on which there is something to undo."""
        return sorted(system_id for system_id, each in self._undoable.items() if each.all)

    def steps(self, system_id: int | None) -> tuple[ChangeSet, ...]:
        """What can be undone on one vehicle, the latest first."""
        found = self._undoable.get(system_id or 0)
        return () if found is None else found.all

    @property
    def orphaned(self) -> ChangeSet | None:
        """The interrupted write that waits for the recovery."""
        return self._open if self.pending else None

    def is_undoable(self, changes: ChangeSet) -> bool:
        """Whether a step that can be undone holds these changes."""
        kept = self._undoable.get(changes.system_id)
        return kept is not None and kept.without(changes) is not kept

    async def interrupted(self) -> ChangeSet:
        """Wait until there is an interrupted write; it stays one until `undone`."""
        while self._open is None or not self.pending:
            await self._orphaned.wait()
        return self._open

    @contextlib.asynccontextmanager
    async def transaction(self, changes: ChangeSet, *, stepwise: bool = False) -> AsyncIterator[None]:
        """Around a write: what happens to one that is not finished is decided here and nowhere else.

        The old values are on disk before the block begins. It says itself how it ended, by `done` or `undone`; and a
        writer's error that has left nothing changed says that the autopilot is as it was before the block: after a
        failed undo that means the values that were to be undone. After anything else (a value left
        changed, a cancellation, a fault of the program, no word at all) nobody knows what is, and the recovery looks.

        Args:
            changes: what the block will change, as far as it is known beforehand.
            stepwise: the block writes these values more than once, so that a write which has put back what it found
                has not put back what is kept here.

        Raises:
            AutopilotError: an earlier write is open still, or another companion writes here; do not write.
            StorageError: they could not be kept, or a name or a value is none that the companion writes; do not write.
        """
        if self._open is not None:
            raise AutopilotError("putting old values back first")
        if (why := self.why_yield()) is not None:
            raise AutopilotError(f"nothing is written: {why}")
        await self.widen(changes)
        try:
            yield
        except (WriteFailedError, NothingWrittenError) as error:
            if not (error.left_changed or stepwise):
                with contextlib.suppress(StorageError):
                    await self.unchanged()
            raise
        finally:
            self._leave_to_recovery()

    def _leave_to_recovery(self) -> None:
        if self._open is not None:
            self._orphaned.set()

    async def widen(self, changes: ChangeSet) -> None:
        """In a transaction: keep this in the place of what was kept, before anything of it is overwritten.

        Raises:
            StorageError: as `transaction`; what was kept still is.
        """
        if self._open is not None:
            changes = msgspec.structs.replace(changes, origin=self._open.origin)
        await self._offload(self._log.journal.write, changes)
        self._open = changes

    async def done(self, changes: ChangeSet) -> None:
        """The end of a transaction: the write stays, and from now on it can be undone.

        Raises:
            StorageError: the disk refuses; the write stays open.
        """
        kept = self._undoable.get(changes.system_id, Undoable(changes.system_id))
        await self._keep(kept.and_then(changes))
        await self.unchanged()

    async def undone(self) -> None:
        """The end of a transaction, or of an interrupted one, or of an undo: the old values are in force.

        Raises:
            StorageError: the disk refuses; the write stays open.
        """
        if self._open is not None and (kept := self._undoable.get(self._open.system_id)) is not None:
            # It was an undo, or a write that had come to its end but for the journal.
            left = kept.without(self._open)
            if left is not kept:
                await self._keep(left)
        await self.unchanged()

    async def _keep(self, undoable: Undoable) -> None:
        file = self._log.undo_of(undoable.system_id)
        await (self._offload(file.write, undoable) if undoable.steps else self._offload(file.clear))
        self._undoable[undoable.system_id] = undoable

    async def unchanged(self) -> None:
        """End a transaction that left the autopilot as it found it: every step that could be undone still can.

        Raises:
            StorageError: the disk refuses; the write stays open.
        """
        await self._offload(self._log.journal.clear)
        self._open = None
        self._orphaned.clear()


class Recovery:
    """Puts values back, guarded like every write."""

    def __init__(
        self,
        core: Core,
        writer: ParameterWriter,
        ledger: Ledger,
        imus: Mapping[str, AutopilotImu],
        owed: RebootOwed,
    ) -> None:
        self._vehicle, self._parameters, self._say = core.vehicle, core.parameters, core.say
        self._writer, self.ledger, self._imus, self._owed = writer, ledger, imus, owed
        self._offload, self._interruptions = core.offload, Interruptions(core.config.storage.path)
        self.on_recovered: Callable[..., Awaitable[object]] = _nobody_notes
        """Told of a restored interrupted write, in words, and whether that undid a step (keyword `undone`)."""

    def interruptions(self) -> list[Object]:
        """Interrupted writes for the history, the latest first; blocking."""
        return self._interruptions.history(self.ledger.orphaned)

    def why_no_undo(self) -> str | None:
        """Why there is nothing to undo, or None when there is."""
        if self.ledger.steps(self._vehicle.system_id):
            return None
        if elsewhere := self.ledger.undoable:
            return f"nothing to undo here, only on system {', '.join(map(str, elsewhere))}"
        return "nothing to undo" + ("; what was kept could not be used" if self.ledger.unusable else "")

    async def run(self) -> None:
        """Bring interrupted writes to an end, whenever there is one, until cancelled."""
        if self.ledger.lost_write:
            self._say(Severity.WARNING, "Interrupted write, file damaged: calibrate", Weight.RESULT)
        while True:
            open_set = await self.ledger.interrupted()
            try:
                await self._recover(open_set)
            except (AutopilotError, StorageError) as error:
                logger.warning("putting old values back: %s; trying again", error)
                await asyncio.sleep(RETRY_S)

    async def _recover(self, open_set: ChangeSet) -> None:
        await self._vehicle.found.wait()
        ever_written = CALIBRATION.get(self._vehicle.firmware or "other", {})
        if not ever_written.keys() >= set(open_set.names) or open_set.system_id != self._vehicle.system_id:
            names = ", ".join(open_set.names)
            words = f"Interrupted write on system {open_set.system_id}, not on this aircraft: check there {names}"
            logger.warning("%s", words)
            self._say(Severity.WARNING, words, Weight.REFUSAL)
            await self._keep(open_set, f"not on this aircraft: check there {names}")
            await self.ledger.unchanged()
            return
        while self._vehicle.arm_state is not ArmState.DISARMED:
            await asyncio.sleep(POLL_S)
        if unknown := {changed.parameter: changed.before for changed in open_set.changes if changed.after is None}:
            # What the firmware finds it stores at its end, over whatever was put back before.
            await wait_until_over(self._parameters, unknown)
        ours, foreign = await self._sort(open_set)
        if ours:
            with changing(self._imus.values()):
                await self._writer.restore(ours)
        found = f"{len(ours)} old values back" if ours else "nothing of ours was in force"
        if foreign:
            found += f"; changed by others, left alone: {', '.join(foreign)}"
        words = f"Interrupted write: {found}"
        await self.on_recovered(open_set, words, undone=self.ledger.is_undoable(open_set))
        await self._keep(open_set, found)
        await self.ledger.undone()
        logger.warning("%s", words)
        self._say(Severity.WARNING, words, Weight.RESULT)

    async def _keep(self, open_set: ChangeSet, reason: str) -> None:
        await self._offload(self._interruptions.keep, open_set, reason, utc_now())

    async def undo(self, *, force: bool = False) -> tuple[ChangeSet, dict[str, WrittenParameter]]:
        """Put back the values from before the last step, all or none; returns the step and what was done.

        Args:
            force: leave what somebody else has changed since as it is, and put the rest back; without it, nothing is
                written then.

        Raises:
            AutopilotError: somebody else has changed some of them since (each named, with their value, ours and the
                one before), or the writing failed: then the step is as it was, or, where some values could not be
                written again, the recovery brings the undo to its end as soon as the aircraft is disarmed.
            StorageError: the disk refuses.
        """
        if (why := self.why_no_undo()) is not None:
            raise AutopilotError(why)
        step = self.ledger.steps(self._vehicle.system_id)[0]
        ours, foreign = await self._sort(step)
        if foreign and not force:
            raise AutopilotError(
                f"{step.origin.what or 'last write'}: changed by somebody else or by a boot since, so nothing was put"
                f" back: {'; '.join(foreign)}. companion undo --force"
                f" {'puts the others back' if ours else 'leaves it so and comes to the one before'}"
            )
        if foreign:
            logger.warning("changed by somebody else since, left alone: %s", "; ".join(foreign))
        try:
            async with self.ledger.transaction(step):
                with changing(self._imus.values()):
                    written = await self._writer.undo(ours)
                await self._owed.after(ours)
                await self.ledger.undone()
        except (WriteFailedError, NothingWrittenError) as error:
            raise AutopilotError(_why_not_undone(error, step)) from error
        self._owed.say()
        return step, written

    async def _sort(self, changes: ChangeSet) -> tuple[Sequence[Change], Sequence[str]]:
        """Which changes are still as we made them, and what others have put in their place."""
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
            elif not same_float32(now, before):
                foreign.append(f"{name} is {now:.6g}, we had set {after:.6g} (before: {before:.6g})")
        return ours, foreign

    async def _read(self, names: Sequence[str]) -> dict[str, float]:
        """Those that the autopilot does not refuse; silence is no refusal, and is waited for."""
        with contextlib.suppress(ParameterRefusedError):
            return await self._parameters.read_many(names)
        found: dict[str, float] = {}
        for name in names:
            with contextlib.suppress(ParameterRefusedError):
                found[name] = await self._parameters.read(name)
        return found


async def _nobody_notes(_step: ChangeSet, _words: str, *, undone: bool) -> None:
    """Stand in until the manager keeps a history."""


def _why_not_undone(error: WriteFailedError | NothingWrittenError, step: ChangeSet) -> str:
    """The writer's "old values" are those from before the undo: say what is in force, as the pilot sees it."""
    cause = f"{error.kind}: {error.reason}" if isinstance(error, WriteFailedError) else str(error)
    if error.left_changed:
        return f"{cause}; undone in part ({', '.join(error.left_changed)}): the rest follows once disarmed"
    return f"{cause}; {step.origin.what or 'last write'} stays in force: undo again"
