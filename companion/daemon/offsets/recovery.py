"""Old values back: after an interrupted write by itself, and when a person asks for an undo."""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Callable, Sequence
from typing import Final

from companion.autopilot.firmware.gyro_calibration import wait_until_over
from companion.autopilot.parameters.client import ParameterClient
from companion.autopilot.parameters.wire import same_float32
from companion.autopilot.parameters.writer import Change, ParameterWriter
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle
from companion.calibration.solution.record import WrittenParameter
from companion.component.statustext import Say, Severity, Weight
from companion.daemon.offsets.ledger import Ledger
from companion.errors import AutopilotError, ParameterRefusedError, StorageError
from companion.links.system.listeners import Listeners
from companion.storage.changes import Changed, ChangeSet

logger = logging.getLogger(__name__)


RETRY_S: Final = 3.0
POLL_S: Final = 0.2


class Recovery:
    """Puts values back, guarded like every write; `changing` tells the IMUs that it is us who change them."""

    def __init__(
        self,
        vehicle: Vehicle,
        parameters: ParameterClient,
        writer: ParameterWriter,
        ledger: Ledger,
        say: Say,
        changing: Callable[[], contextlib.AbstractContextManager[None]],
    ) -> None:
        self._vehicle, self._parameters, self._writer = vehicle, parameters, writer
        self._ledger, self._say, self._changing = ledger, say, changing
        self._listeners: Listeners[str] = Listeners()

    def watch(self, on_recovered: Callable[[str], None]) -> None:
        """Be told, in words, of what was put in order."""
        self._listeners.add(on_recovered)

    @property
    def fault(self) -> str | None:
        """Why nothing may be written at all, for people."""
        return self._ledger.fault

    @property
    def pending(self) -> bool:
        """Whether an interrupted write still waits to be put back."""
        return self._ledger.pending

    def why_no_undo(self) -> str | None:
        """Why there is nothing to undo, or None when there is."""
        undoable = self._ledger.undoable
        if not undoable:
            return "nothing to undo" + ("; what was kept could not be used" if self._ledger.unusable else "")
        if self._vehicle.system_id not in undoable:
            return f"nothing to undo here, only on system {', '.join(map(str, sorted(undoable)))}"
        return None

    async def run(self) -> None:
        """Bring interrupted writes to an end, whenever there is one, until cancelled."""
        if self._ledger.lost_write:
            self._say(Severity.WARNING, "Interrupted write, file damaged: calibrate", Weight.RESULT)
        while True:
            open_set = await self._ledger.interrupted()
            try:
                await self._recover(open_set)
            except (AutopilotError, StorageError) as error:
                logger.warning("putting old values back: %s; trying again", error)
                await asyncio.sleep(RETRY_S)

    async def _recover(self, open_set: ChangeSet) -> None:
        await self._vehicle.wait_found()
        strange = self._ledger.strange_to(self._vehicle.firmware, open_set)
        if strange or open_set.system_id != self._vehicle.system_id:
            names = ", ".join(open_set.names)
            words = f"An interrupted write on system {open_set.system_id} is not this aircraft's; there check: {names}"
            logger.warning("%s", words)
            self._say(Severity.WARNING, words, Weight.REFUSAL)
            await self._ledger.undone()
            return
        while self._vehicle.arm_state is not ArmState.DISARMED:
            await asyncio.sleep(POLL_S)
        if unknown := {changed.parameter: changed.before for changed in open_set.changes if changed.after is None}:
            # What the firmware finds it stores at its end, over whatever was put back before.
            await wait_until_over(self._parameters, unknown)
        ours, foreign = await self._sort(open_set)
        if ours:
            with self._changing():
                await self._writer.restore(ours)
        if self._ledger.undoable.get(open_set.system_id) == open_set:
            await self._ledger.forget_undo(
                open_set.system_id
            )  # it was an undo that was interrupted, and now it is done
        await self._ledger.undone()
        words = f"Interrupted write: {f'{len(ours)} old values put back' if ours else 'nothing of ours was in force'}"
        if foreign:
            words += f"; changed by others, left alone: {', '.join(foreign)}"
        logger.warning("%s", words)
        self._listeners.tell(words)
        self._say(Severity.WARNING, words, Weight.RESULT)

    async def undo(self, *, force: bool = False) -> dict[str, WrittenParameter]:
        """Put back the values from before the last calibration, all or none; returns what was done.

        Args:
            force: leave what somebody else has changed since as it is, and put the rest back; without it, nothing is
                written then.

        Raises:
            AutopilotError: somebody else has changed some of them since (each named, with their value, ours and the
                one before), or the writing failed (what could not be put back will be, as soon as the aircraft is
                disarmed).
            StorageError: the disk refuses.
        """
        undoable = self._ledger.undoable.get(self._vehicle.system_id or 0)
        why = self.why_no_undo()
        if undoable is None or why is not None:
            raise AutopilotError(why or "nothing to undo")
        ours, foreign = await self._sort(undoable)
        if foreign and not force:
            raise AutopilotError(
                f"changed by somebody else or by a boot since, so nothing was put back: {'; '.join(foreign)}."
                f" companion undo --force puts the others back"
            )
        if foreign:
            logger.warning("changed by somebody else since, left alone: %s", "; ".join(foreign))
        async with self._ledger.transaction(undoable):
            with self._changing():
                written = await self._writer.undo(ours)
            await self._ledger.forget_undo(undoable.system_id)
            await self._ledger.undone()
        return written

    async def _sort(self, changes: ChangeSet) -> tuple[Sequence[Change], Sequence[str]]:
        """Which changes are still as we made them, and what others have put in their place."""
        ours: list[Change] = []
        foreign: list[str] = []
        found = await self._read(changes.names)
        for changed in changes.changes:
            now, change = found.get(changed.parameter), _change(changed)
            if now is None:
                foreign.append(f"{changed.parameter} cannot be read any more (before: {changed.before:.6g})")
                continue
            if changed.after is None:
                if not same_float32(now, changed.before):
                    ours.append(Change(changed.parameter, changed.before, now))
            elif any(same_float32(now, own) for own in change.ours):
                ours.append(change)
            elif any(same_float32(now, own) for own in changed.also):
                ours.append(Change(changed.parameter, changed.before, now, changed.via))
            elif not same_float32(now, changed.before):
                foreign.append(
                    f"{changed.parameter} is {now:.6g}, we had set {changed.after:.6g} (before: {changed.before:.6g})"
                )
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


def _change(changed: Changed) -> Change:
    after = changed.before if changed.after is None else changed.after
    return Change(changed.parameter, changed.before, after, changed.via)
