"""Files with old parameter values: a journal, to undo an interrupted write, and the undo steps of finished writes.

`journal.json` is saved before the first parameter is written and deleted after the last. If it exists at start, the
daemon ended in the middle of a write. `undo-N.json` holds the values from before the last writes on the vehicle with
MAVLink system id N. Both files accept only parameters that the companion writes, within their ranges.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Final

import msgspec

from companion.autopilot.firmware.firmwares import CALIBRATION, LEARNED
from companion.autopilot.parameters.change import Change
from companion.errors import StorageError
from companion.formats import Object
from companion.messages import message
from companion.storage.state import BoundedList, StateFile, numbers_in, remove_durably, write_atomically

_UNDO: Final = re.compile(r"undo-(0|[1-9][0-9]{0,2})\.json")
_SYSTEM_IDS: Final = range(1, 256)
MOST_STEPS: Final = 10  # most writes that can be undone one after another; further ones replace the oldest
AUTOMATIC: Final = "auto calibration"
BY_TEMPERATURE: Final = "temperature"
PREDICTION: Final = "gyro prediction"
"""Kind of a write of predicted gyro offsets: made by versions before 0.2 only, but can still be undone."""
BY_HAND: Final = ("faces", "turn", "level", "compass", BY_TEMPERATURE, PREDICTION)
"""Kinds of writes without a calibration record: alignments, and offsets from temperature curves."""


class Changed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Change of one parameter: old value, new value, and the temporary large offset between them (`via`), if any.

    `after` is None while the firmware's own gyro calibration, started by us, sets the parameter: then any value counts
    as written by us. `also` lists further values that an interrupted sequence of our writes may leave.
    """

    parameter: str
    before: float
    after: float | None
    via: float | None = None
    also: tuple[float, ...] = ()


Moment = Annotated[str, msgspec.Meta(pattern=r"^[-+:.0-9T]{0,40}\Z")]


