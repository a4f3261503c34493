"""Finds in the storage directory what the fleet has not been told yet, and tells each thing once.

The files are read as plain JSON: the collector checks the bodies, and the types of the records would load numpy. The
disk is the source, not the daemon's events: it has what happened before a crash, and before the fleet was configured.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import msgspec

from companion.errors import StorageError
from companion.formats import Object
from companion.storage.fleet_items import Clock, FleetItems, Item, Mark, SourceItems
from companion.storage.state import BoundedList, StateFile, named_in

RECORD, ARMING, BY_HAND, PROFILE, FLIGHT, IMU = "record/", "arming/", "by-hand/", "profile/", "flight/", "imu/"
TOLD: Final = "told"
_WATCHED: Final = ("records", "armings.json", "by-hand.json", "profiles", "flights")
_NAME: Final = re.compile(r"([a-z0-9][a-z0-9._-]*)\.json")
_LISTED: Final = 200
"""Most entries of a list; the daemon keeps no more."""
FORMAT_VERSION: Final = 1

Told = tuple[str, list[Item]]
"""The value of the mark, and the items."""


class _Keys(msgspec.Struct, frozen=True):
    """Keys that are needed here, of a file or an entry of any kind."""

    system_id: int | None = None
    undone_at: str | None = None
    started_at: str = ""
    imus: list[dict[str, Any]] = []
    what: str = ""
    state: str = ""
    measured_at: str = ""
    armed_at: str = ""
    saved_at: str = ""
    read_at: str = ""
    key: str = ""
    began_at: str | None = None
    flight: _Keys | None = None


_Found = tuple[_Keys, Object]


def utc(at: str) -> str:
    """Return a time of a record in the contract's form."""
    return f"{at.removesuffix('+00:00')}Z" if at.endswith("+00:00") else at


class CurrentAircraft(msgspec.Struct, frozen=True):
    """Aircraft that the items found now belong to."""

    aircraft: str
    system_id: int | None
    """MAVLink system; records of another one do not belong to the aircraft. None: all do."""
    clock: Callable[[str], Clock]
    """Returns how good the clock was at a time."""

    def owns(self, system_id: int | None) -> bool:
        """Return whether a record of that MAVLink system belongs to the aircraft."""
        return self.system_id is None or system_id in (None, self.system_id)

    def item(self, kind: str, at: str, body: object) -> Item:
        """Make an item."""
        return Item(kind, utc(at), self.clock(at), msgspec.json.encode(body))

    def undo(self, what: str, of: str, undone_at: str) -> Item:
        """Make the item of an undo of what was written by `what` at `of`."""
        return self.item("undo", undone_at, {"what": what, "of": of, "undone_at": undone_at})


