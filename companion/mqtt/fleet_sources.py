"""Search of the storage directory for new results (calibrations, armings, ...); each becomes a fleet item once.

The files are read as plain JSON: the collector checks the contents, and the types of the records would import numpy.
Unlike the daemon's events, the files include results from before a crash or before the fleet was configured.
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
_LISTED: Final = 200  # Most entries read from a list; the daemon stores no more
FORMAT_VERSION: Final = 1


class _Keys(msgspec.Struct, frozen=True):
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
    return f"{at.removesuffix('+00:00')}Z" if at.endswith("+00:00") else at


class CurrentAircraft(msgspec.Struct, frozen=True):
    """Aircraft to which items found now belong, and the function that rates a timestamp as "good" or "unknown"."""

    aircraft: str
    system_id: int | None
    """MAVLink system id: records with another id belong to other aircraft. None: all records belong to this one."""
    clock: Callable[[str], Clock]

    def owns(self, system_id: int | None) -> bool:
        return self.system_id is None or system_id in (None, self.system_id)

    def item(self, kind: str, at: str, body: object) -> Item:
        return Item(kind, utc(at), self.clock(at), msgspec.json.encode(body))

    def undo(self, what: str, of: str, undone_at: str) -> Item:
        return self.item("undo", undone_at, {"what": what, "of": of, "undone_at": undone_at})


class Sources:
    """Result files of one storage directory; `items` has a mark for each result already read. Methods block."""

    def __init__(self, directory: Path, items: FleetItems) -> None:
        self._directory, self._items = directory, items
        self._seen: tuple[str, ...] | None = None
        self._settled = False

    def has_news(self) -> bool:
        """Return True if a file has changed since the last call. Each change is reported by two calls in a row.

        The second report is needed because a second write in one tick of the file system's clock changes no timestamp.
        """
        seen = tuple(_stamp(self._directory / name) for name in _WATCHED)
        settled, self._settled = self._settled, seen == self._seen
        self._seen = seen
        return not (settled and self._settled)

    def entries(self, current: CurrentAircraft) -> Iterator[SourceItems]:
        """Yield the results in the storage directory that are not yet items for the fleet.

        Raises:
            StorageError: a list or a folder cannot be read.
        """
        for source in (self._records, self._alignments, self._armings, self._profiles, self._flights):
            yield from source(current)

    def _changed(self, prefix: str, stamps: Mapping[str, str]) -> Iterator[tuple[str, str]]:
        """Yield key and mark value of each source that changed since it was read; delete marks of deleted sources."""
        marks = self._items.marks(prefix)
        for key, stamp in stamps.items():
            before = marks.pop(prefix + key, Mark("", ""))
            if before.stamp != stamp:
                yield key, before.value
        if marks:
            self._items.forget(marks)

    def _stamps(self, folder: str) -> dict[str, str]:
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

    def _records(self, current: CurrentAircraft) -> Iterator[SourceItems]:
        parts = {key: mark.value for key, mark in self._items.marks(f"{IMU}{current.aircraft}/").items()}
        stamps = self._stamps("records")
        for number, before in self._changed(RECORD, stamps):
            marks: dict[str, Mark] = {}
            items: list[Item] = []
            value, found = before, self._read(f"records/{number}.json")
            if found is not None and current.owns(found[0].system_id):
                record, body = found
                began, _, undone_at = before.partition(" ")
                if began != record.started_at:
                    now = _parts(current, record)
                    for key in now:
                        if parts.get(key, now[key]) != now[key]:
                            earlier, later = (msgspec.json.decode(ids) for ids in (parts[key], now[key]))
                            event = {"what": "imu exchanged", "imu": key.rpartition("/")[2]}
                            event |= {"before": earlier, "now": later}
                            items.append(current.item("event", record.started_at, event))
                    parts |= now
                    marks = {key: Mark("", ids) for key, ids in now.items()}
                    items.append(current.item("calibration", record.started_at, body))
                if record.undone_at is not None and undone_at != record.undone_at:
                    items.append(current.undo("calibration", record.started_at, record.undone_at))
                value = f"{record.started_at} {record.undone_at or ''}"
            yield SourceItems({RECORD + number: Mark(stamps[number], value), **marks}, items)

    def _alignments(self, current: CurrentAircraft) -> Iterator[SourceItems]:
        listed = self._listed("by-hand.json")
        # "predicted": gyro offsets that version 0.1 wrote.
        done = {f"{one.what} {one.measured_at}": (one, body) for one, body in listed if one.state != "predicted"}
        stamps = {key: one.undone_at or TOLD for key, (one, _) in done.items()}
        for key, before in self._changed(BY_HAND, stamps):
            one, body = done[key]
            items: list[Item] = []
            owned = current.owns(one.system_id)
            if owned and before != TOLD:
                told = {"undone_at": None, **body, "record": self._figures(one.measured_at)}
                items.append(current.item("alignment", one.measured_at, told))
            if owned and one.undone_at is not None:
                items.append(current.undo(one.what, one.measured_at, one.undone_at))
            yield SourceItems({BY_HAND + key: Mark(stamps[key], TOLD if owned else before)}, items)

    def _figures(self, measured_at: str) -> Object | None:
        for name in ("alignment.json", "faces.json"):
            found = self._read(name)
            if found is not None and found[0].measured_at == measured_at:
                return found[1]
        return None

    def _armings(self, current: CurrentAircraft) -> Iterator[SourceItems]:
        armings = {one.armed_at: body for one, body in self._listed("armings.json")}
        for at, _ in self._changed(ARMING, dict.fromkeys(armings, TOLD)):
            yield SourceItems({ARMING + at: Mark(TOLD, TOLD)}, [current.item("arming", at, armings[at])])

    def _profiles(self, current: CurrentAircraft) -> Iterator[SourceItems]:
        stamps = self._stamps("profiles")
        for name, before in self._changed(PROFILE, stamps):
            found = self._read(f"profiles/{name}.json")
            value = before if found is None else found[0].saved_at
            items = [] if found is None or value == before else [current.item("profile", value, found[1])]
            yield SourceItems({PROFILE + name: Mark(stamps[name], value)}, items)

    def _flights(self, current: CurrentAircraft) -> Iterator[SourceItems]:
        stamps = self._stamps("flights")
        for number, before in self._changed(FLIGHT, stamps):
            items: list[Item] = []
            value, found = before, self._read(f"flights/{number}.json")
            flight = None if found is None else found[0].flight
            # Reading a log again gives the same flight: no new item.
            if found is not None and flight is not None and flight.key != before and current.owns(flight.system_id):
                value = flight.key
                items.append(current.item("flight", flight.began_at or found[0].read_at, found[1]))
            yield SourceItems({FLIGHT + number: Mark(stamps[number], value)}, items)


def _parts(current: CurrentAircraft, record: _Keys) -> dict[str, str]:
    """Return the device ids of a record's IMUs as JSON, by key of the IMU's mark; IMUs without ids are left out."""
    ids = {imu.get("name", ""): {key: imu.get(key) for key in ("gyro_id", "accel_id")} for imu in record.imus}
    known = {name: each for name, each in ids.items() if any(value is not None for value in each.values())}
    return {f"{IMU}{current.aircraft}/{name}": msgspec.json.encode(each).decode() for name, each in known.items()}


def _stamp(path: Path) -> str:
    try:
        return str(path.stat().st_mtime_ns)
    except OSError:
        return ""
