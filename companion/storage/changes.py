"""What we changed in an autopilot: kept before the first write, so that it can be put back after any interruption.

`journal.json` exists only while a write is under way (found at start, it means that the daemon died in the middle);
`undo-N.json` holds the values before the last finished write on the vehicle with system id N. What they say is written
to an autopilot, so that they may name nothing else than what the companion writes, with values that can be.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Final

import msgspec

from companion.autopilot.firmware.firmwares import CALIBRATION
from companion.autopilot.parameters.change import Change
from companion.storage.state import StateFile, remove_durably, write_atomically

_UNDO: Final = re.compile(r"undo-(\d{1,3})\.json")
_SYSTEM_IDS: Final = range(1, 256)


class Changed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One parameter: the value before, the one we set, and the one that is set on the way between them, if any."""

    parameter: str
    before: float
    after: float | None
    """None: not known in advance, and whatever is found is of our doing (the firmware's own gyro calibration that we
    have started)."""
    via: float | None = None
    also: tuple[float, ...] = ()
    """Other values that may stand there by our doing, while several are set one after the other."""


class ChangeSet(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The changes of one calibration on one vehicle."""

    system_id: int
    changes: tuple[Changed, ...]

    @classmethod
    def of(
        cls, system_id: int | None, changes: Iterable[Change], unforeseen: Mapping[str, float] | None = None
    ) -> ChangeSet:
        """What is kept of changes before the first is made, and the old values of what the firmware will overwrite.

        Of a vehicle that is not known nothing can be kept.
        """
        found = [Changed(change.parameter, change.before, change.after, change.via) for change in changes]
        found += [Changed(name, before, None) for name, before in (unforeseen or {}).items()]
        return cls(system_id or 0, tuple(found))

    @property
    def names(self) -> list[str]:
        """Of the parameters."""
        return [changed.parameter for changed in self.changes]


ChangeFile = StateFile[ChangeSet]
"""One change set on disk, or none."""


class ChangeLog:
    """The change files of one storage folder."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._allowed = {name: one for each in CALIBRATION.values() for name, one in each.items()}
        self._probe = directory / "probe"
        self.journal: ChangeFile = StateFile(directory / "journal.json", ChangeSet, self._check)

    def undo_of(self, system_id: int) -> ChangeFile:
        """The values from before the last finished write on one vehicle."""
        check = functools.partial(self._check, system_id=system_id)
        return StateFile(self._directory / f"undo-{system_id}.json", ChangeSet, check)

    def undos(self) -> list[ChangeFile]:
        """Of all vehicles of which there is one."""
        numbers = [match[1] for match in map(_UNDO.fullmatch, self._names()) if match]
        return [self.undo_of(int(number)) for number in sorted(numbers) if number == str(int(number))]

    def check_writable(self) -> None:
        """Find out now, not at the first write, whether anything can be kept here.

        Raises:
            StorageError: it cannot.
        """
        write_atomically(self._probe, b"")
        remove_durably(self._probe)

    def _names(self) -> Iterator[str]:
        try:
            yield from (path.name for path in self._directory.iterdir())
        except OSError:
            return  # there is none, or `check_writable` has said so

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
