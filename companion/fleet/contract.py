"""Parser of the MQTT payloads that aircraft send to the fleet (docs/fleet/asyncapi.yaml): from bytes to table rows.

The columns in fleet/schema.py define the allowed values. Invalid bytes raise `InvalidPayloadError` and nothing else.
"""

from __future__ import annotations

import datetime
import hashlib
import re
from collections.abc import Callable, Iterable
from typing import Annotated, Any, Final, TypeVar

import msgspec
import sqlalchemy as sa

from companion.autopilot.firmware.firmwares import CALIBRATION
from companion.estimation.records.flight_record import KeptFlight
from companion.fleet import schema
from companion.fleet.acl import AIRCRAFT_ID
from companion.mqtt.fleet import FORMAT_VERSION, MOST_RANGES, MOST_SEQUENCE
from companion.samples import TRIADS

MOST_BYTES: Final = 256 * 1024
_AIRCRAFT: Final = re.compile(rf"fleet/({AIRCRAFT_ID.pattern})/(hello|item)")
_MOST: Final = 1e12
_EARLIEST: Final = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
_LATEST: Final = datetime.datetime(2200, 1, 1, tzinfo=datetime.UTC)
"""Latest accepted time. The earliest one, 1970, is allowed because a clock without a battery starts there."""
_STATES: Final = ("done", "failed", "cancelled")
_KEY: Final = ("aircraft", "epoch", "sequence")
_TRIADS: Final = [name for name, _ in schema.biases.c.items() if name.endswith(("_rad_s", "_m_s2"))]

_Aircraft = Annotated[str, msgspec.Meta(pattern=f"^({AIRCRAFT_ID.pattern})$")]
_Epoch = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{16}$")]
_Sequence = Annotated[int, msgspec.Meta(ge=1, le=MOST_SEQUENCE)]
_Object = dict[str, Any]
_Imus = Annotated[list[_Object], msgspec.Meta(max_length=64)]
_Words = list[Annotated[str, msgspec.Meta(max_length=16)]]
_Keyed = TypeVar("_Keyed", "Hello", "ReceivedItem")

Row = dict[str, Any]
Rows = dict[str, list[Row]]


class InvalidPayloadError(Exception):
    """Error: a payload breaks docs/fleet/asyncapi.yaml; the text is one line with the reason."""


class Hello(msgspec.Struct, frozen=True):
    """Message of an aircraft at each connection: the range of numbers of the items that the aircraft stores."""

    format_version: Annotated[int, msgspec.Meta(ge=FORMAT_VERSION, le=FORMAT_VERSION)]
    aircraft: _Aircraft
    epoch: _Epoch
    first: _Sequence
    last: Annotated[int, msgspec.Meta(ge=0, le=MOST_SEQUENCE)]
    name: str | None = None
    at: str = ""


class ReceivedItem(msgspec.Struct, frozen=True):
    """Received result or event of an aircraft. Newer formats may change all fields but aircraft, epoch, sequence."""

    format_version: Annotated[int, msgspec.Meta(ge=1, le=MOST_SEQUENCE)]
    aircraft: _Aircraft
    epoch: _Epoch
    sequence: _Sequence
    kind: Any = None
    at: Any = None
    clock: Any = None
    body: msgspec.Raw = msgspec.Raw(b"null")

    @property
    def key(self) -> Row:
        return {name: getattr(self, name) for name in _KEY}


def _row(table: sa.Table, told: _Object) -> Row:
    return {name: _fitting(column, told.get(name)) for name, column in table.c.items() if name not in _KEY}


def _fitting(column: sa.Column[Any], value: object) -> Any:
    """Convert a JSON value to the type of a database column; raise NotTakenError if the value does not fit."""
    kind = column.type
    if value is None and column.nullable:
        return None
    if isinstance(kind, schema.UtcTime):
        allowed = "a time"
        if isinstance(value, str):
            return moment(value)
    elif isinstance(kind, sa.Double):
        allowed = f"a number up to {_MOST:g}"
        if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _MOST:
            return float(value)
    elif isinstance(kind, sa.BigInteger):
        allowed = "a whole number of 64 bits"
        if isinstance(value, int) and not isinstance(value, bool) and -(2**63) <= value < 2**63:
            return value
    else:
        most = getattr(kind, "length", None)
        allowed = f"a text of up to {most} characters" if most else "a text"
        if isinstance(value, str) and len(value) <= (most or MOST_BYTES):
            return value
    raise InvalidPayloadError(f"{column.name}: found {str(value)[:40]}; allowed: {allowed}")


