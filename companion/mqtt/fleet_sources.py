"""What there is to tell, out of the storage directory: whoever has written it there, and whenever, each thing once.

Not told as it happens: what the disk has is what has happened, after a crash too, and before the fleet was switched on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Final

import msgspec

from companion.errors import StorageError
from companion.estimation.records.record import Record
from companion.storage.changes import PREDICTION
from companion.storage.fleet_items import Clock, Entry, FleetItems, Item, Mark
from companion.storage.flights import FlightStore
from companion.storage.learned import alignment_in, alignments_in, armings_in, faces_in
from companion.storage.profiles import ProfileStore
from companion.storage.records import RecordStore

RECORD, ARMING, BY_HAND, PROFILE, FLIGHT, IMU = "record/", "arming/", "by-hand/", "profile/", "flight/", "imu/"
"""What marks begin with."""
TOLD: Final = "told"
_WATCHED: Final = ("records", "armings.json", "by-hand.json", "profiles", "flights")

Told = tuple[str, list[Item]]
"""The value of the mark, and the items."""


def utc(at: str) -> str:
    """A time of ours as it is told."""
    return f"{at.removesuffix('+00:00')}Z" if at.endswith("+00:00") else at


class Sources:
    """Of one storage directory, with the marks of what was taken in `items`; reading is blocking."""

    def __init__(self, directory: Path, items: FleetItems) -> None:
        self._directory, self._items = directory, items
        self._records, self._profiles = RecordStore(directory), ProfileStore(directory)
        self._flights = FlightStore(directory)
        self._seen: tuple[str, ...] | None = None
        self._settled = False

    def has_news(self) -> bool:
        """Whether something may have been written since the last call.

        Once more after each change: what is written in the same tick of the file system's clock changes no time.
        """
        seen = tuple(_stamp(self._directory / name) for name in _WATCHED)
        settled, self._settled = self._settled, seen == self._seen
        self._seen = seen
        return not (settled and self._settled)

    def entries(self, look: Look) -> Iterator[Entry]:
        """What was not taken yet.

        Raises:
            StorageError: something cannot be read.
        """
        yield from self._of_records(look)
        yield from self._of_stands(look)
        at = {one.armed_at: one for one in armings_in(self._directory).all()}
        yield from self._told(
            ARMING, dict.fromkeys(at, TOLD), lambda key, _: (TOLD, [look.item("arming", key, at[key])])
        )
        yield from self._of_profiles(look)
        yield from self._of_flights(look)

    def _told(self, prefix: str, stamps: Mapping[str, str], tell: Callable[[str, str], Told]) -> Iterator[Entry]:
        """Of each whose stamp is another one than before, what `tell` makes of it and of the value before."""
        marks = self._items.marks(prefix)
        for key, stamp in stamps.items():
            before = marks.pop(prefix + key, Mark("", ""))
            if before.stamp != stamp:
                value, items = tell(key, before.value)
                yield Entry({prefix + key: Mark(stamp, value)}, items)
        if marks:
            self._items.forget(marks)

    def _of_records(self, look: Look) -> Iterator[Entry]:
        imus = {key: mark.value for key, mark in self._items.marks(f"{IMU}{look.aircraft}/").items()}
        exchanged: dict[str, Mark] = {}

        def tell(number: str, before: str) -> Told:
            record = self._records.entry(int(number)).record
            if record is None or not look.is_its(record.system_id):
                return before, []
            began, _, undone_at = before.partition(" ")
            items = []
            if began != record.started_at:
                exchanged.update(_parts(look.aircraft, record))
                items += [look.exchanged(record, key, imus.get(key), mark.value) for key, mark in exchanged.items()]
                imus.update({key: mark.value for key, mark in exchanged.items()})
                items.append(look.item("calibration", record.started_at, record))
            if record.undone_at is not None and undone_at != record.undone_at:
                items.append(look.undo("calibration", record.started_at, record.undone_at))
            return f"{record.started_at} {record.undone_at or ''}", [item for item in items if item is not None]

        stamps = {f"{number:06d}": stamp for number, stamp in self._records.stamps().items()}
        for entry in self._told(RECORD, stamps, tell):
            yield Entry({**entry.marks, **exchanged}, entry.items)
            exchanged.clear()

    def _of_stands(self, look: Look) -> Iterator[Entry]:
        file = alignments_in(self._directory)
        done = {f"{each.what} {each.measured_at}": each for each in file.all() if each.what != PREDICTION}

        def tell(key: str, before: str) -> Told:
            each, items = done[key], []
            if not look.is_its(each.system_id):
                return before, []
            if before != TOLD:
                body = {**msgspec.to_builtins(each), "record": self._figures(each.measured_at)}
                items.append(look.item("alignment", each.measured_at, body))
            if each.undone_at is not None:
                items.append(look.undo(each.what, each.measured_at, each.undone_at))
            return TOLD, items

        return self._told(BY_HAND, {key: each.undone_at or TOLD for key, each in done.items()}, tell)

    def _figures(self, measured_at: str) -> object:
        """The record of an alignment, while it is the latest of its kind."""
        for file in (alignment_in(self._directory), faces_in(self._directory)):
            record = file.read()
            if record is not None and record.measured_at == measured_at:
                return record
        return None

    def _of_profiles(self, look: Look) -> Iterator[Entry]:
        def tell(name: str, before: str) -> Told:
            try:
                profile = self._profiles.read(name)
            except StorageError:
                return before, []
            is_new = profile.saved_at != before
            return profile.saved_at, [look.item("profile", profile.saved_at, profile)] if is_new else []

        return self._told(PROFILE, {name: _stamp(self._profiles.path(name)) for name in self._profiles.names()}, tell)

    def _of_flights(self, look: Look) -> Iterator[Entry]:
        def tell(number: str, before: str) -> Told:
            try:
                kept = self._flights.read(int(number))
            except StorageError:
                return before, []
            # Read again from its log, it is the same flight.
            if kept is None or before == kept.flight.key or not look.is_its(kept.flight.system_id):
                return before, []
            return kept.flight.key, [look.item("flight", kept.flight.began_at or kept.read_at, kept)]

        numbers = [f"{number:06d}" for number in self._flights.numbers()]
        folder = self._flights.folder
        return self._told(FLIGHT, {number: _stamp(folder / f"{number}.json") for number in numbers}, tell)


class Look(msgspec.Struct, frozen=True):
    """Whose all is that is found now."""

    aircraft: str
    system_id: int | None
    """What was recorded of another MAVLink system is not its; None: all is."""
    clock: Callable[[str], Clock]
    """How good the clock was at a time."""

    def is_its(self, system_id: int | None) -> bool:
        """Whether what was recorded of that system is."""
        return self.system_id is None or system_id in (None, self.system_id)

    def item(self, kind: str, at: str, body: object) -> Item:
        """Something to be told."""
        return Item(kind, utc(at), self.clock(at), msgspec.json.encode(body))

    def undo(self, what: str, of: str, undone_at: str) -> Item:
        """What was written by `what` at `of` was put back."""
        return self.item("undo", undone_at, {"what": what, "of": of, "undone_at": undone_at})

    def exchanged(self, record: Record, key: str, before: str | None, now: str) -> Item | None:
        """That an IMU is another part than before, if so."""
        if before in (None, now):
            return None
        before_ids, now_ids = (msgspec.json.decode(ids) for ids in (before or "", now))
        body = {"what": "imu exchanged", "imu": key.rpartition("/")[2], "before": before_ids, "now": now_ids}
        return self.item("event", record.started_at, body)


def _parts(aircraft: str, record: Record) -> dict[str, Mark]:
    """Which part each IMU is, where it is known."""
    return {
        f"{IMU}{aircraft}/{imu.name}": Mark(
            "", msgspec.json.encode({"gyro_id": imu.gyro_id, "accel_id": imu.accel_id}).decode()
        )
        for imu in record.imus
        if (imu.gyro_id, imu.accel_id) != (None, None)
    }


def _stamp(path: Path) -> str:
    try:
        return str(path.stat().st_mtime_ns)
    except OSError:
        return ""
