"""Content of pages, read from the storage folder without a daemon; nothing is changed there."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from companion.errors import StorageError
from companion.estimation.records.record import ArmingRecord, Record
from companion.report.calibration import Material
from companion.storage.records import RecordStore
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
    found: dict[int, Record] = {}
    damaged: dict[int, str] = {}
    for number in store.numbers():
        try:
            found |= {number: one} if (one := store.file(number).read()) is not None else {}
        except StorageError as error:
            damaged[number] = str(error)
    if not found:
        why = f"can be read: {'; '.join([*damaged.values()][:3])}" if damaged else f"yet: {records} is empty"
        raise StorageError(f"no calibration {why}")
    number = max(found) if wanted is None else wanted
    if number not in found:
        first, last = min(found | damaged), max(found | damaged)
        words = f"no calibration {number}; there are number {first} to {last} (companion history)"
        raise StorageError(damaged.get(number, words))
    record = found[number]
    problems, armings = [*damaged.values()], list[ArmingRecord]()
    try:
        armings = BoundedList(directory / "armings.json", ArmingRecord, keep=0).all()
    except StorageError as error:
        problems.append(str(error))
    earlier = [(k, one) for k, one in found.items() if k <= number and one.system_id == record.system_id]
    return Material(
        number=number,
        record=record,
        earlier=earlier[-MAX_EARLIER:],
        armings=[arming for arming in armings if arming.calibration == record.started_at],
        damaged=problems,
    )