def _calibration(told: _Object) -> Rows:
    if told.get("state") not in _STATES:
        raise InvalidPayloadError(f"state: found {str(told.get('state'))[:40]}; allowed: {', '.join(_STATES)}")
    biases: list[Row] = []
    held: list[str] = []
    written: set[str] = set()
    imus = msgspec.convert(told.get("imus"), _Imus)
    for name, imu in {_fitting(schema.biases.c.imu, imu.get("name")): imu for imu in imus}.items():
        held += [f"{name} {triad}" for triad in msgspec.convert(imu.get("held_back", []), _Words)]
        written |= msgspec.convert(imu.get("written", {}), _Object).keys()
        # Biases before they were combined with earlier power-ups; None: not combined.
        prior = msgspec.convert(imu.get("prior"), dict[str, _Object | None] | None) or {}
        gyro, accel = (prior.get(triad) or {} for triad in TRIADS)
        read = {"gyro_read_rad_s": gyro.get("measured_rad_s"), "accel_read_m_s2": accel.get("measured_m_s2")}
        triads = {key: msgspec.convert((imu | read).get(key), tuple[Any, Any, Any] | None) for key in _TRIADS}
        for number, axis in enumerate("xyz"):
            figures = {key: value and value[number] for key, value in triads.items()}
            biases.append(_row(schema.biases, {**imu, **figures, "imu": name, "axis": axis}))
    zero = msgspec.convert(told.get("alignment"), _Object | None)
    magnetic = msgspec.convert(told.get("magnetic"), _Object | None) or {}
    zeros: _Object = {"zero_at": None, "zero_x_deg": None, "zero_y_deg": None, "zero_sigma_deg": None}
    if zero is not None:
        x_deg, y_deg = msgspec.convert(zero.get("offset_deg"), tuple[float, float])
        zeros = dict(zip(zeros, (zero.get("measured_at"), x_deg, y_deg, zero.get("sigma_deg")), strict=True))
        if None in zeros.values():
            raise InvalidPayloadError("alignment: wanted: measured_at, offset_deg and sigma_deg")
    found = {
        **told,
        **zeros,
        "held_back": ", ".join(held),
        "firmware": next((firmware for firmware, ranges in CALIBRATION.items() if written & ranges.keys()), None),
        "heading_bound_deg": magnetic.get("heading_bound_deg"),
    }
    return {"calibrations": [_row(schema.calibrations, found)], "biases": biases}


def _flight(told: _Object) -> Rows:
    flight = msgspec.convert(told, KeptFlight).flight
    rows: list[Row] = []
    for imu in flight.imus:
        flown = min(imu.drift.get("flown", ()), key=lambda each: abs(each.seconds - 30.0), default=None)
        which = {
            "flight": flight.key,
            "began_at": flight.began_at,
            "instance": imu.imu,
            "gyro_id": imu.gyro_id,
            "accel_id": imu.accel_id,
            "calibration_at": imu.calibration,
            "drift_s": flown and flown.seconds,
            "drift_m": flown and flown.median_m,
        }
        for split in imu.axes:
            triad, _, axis = split.axis.partition(" ")
            row: Row = {**which, "triad": triad[:16], "axis": axis[:1]}
            for name in ("in_flight", "turn_on", "motors"):
                term = getattr(split, name)
                row |= {name: term and term.value, f"{name}_sigma": term and term.sigma}
            rows.append(_row(schema.flights, row))
    return {"flights": rows}


KINDS: Final[dict[str, Callable[[_Object], Rows]]] = {
    "calibration": _calibration,
    "arming": lambda told: {"armings": [_row(schema.armings, told | {"calibration_at": told.get("calibration")})]},
    "undo": lambda told: {"undos": [_row(schema.undos, told | {"of_at": told.get("of")})]},
    "alignment": lambda told: {"alignments": [_row(schema.alignments, told)]},
    "event": lambda told: {
        "events": [_row(schema.events, {"what": told.get("what"), "body": msgspec.json.encode(told).decode()})]
    },
    "profile": lambda _: {},
    "curve": lambda _: {},
    "flight": _flight,
}
"""Parsers of an item's body, by kind. Items of other kinds are stored until a newer companion can parse them."""


