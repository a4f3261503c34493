"""Content of pages, read from the storage folder without a daemon; nothing is changed there."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from companion.errors import StorageError
from companion.estimation.records.record import ArmingRecord, Record
from companion.report.calibration import Material
from companion.storage.records import Entry, RecordStore
from companion.storage.state import BoundedList

MAX_EARLIER: Final = 60


def material(directory: Path, wanted: int | None) -> Material:
    """Read the content of a page by a calibration's number; None: the latest."""
    store, records = RecordStore(directory), directory / "records"
    try:
        # Else a folder that only root may enter looks like one that is not there.
        next(iter(records.iterdir()), None)
    except FileNotFoundError:
        raise StorageError(f"no calibration yet: there is no {records} (--storage DIR names another folder)") from None
    except OSError as error:
        hint = "; run it with sudo" if isinstance(error, PermissionError) else ""
        raise StorageError(f"{records}: cannot be read: {error.strerror}{hint}") from error
    entries = list(store.entries())[::-1]  # oldest first
    damaged = [f"{entry.path.name}: {entry.problem}" for entry in entries if entry.record is None]
    if not entries:
        raise StorageError(f"no calibration yet: {records} is empty")
    if not any(entry.record for entry in entries):
        raise StorageError(f"no calibration can be read: {'; '.join(damaged[:3])}")
    entry, record = _find(entries, wanted)
    armings: list[ArmingRecord] = []
    try:
        armings = BoundedList(directory / "armings.json", ArmingRecord, keep=0).all()
    except StorageError as error:
        damaged.append(str(error))
    earlier = [
        (one.number, one.record)
        for one in entries
        if one.record is not None and one.number <= entry.number and one.record.system_id == record.system_id
    ]
    return Material(
        number=entry.number,
        record=record,
        earlier=earlier[-MAX_EARLIER:],
        armings=[arming for arming in armings if arming.calibration == record.started_at],
        damaged=damaged,
    )


def _find(entries: Sequence[Entry], wanted: int | None) -> tuple[Entry, Record]:
    if wanted is None:
        return next((entry, entry.record) for entry in reversed(entries) if entry.record is not None)
    found = next((entry for entry in entries if entry.number == wanted), None)
    if found is None:
        first, last = entries[0].number, entries[-1].number
        raise StorageError(f"no calibration {wanted}; there are number {first} to {last} (companion history)")
    if found.record is None:
        raise StorageError(f"{found.path}: {found.problem}")
    return found, found.record
