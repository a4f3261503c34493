"""Journal of parameter writes: saved before the first write, so that old values can be restored after an interruption.

`journal.json` exists only during a write (if it exists at start, the daemon ended in the middle of one).
`undo-N.json` holds the values before the last finished writes on the vehicle with system id N. A restore writes these
values to an autopilot, so only parameters that the companion writes are accepted, within their ranges.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Final

import msgspec

from companion.autopilot.firmware.firmwares import CALIBRATION
from companion.autopilot.parameters.change import Change
from companion.errors import StorageError
from companion.formats import Object
from companion.messages import message
from companion.storage.state import BoundedList, StateFile, numbers_in, remove_durably, write_atomically

_UNDO: Final = re.compile(r"undo-(0|[1-9][0-9]{0,2})\.json")
_SYSTEM_IDS: Final = range(1, 256)
MOST_STEPS: Final = 10  # writes that can be undone one after the other; further ones replace the oldest
AUTOMATIC: Final = "auto calibration"
BY_TEMPERATURE: Final = "temperature"
PREDICTION: Final = "gyro prediction"
"""Name of gyro offsets that versions before 0.2 predicted and wrote; their files can still be read and undone."""
BY_HAND: Final = ("faces", "turn", "level", BY_TEMPERATURE, PREDICTION)
"""Kinds of writes that have no calibration record."""


class Changed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One parameter: its old value, its new value, and the far value between them (`Change.via`), if any.

    `after` is None while the firmware's own gyro calibration, started by us, sets the parameter: any value is then
    ours. `also` lists further values of ours that an interrupted sequence of writes may leave.
    """

    parameter: str
    before: float
    after: float | None
    via: float | None = None
    also: tuple[float, ...] = ()


Moment = Annotated[str, msgspec.Meta(pattern=r"^[-+:.0-9T]{0,40}\Z")]


class Origin(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Kind and start time of a write; empty: unknown.

    Times are UTC, ISO 8601, by the host's clock; `at` of a calibration is `started_at` of its record.
    """

    what: Annotated[str, msgspec.Meta(pattern=r"^[a-z ]{0,30}\Z")] = ""
    """Kind: "calibration", "auto calibration", or one of `BY_HAND`; empty: unknown."""
    at: Moment = ""
    since: Moment = ""  # start of the first of several writes in one step; empty: a single write

    @property
    def first(self) -> str:
        return self.since or self.at


class ChangeSet(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Changes of one write on one vehicle."""

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
        """Make the set before the first change is written; `unforeseen`: old values that the firmware overwrites.

        A set for an unknown vehicle (system id 0) cannot be saved.
        """
        found = [Changed(change.parameter, change.before, change.after, change.via) for change in changes]
        found += [Changed(name, before, None) for name, before in (unforeseen or {}).items()]
        return cls(system_id or 0, tuple(found), origin or Origin())

    @property
    def names(self) -> list[str]:
        return [changed.parameter for changed in self.changes]

    def shown(self) -> Object:
        origin = self.origin
        return {"what": origin.what, "at": origin.at, "since": origin.first, "parameters": self.names}

    def after(self, older: ChangeSet) -> ChangeSet:
        """Join this write and the `older` one to one step; its undo restores the values before both."""
        were = {changed.parameter: changed for changed in older.changes}
        joined = [_joined(were.pop(changed.parameter, None), changed) for changed in self.changes]
        origin = self.origin
        if older.origin.what == origin.what:
            origin = msgspec.structs.replace(origin, since=older.origin.first)
        return ChangeSet(self.system_id, (*were.values(), *joined), origin)

    def without(self, latest: ChangeSet) -> ChangeSet:
        """Return the changes of this step that remain after the restore of `latest`; none after a full restore."""
        back = {changed.parameter: changed.before for changed in latest.changes}
        left = [
            msgspec.structs.replace(changed, after=back.get(changed.parameter, changed.after))
            for changed in self.changes
            if changed.before != back.get(changed.parameter)
        ]
        return msgspec.structs.replace(self, changes=tuple(left))


def _joined(older: Changed | None, newer: Changed) -> Changed:
    """Join two changes of one parameter; keep only the newer one if another value was set between them."""
    if older is None or older.after != newer.before:
        return newer
    via = newer.via
    if via is not None and newer.after is not None and older.via is not None:
        # The farther of the two has the distance from all values that the firmware needs.
        via = (max if via > newer.after else min)(via, older.via)
    return msgspec.structs.replace(newer, before=older.before, via=via)


class Undoable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """The steps that can be undone on one vehicle, the latest first."""

    system_id: int
    steps: tuple[ChangeSet, ...] = ()
    changes: tuple[Changed, ...] = ()  # the only step, in files of versions that kept one

    @property
    def all(self) -> tuple[ChangeSet, ...]:
        """Return all steps, including the single step of earlier versions' files."""
        return self.steps or ((ChangeSet(self.system_id, self.changes),) if self.changes else ())

    def and_then(self, latest: ChangeSet) -> Undoable:
        """Return the steps with a write added; automatic calibrations in a row form one step."""
        steps = self.all
        while steps and latest.origin.what == steps[0].origin.what == AUTOMATIC:
            latest, steps = latest.after(steps[0]), steps[1:]
        return Undoable(self.system_id, (latest, *steps)[:MOST_STEPS])

    def without(self, latest: ChangeSet) -> Undoable:
        """Return the steps without a restored write or step; unchanged if it does not belong to the latest step."""
        steps = self.all
        if not steps or not (latest == steps[0] or (latest.origin.at and latest.origin.at == steps[0].origin.at)):
            return self
        left = steps[0].without(latest)
        return Undoable(self.system_id, (left, *steps[1:]) if left.changes else steps[1:])


class ChangeLog:
    """Journal and undo files of one storage folder."""

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
        """Raise StorageError if no file can be written here: at start, not at the first write."""
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


KEEP_INTERRUPTIONS: Final = 50  # enough for years


class Interruption(msgspec.Struct, frozen=True, kw_only=True):
    """One interrupted write."""

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
