"""`companion autopilot-setup`: the autopilot's parameters for our heading, written and put back as biases are.

A ledger of its own keeps the values from before: `companion undo` and this do not touch each other's.
"""

from __future__ import annotations

import contextlib
import logging
from typing import Final

import msgspec

from companion.autopilot.firmware.heading_parameters import RISKS, changes_for, wanted_for
from companion.autopilot.firmware.written import HEADING_SETUP
from companion.autopilot.parameters.float32 import same_float32
from companion.autopilot.parameters.writer import Change, ParameterWriter
from companion.calibration.solution.record import WrittenParameter
from companion.component.statustext import Severity, Weight
from companion.daemon.calibrating.conductor import Conductor
from companion.daemon.core import Core
from companion.daemon.offsets.ledger import Ledger
from companion.daemon.offsets.recovery import Recovery
from companion.errors import AutopilotError, StorageError
from companion.links.system.request import Object
from companion.storage.changes import Changed, ChangeLog, ChangeSet

logger = logging.getLogger(__name__)

REBOOT: Final = "restart the autopilot now: until then it goes on as before"


class AutopilotSetup:
    """Shows, applies and takes back; one at a time, and never beside a calibration.

    `run` puts back what was interrupted.

    Args:
        core: what all share.
        writer: the guarded one, which everybody shares.
        conductor: whether a calibration writes.
    """

    def __init__(self, core: Core, writer: ParameterWriter, conductor: Conductor) -> None:
        self._config, self._vehicle, self._parameters = core.config, core.vehicle, core.parameters
        self._writer, self._conductor, self._say = writer, conductor, core.say
        self._folder = core.config.storage.path / "setup"
        self.ledger = Ledger(ChangeLog(self._folder, HEADING_SETUP), core.offload)
        self.recovery = Recovery(
            core.vehicle,
            core.parameters,
            writer,
            self.ledger,
            core.say,
            contextlib.nullcontext,
            command="companion autopilot-setup --undo",
        )
        self._busy = self._loaded = False

    async def run(self) -> None:
        """Put back what an earlier daemon has left half done, until cancelled."""
        if self._folder.exists():
            self._load()
        await self.recovery.run()

    def _load(self) -> None:
        if not self._loaded:
            self._loaded = True
            self.ledger.load()

    async def answer(self, request: Object) -> Object:
        """Answer a request of the control socket.

        Raises:
            CompanionError: refused, or failed; the reason in words.
        """
        self._load()
        action = request.get("action", "show")
        if self._busy:
            raise AutopilotError("another autopilot-setup is under way")
        self._busy = True
        try:
            if action == "show":
                return await self._show()
            self._check_may_write()
            if action == "apply":
                return await self._apply()
            if action == "undo":
                return await self._undo(force=request.get("force") is True)
        finally:
            self._busy = False
        raise AutopilotError(f"autopilot-setup: {action!r} is not understood; allowed: show, apply, undo")

    def _check_may_write(self) -> None:
        if self.recovery.fault is not None:
            raise StorageError(self.recovery.fault)
        if self.recovery.pending:
            raise AutopilotError("an interrupted set-up is being put back first")
        if (job := self._conductor.running) is not None:
            raise AutopilotError(f"a {job.kind} is running: wait, or companion cancel")
        if self._conductor.only_listening is not None:
            raise AutopilotError(self._conductor.only_listening)

    async def _show(self) -> Object:
        wanted, found = wanted_for(self._vehicle.firmware), await self._read()
        rows = [
            {
                "parameter": one.parameter,
                "now": found.get(one.parameter),
                "wanted": None if one.parameter not in found else one.after(found[one.parameter]),
                "why": one.why,
            }
            for one in wanted
        ]
        open_rows = [
            row
            for row in rows
            if isinstance(now := row["now"], float)
            and isinstance(to := row["wanted"], float)
            and not same_float32(now, to)
        ]
        state = "applied" if not open_rows else "not applied"
        reason = "the autopilot is set up" if not open_rows else f"{len(open_rows)} parameters to change"
        return self._reply(state, reason, rows)

    def _reply(self, state: str, reason: str, rows: list[Object] | None = None, **more: object) -> Object:
        return {
            "kind": "result",
            "state": state,
            "reason": reason,
            "firmware": self._vehicle.firmware,
            "parameters": rows or [],
            "risks": list(RISKS.get(self._vehicle.firmware or "other", ())),
            "can_undo": self.recovery.why_no_undo() is None,
            **more,
        }

    async def _read(self) -> dict[str, float]:
        names = [one.parameter for one in wanted_for(self._vehicle.firmware)]
        return await self._parameters.read_many(names, optional=True)

    async def _apply(self) -> Object:
        if self._config.push.attitude == "off":
            raise AutopilotError('push.attitude is "off": the heading would never come; configure it first')
        if self._config.compass is None:
            raise AutopilotError("there is no [compass]: the heading would never come; configure it first")
        changes = changes_for(self._vehicle.firmware, await self._read())
        if not changes:
            return self._reply("applied", "the autopilot is set up already; nothing was written")
        kept = self._kept(changes)
        async with self.ledger.transaction(ChangeSet.of(self._vehicle.system_id, changes)):
            written = await self._writer.apply(changes)
            await self.ledger.done(ChangeSet.of(self._vehicle.system_id, kept))
        names = ", ".join(change.parameter for change in changes)
        logger.warning("autopilot-setup wrote %s", names)
        self._say(Severity.WARNING, "Heading set-up written: restart the autopilot", Weight.RESULT)
        return self._reply("applied", f"{len(changes)} parameters written; {REBOOT}", written=_plain(written))

    def _kept(self, changes: list[Change]) -> list[Change]:
        """What an undo puts back: of a set-up that is made a second time, the values from before the first."""
        system_id = self._vehicle.system_id or 0
        before = {one.parameter: one for one in self._undoable(system_id)}
        new = {change.parameter: change for change in changes}
        kept = [
            Change(name, before[name].before if name in before else new[name].before, new[name].after) for name in new
        ]
        kept += [
            Change(name, one.before, one.after)
            for name, one in before.items()
            if name not in new and one.after is not None
        ]
        return kept

    def _undoable(self, system_id: int) -> tuple[Changed, ...]:
        found = self.ledger.undoable.get(system_id)
        return () if found is None else found.changes

    async def _undo(self, *, force: bool) -> Object:
        written = await self.recovery.undo(force=force)
        self._say(Severity.WARNING, "Heading set-up taken back: restart the autopilot", Weight.RESULT)
        return self._reply("undone", f"{len(written)} old values back; {REBOOT}", written=_plain(written))


def _plain(written: dict[str, WrittenParameter]) -> object:
    return msgspec.to_builtins(written)