class Sources:
    """Files of one storage directory; marks of what was told are in `items`. Reading blocks."""

    def __init__(self, directory: Path, items: FleetItems) -> None:
        self._directory, self._items = directory, items
        self._seen: tuple[str, ...] | None = None
        self._settled = False

    def has_news(self) -> bool:
        """Return whether something may have been written since the last call.

        Once more after each change: a second write in the same tick of the file system's clock changes no time.
        """
        seen = tuple(_stamp(self._directory / name) for name in _WATCHED)
        settled, self._settled = self._settled, seen == self._seen
        self._seen = seen
        return not (settled and self._settled)

    def entries(self, look: CurrentAircraft) -> Iterator[SourceItems]:
        """Yield what was not told yet.

        Raises:
            StorageError: a list or a folder cannot be read.
        """
        yield from self._records(look)
        yield from self._alignments(look)
        armings = {one.armed_at: body for one, body in self._listed("armings.json")}
        yield from self._told(
            ARMING, dict.fromkeys(armings, TOLD), lambda key, _: (TOLD, [look.item("arming", key, armings[key])])
        )
        yield from self._profiles(look)
        yield from self._flights(look)

    def _told(self, prefix: str, stamps: Mapping[str, str], tell: Callable[[str, str], Told]) -> Iterator[SourceItems]:
        """Yield an entry for each key whose stamp differs from its mark; `tell` makes it from the mark's value."""
        marks = self._items.marks(prefix)
        for key, stamp in stamps.items():
            before = marks.pop(prefix + key, Mark("", ""))
            if before.stamp != stamp:
                value, items = tell(key, before.value)
                yield SourceItems({prefix + key: Mark(stamp, value)}, items)
        if marks:
            self._items.forget(marks)

    def _stamps(self, folder: str) -> dict[str, str]:
        """Return the stamp of each JSON file of a folder by its name, in order."""
        path = self._directory / folder
        return {name: _stamp(path / f"{name}.json") for name in named_in(path, _NAME)}

    def _read(self, name: str) -> _Found | None:
        try:
            body = StateFile[Object](self._directory / name, dict[str, Any], newest=FORMAT_VERSION).read()
            return None if body is None else (msgspec.convert(body, _Keys), body)
        except (StorageError, msgspec.ValidationError):
            return None

    def _listed(self, name: str) -> list[_Found]:
        bodies = BoundedList(self._directory / name, dict, _LISTED).all()
        try:
            return [(msgspec.convert(body, _Keys), body) for body in bodies]
        except msgspec.ValidationError as error:
            raise StorageError(f"{self._directory / name}: cannot be used: {error}") from error

    def _records(self, look: CurrentAircraft) -> Iterator[SourceItems]:
        parts = {key: mark.value for key, mark in self._items.marks(f"{IMU}{look.aircraft}/").items()}
        changed: dict[str, Mark] = {}

        def tell(number: str, before: str) -> Told:
            found = self._read(f"records/{number}.json")
            if found is None or not look.owns(found[0].system_id):
                return before, []
            record, body = found
            began, _, undone_at = before.partition(" ")
            items = []
            if began != record.started_at:
                for imu in record.imus:
                    name, ids = imu.get("name", ""), {key: imu.get(key) for key in ("gyro_id", "accel_id")}
                    if ids == {"gyro_id": None, "accel_id": None}:
                        continue
                    key, now = f"{IMU}{look.aircraft}/{name}", msgspec.json.encode(ids).decode()
                    if parts.get(key, now) != now:
                        earlier = msgspec.json.decode(parts[key])
                        event = {"what": "imu exchanged", "imu": name, "before": earlier, "now": ids}
                        items.append(look.item("event", record.started_at, event))
                    parts[key], changed[key] = now, Mark("", now)
                items.append(look.item("calibration", record.started_at, body))
            if record.undone_at is not None and undone_at != record.undone_at:
                items.append(look.undo("calibration", record.started_at, record.undone_at))
            return f"{record.started_at} {record.undone_at or ''}", items

        for entry in self._told(RECORD, self._stamps("records"), tell):
            yield SourceItems({**entry.marks, **changed}, entry.items)
            changed.clear()

    def _alignments(self, look: CurrentAircraft) -> Iterator[SourceItems]:
        listed = self._listed("by-hand.json")
        # "predicted": gyro offsets that version 0.1 wrote.
        done = {f"{one.what} {one.measured_at}": (one, body) for one, body in listed if one.state != "predicted"}

        def tell(key: str, before: str) -> Told:
            one, body = done[key]
            items: list[Item] = []
            if not look.owns(one.system_id):
                return before, items
            if before != TOLD:
                told = {"undone_at": None, **body, "record": self._figures(one.measured_at)}
                items.append(look.item("alignment", one.measured_at, told))
            if one.undone_at is not None:
                items.append(look.undo(one.what, one.measured_at, one.undone_at))
            return TOLD, items

        return self._told(BY_HAND, {key: one.undone_at or TOLD for key, (one, _) in done.items()}, tell)

    def _figures(self, measured_at: str) -> Object | None:
        """Return the record of an alignment, while it is the latest of its kind."""
        for name in ("alignment.json", "faces.json"):
            found = self._read(name)
            if found is not None and found[0].measured_at == measured_at:
                return found[1]
        return None

    def _profiles(self, look: CurrentAircraft) -> Iterator[SourceItems]:
        def tell(name: str, before: str) -> Told:
            found = self._read(f"profiles/{name}.json")
            if found is None or found[0].saved_at == before:
                return before, []
            return found[0].saved_at, [look.item("profile", found[0].saved_at, found[1])]

        return self._told(PROFILE, self._stamps("profiles"), tell)

    def _flights(self, look: CurrentAircraft) -> Iterator[SourceItems]:
        def tell(number: str, before: str) -> Told:
            found = self._read(f"flights/{number}.json")
            flight = None if found is None else found[0].flight
            # A flight whose log was read again is the same flight.
            if found is None or flight is None or before == flight.key or not look.owns(flight.system_id):
                return before, []
            return flight.key, [look.item("flight", flight.began_at or found[0].read_at, found[1])]

        return self._told(FLIGHT, self._stamps("flights"), tell)


def _stamp(path: Path) -> str:
    try:
        return str(path.stat().st_mtime_ns)
    except OSError:
        return ""