def moment(words: str) -> datetime.datetime:
    """Parse an ISO 8601 time, in UTC unless it names another zone; return it in UTC.

    Raises:
        NotTakenError: the text is not a time, or the time is out of range.
    """
    try:
        found = datetime.datetime.fromisoformat(words)
        found = found.replace(tzinfo=datetime.UTC) if found.tzinfo is None else found.astimezone(datetime.UTC)
    except (ValueError, OverflowError):
        raise InvalidPayloadError(f"found {words[:40]!r}; allowed: a time such as 2026-11-23T06:12:00.000Z") from None
    if not _EARLIEST <= found < _LATEST:
        raise InvalidPayloadError(f"found {words[:40]!r}; allowed: a time from {_EARLIEST.year} to {_LATEST.year - 1}")
    return found


def addressed(topic: str) -> tuple[str, str] | None:
    """Split a topic fleet/ID/hello or fleet/ID/item into the aircraft's id and the last part; None: another topic."""
    match = _AIRCRAFT.fullmatch(topic)
    return None if match is None else (match[1], match[2])


def read_hello(aircraft: str, payload: bytes) -> Hello:
    """Parse a hello; raise NotTakenError if it is invalid, has another format, or names a different aircraft."""
    return _decode(aircraft, payload, Hello)


def read_item(aircraft: str, payload: bytes) -> ReceivedItem:
    """Parse an item except its body; raise NotTakenError if its key is invalid or names a different aircraft."""
    if len(payload) > MOST_BYTES:
        raise InvalidPayloadError(f"found {len(payload)} bytes; allowed: up to {MOST_BYTES}")
    return _decode(aircraft, payload, ReceivedItem)


def rows_of(item: ReceivedItem) -> tuple[Row, Rows]:
    """Parse an item into columns of the table `items` and rows of other tables.

    An item of a newer kind or format has `state` "unknown" and no rows. Raises NotTakenError if the body does not fit
    a known kind and format.
    """
    if item.format_version != FORMAT_VERSION:
        return {"state": "unknown", "kind": None, "at": None, "clock": None, "same": None}, {}
    try:
        kind, at, clock = (msgspec.convert(value, str) for value in (item.kind, item.at, item.clock))
        columns: Row = {"kind": kind[:64], "at": moment(at), "clock": clock[:16], "same": None}
        if kind not in KINDS:
            return {**columns, "state": "unknown"}, {}
        body = msgspec.json.decode(item.body, type=_Object)
        rows = KINDS[kind](body)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidPayloadError(f"{str(item.kind)[:64]}: {error}") from None
    for row in rows.get("events", ()):
        row["at"] = columns["at"]
    columns["same"] = _same(item, rows, body)
    return {**columns, "state": "taken"}, {table: [{**item.key, **row} for row in of] for table, of in rows.items()}


def ranges(sequences: Iterable[int]) -> list[list[int]]:
    found: list[list[int]] = []
    for sequence in sorted(set(sequences)):
        if found and found[-1][1] == sequence - 1:
            found[-1][1] = sequence
        else:
            found.append([sequence, sequence])
    return found


def answers(epoch: str, found: list[list[int]]) -> list[bytes]:
    return [
        msgspec.json.encode(
            {"format_version": FORMAT_VERSION, "epoch": epoch, "sequences": found[start : start + MOST_RANGES]}
        )
        for start in range(0, len(found), MOST_RANGES)
    ]


def _decode(aircraft: str, payload: bytes, kind: type[_Keyed]) -> _Keyed:
    try:
        told = msgspec.json.decode(payload, type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise InvalidPayloadError(str(error)) from None
    if told.aircraft != aircraft:
        raise InvalidPayloadError(f"says that it is {told.aircraft}, on the topic of {aircraft}")
    return told


def _same(item: ReceivedItem, rows: Rows, body: _Object) -> str:
    """Hash an item's content without `undone_at`: an item that a new memory card sends again has an equal hash."""
    content: Any = [(table, {**row, "undone_at": None}) for table in sorted(rows) for row in rows[table]]
    told_again = msgspec.json.encode((item.kind, item.at, content if rows else body), order="deterministic")
    return hashlib.sha256(told_again).hexdigest()[:32]