class Origin(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Kind and start time of a write to the autopilot; empty if unknown.

    Times are UTC, ISO 8601, by the host's clock. For a calibration, `at` is `started_at` of its record.
    """

    what: Annotated[str, msgspec.Meta(pattern=r"^[a-z ]{0,30}\Z")] = ""
    """Kind of the write: "calibration", "auto calibration", or one of `BY_HAND`; empty if unknown."""
    at: Moment = ""
    since: Moment = ""  # start of the first of several writes in one step; empty: a single write

    @property
    def first(self) -> str:
        return self.since or self.at


class ChangeSet(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameter changes of one write to one vehicle's autopilot."""

    system_id: int
    changes: tuple[Changed, ...]
    origin: Origin = Origin()

    @classmethod
    def of(
        cls,
        system_id: int | None,
        changes: Iterable[Change],
        unforeseen: Mapping[str, float] | None = None,
        origin: Origin | None = None,
    ) -> ChangeSet:
        """Make the set from planned changes; `unforeseen`: old values of parameters that the firmware will overwrite.

        A set for an unknown vehicle gets system id 0 and cannot be saved.
        """
        found = [Changed(change.parameter, change.before, change.after, change.via) for change in changes]
        found += [Changed(name, before, None) for name, before in (unforeseen or {}).items()]
        return cls(system_id or 0, tuple(found), origin or Origin())

    @property
    def names(self) -> list[str]:
        return [changed.parameter for changed in self.changes]

    def shown(self) -> Object:
        origin = self.origin
        before = {changed.parameter: changed.before for changed in self.changes}
        return {"what": origin.what, "at": origin.at, "since": origin.first, "parameters": self.names, "before": before}

    def after(self, older: ChangeSet) -> ChangeSet:
        """Join this write and the `older` one to one undo step, which restores the values from before both."""
        were = {changed.parameter: changed for changed in older.changes}
        joined = [_joined(were.pop(changed.parameter, None), changed) for changed in self.changes]
        origin = self.origin
        if older.origin.what == origin.what:
            origin = msgspec.structs.replace(origin, since=older.origin.first)
        return ChangeSet(self.system_id, (*were.values(), *joined), origin)

    def without(self, latest: ChangeSet) -> ChangeSet:
        """Return the changes of this step that remain in effect once the old values of `latest` are restored."""
        back = {changed.parameter: changed.before for changed in latest.changes}
        left = [
            msgspec.structs.replace(changed, after=back.get(changed.parameter, changed.after))
            for changed in self.changes
            if changed.before != back.get(changed.parameter)
        ]
        return msgspec.structs.replace(self, changes=tuple(left))


def _joined(older: Changed | None, newer: Changed) -> Changed:
    """Join two changes of one parameter; return only the newer change if somebody else changed the value in between."""
    if older is not None and older.after is not None and newer.parameter in LEARNED:
        return msgspec.structs.replace(newer, before=newer.before + older.before - older.after)
    if older is None or older.after != newer.before:
        return newer
    via = newer.via
    if via is not None and newer.after is not None and older.via is not None:
        # The farther of both temporary offsets is far enough from all values for the firmware.
        via = (max if via > newer.after else min)(via, older.via)
    return msgspec.structs.replace(newer, before=older.before, via=via)


class Undoable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Writes that can be undone on one vehicle, the latest first."""

    system_id: int
    steps: tuple[ChangeSet, ...] = ()
    changes: tuple[Changed, ...] = ()  # the only step, in files of versions that stored one

    @property
    def all(self) -> tuple[ChangeSet, ...]:
        """Return all undo steps, including the single step in files of earlier versions."""
        return self.steps or ((ChangeSet(self.system_id, self.changes),) if self.changes else ())

    def and_then(self, latest: ChangeSet) -> Undoable:
        """Return the undo steps with a write added; consecutive automatic calibrations form one step."""
        steps = self.all
        while steps and latest.origin.what == steps[0].origin.what == AUTOMATIC:
            latest, steps = latest.after(steps[0]), steps[1:]
        return Undoable(self.system_id, (latest, *steps)[:MOST_STEPS])

    def without(self, latest: ChangeSet) -> Undoable:
        """Return the undo steps left after write `latest` is undone; all if `latest` is not in the newest step."""
        steps = self.all
        if not steps or not (latest == steps[0] or (latest.origin.at and latest.origin.at == steps[0].origin.at)):
            return self
        left = steps[0].without(latest)
        return Undoable(self.system_id, (left, *steps[1:]) if left.changes else steps[1:])


class ChangeLog:
    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._allowed = {name: one for each in CALIBRATION.values() for name, one in each.items()}
        self._probe = directory / "probe"
        self.journal: StateFile[ChangeSet] = StateFile(directory / "journal.json", ChangeSet, self._check)

    def undo_of(self, system_id: int) -> StateFile[Undoable]:
        def check(found: Undoable) -> None:
            for changes in (ChangeSet(found.system_id, ()), *found.all):
                self._check(changes, system_id)

        return StateFile(self._directory / f"undo-{system_id}.json", Undoable, check)

    def undos(self) -> list[StateFile[Undoable]]:
        try:
            return [self.undo_of(number) for number in numbers_in(self._directory, _UNDO)]
        except StorageError:
            return []  # `check_writable` has reported the error

    def check_writable(self) -> None:
        """Raise StorageError if the storage directory is not writable; called at start, before any parameter write."""
        write_atomically(self._probe, b"")
        remove_durably(self._probe)

    def _check(self, found: ChangeSet, system_id: int | None = None) -> None:
        if found.system_id not in _SYSTEM_IDS or found.system_id != (system_id or found.system_id):
            raise msgspec.ValidationError(f"found system_id {found.system_id}; allowed: {system_id or '1 to 255'}")
        names = found.names
        for changed in found.changes:
            name = changed.parameter
            if name not in self._allowed or names.count(name) > 1:
                why = "named twice" if name in self._allowed else "not a parameter that the companion writes"
                raise msgspec.ValidationError(f"found {name[:40]!r}: {why}")
            for value in (changed.before, changed.after, changed.via, *changed.also):
                if value is not None and not self._allowed[name].holds(value):
                    raise msgspec.ValidationError(f"found {name} = {value:.9g}; allowed: {self._allowed[name]}")


KEEP_INTERRUPTIONS: Final = 50  # Most interrupted writes in the list: enough for years


class Interruption(msgspec.Struct, frozen=True, kw_only=True):
    what: str  # Kind of write (see `Origin.what`)
    began_at: str  # start of the calibration or alignment that wrote, UTC, ISO 8601; empty: unknown
    ended_at: str | None  # end of the restore, UTC, ISO 8601; None: pending
    system_id: int
    parameters: tuple[str, ...]
    reason: str  # result of the restore, for people

    @classmethod
    def of(cls, step: ChangeSet, reason: str = "", ended_at: str | None = None) -> Interruption:
        return cls(
            what=step.origin.what,
            began_at=step.origin.at,
            ended_at=ended_at,
            system_id=step.system_id,
            parameters=tuple(step.names),
            reason=reason or message("interruption_not_restored"),
        )


def interruptions_in(directory: Path) -> BoundedList[Interruption]:
    return BoundedList(directory / "interrupted.json", Interruption, KEEP_INTERRUPTIONS)
