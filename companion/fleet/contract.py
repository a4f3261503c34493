"""Parser of the aircraft's payloads (docs/fleet/asyncapi.yaml): from bytes to rows of the tables.

Bytes of any content raise nothing but `NotTakenError`.
"""

from __future__ import annotations

import datetime
import hashlib
import re
from collections.abc import Callable, Iterable
from typing import Annotated, Any, Final, Literal, TypeVar

import msgspec

from companion.autopilot.firmware.firmwares import CALIBRATION
from companion.estimation.records.flight_record import KeptFlight
from companion.samples import TRIADS

FORMAT_VERSION: Final = 1
MOST_RANGES: Final = 256
"""Most ranges of sequences in one message to an aircraft."""
MOST_SEQUENCE: Final = 2**53
MOST_BYTES: Final = 256 * 1024
AIRCRAFT_ID: Final = re.compile(r"[0-9a-f]{16}|[0-9a-f]{36}")
_AIRCRAFT: Final = re.compile(rf"fleet/({AIRCRAFT_ID.pattern})/(hello|item)")
_MOST: Final = 1e12
_EARLIEST: Final = datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
_LATEST: Final = datetime.datetime(2200, 1, 1, tzinfo=datetime.UTC)
"""Latest time that is accepted; the earliest is that of a clock without a battery."""

_Aircraft = Annotated[str, msgspec.Meta(pattern=f"^({AIRCRAFT_ID.pattern})$")]
_Epoch = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{16}$")]
_Sequence = Annotated[int, msgspec.Meta(ge=1, le=MOST_SEQUENCE)]
_Number = Annotated[float, msgspec.Meta(ge=-_MOST, le=_MOST)]
_Axes = tuple[_Number, _Number, _Number] | None
_Device = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)] | None
_Word = Annotated[str, msgspec.Meta(max_length=16)]

_Kind = TypeVar("_Kind")
_Keyed = TypeVar("_Keyed", "Hello", "ItemKey")

Row = dict[str, Any]
Rows = dict[str, list[Row]]
"""Rows by table."""


class NotTakenError(Exception):
    """A payload breaks the contract; the message is one line with the reason."""


class Hello(msgspec.Struct, frozen=True):
    """Range of the items that an aircraft keeps."""

    format_version: Annotated[int, msgspec.Meta(ge=FORMAT_VERSION, le=FORMAT_VERSION)]
    aircraft: _Aircraft
    epoch: _Epoch
    first: _Sequence
    last: Annotated[int, msgspec.Meta(ge=0, le=MOST_SEQUENCE)]
    name: str | None = None
    at: str = ""


class ItemKey(msgspec.Struct, frozen=True):
    """Key of an item; a newer format may change everything else."""

    format_version: Annotated[int, msgspec.Meta(ge=1, le=MOST_SEQUENCE)]
    aircraft: _Aircraft
    epoch: _Epoch
    sequence: _Sequence

    @property
    def key(self) -> Row:
        """Columns of the primary key."""
        return {"aircraft": self.aircraft, "epoch": self.epoch, "sequence": self.sequence}


class _Told(msgspec.Struct, frozen=True):
    kind: str
    at: str
    clock: str
    body: msgspec.Raw


class _Found(msgspec.Struct, frozen=True):
    measured_rad_s: _Axes = None
    measured_m_s2: _Axes = None


class _Imu(msgspec.Struct, frozen=True):
    name: Annotated[str, msgspec.Meta(max_length=64)]
    samples: Annotated[int, msgspec.Meta(ge=0, le=MOST_SEQUENCE)] | None = None
    prior: dict[str, _Found | None] | None = None
    written: dict[str, msgspec.Raw] = {}
    temperature_degc: _Number | None = None
    held_back: list[_Word] = []
    gyro_id: _Device = None
    accel_id: _Device = None
    gyro_bias_rad_s: _Axes = None
    gyro_sigma_stat_rad_s: _Axes = None
    gyro_sigma_use_rad_s: _Axes = None
    accel_bias_m_s2: _Axes = None
    accel_sigma_stat_m_s2: _Axes = None
    accel_sigma_use_m_s2: _Axes = None


class _Magnetic(msgspec.Struct, frozen=True):
    heading_bound_deg: _Number | None = None


class _Zero(msgspec.Struct, frozen=True):
    measured_at: str
    offset_deg: tuple[_Number, _Number]
    sigma_deg: _Number


class _Calibration(msgspec.Struct, frozen=True):
    state: Literal["done", "failed", "cancelled"]
    reason: str
    started_at: str
    duration_s: _Number
    imus: Annotated[list[_Imu], msgspec.Meta(max_length=64)]
    undone_at: str | None = None
    magnetic: _Magnetic | None = None
    alignment: _Zero | None = None


_ABOUT: Final = ("gyro_id", "accel_id", "temperature_degc", "samples")
_TRIADS: Final = tuple(name for name in _Imu.__struct_fields__ if name.endswith(("_rad_s", "_m_s2")))


def _calibration(body: bytes) -> Rows:
    told = msgspec.json.decode(body, type=_Calibration)
    biases: list[Row] = []
    for imu in {imu.name: imu for imu in told.imus}.values():
        about = {"imu": imu.name} | {name: getattr(imu, name) for name in _ABOUT}
        # Biases before earlier power-ups were weighed in; None: none were.
        gyro, accel = ((imu.prior or {}).get(triad) or _Found() for triad in TRIADS)
        triads = {name: getattr(imu, name) for name in _TRIADS}
        triads |= {"gyro_read_rad_s": gyro.measured_rad_s, "accel_read_m_s2": accel.measured_m_s2}
        for number, axis in enumerate("xyz"):
            figures = {name: value and value[number] for name, value in triads.items()}
            biases.append({**about, "axis": axis, **figures})
    held = [f"{imu.name} {triad}" for imu in told.imus for triad in imu.held_back]
    written = {name for imu in told.imus for name in imu.written}
    zero = told.alignment
    row = {
        "started_at": moment(told.started_at),
        "duration_s": told.duration_s,
        "state": told.state,
        "reason": told.reason,
        "held_back": ", ".join(held),
        "undone_at": _at(told.undone_at),
        "firmware": next((firmware for firmware, ranges in CALIBRATION.items() if written & ranges.keys()), None),
        "heading_bound_deg": told.magnetic and told.magnetic.heading_bound_deg,
        "zero_at": zero and moment(zero.measured_at),
        "zero_x_deg": zero and zero.offset_deg[0],
        "zero_y_deg": zero and zero.offset_deg[1],
        "zero_sigma_deg": zero and zero.sigma_deg,
    }
    return {"calibrations": [row], "biases": biases}


class _Arming(msgspec.Struct, frozen=True):
    armed_at: str
    state: _Word
    reason: str
    calibration: str | None
    gyro_sigma_use_rad_s: _Number | None = None
    accel_sigma_use_m_s2: _Number | None = None


def _arming(body: bytes) -> Rows:
    row = msgspec.structs.asdict(msgspec.json.decode(body, type=_Arming))
    of = row.pop("calibration")
    return {"armings": [{**row, "armed_at": moment(row["armed_at"]), "calibration_at": _at(of)}]}


class _Undo(msgspec.Struct, frozen=True):
    what: str
    of: str
    undone_at: str


def _undo(body: bytes) -> Rows:
    told = msgspec.json.decode(body, type=_Undo)
    return {"undos": [{"what": told.what, "of_at": moment(told.of), "undone_at": moment(told.undone_at)}]}


class _Alignment(msgspec.Struct, frozen=True):
    what: str
    state: _Word
    measured_at: str
    reason: str


def _alignment(body: bytes) -> Rows:
    row = msgspec.structs.asdict(msgspec.json.decode(body, type=_Alignment))
    return {"alignments": [{**row, "measured_at": moment(row["measured_at"])}]}


class _Event(msgspec.Struct, frozen=True):
    what: str


def _event(body: bytes) -> Rows:
    return {"events": [{"what": msgspec.json.decode(body, type=_Event).what, "body": body.decode()}]}


def _flight(body: bytes) -> Rows:
    flight = msgspec.json.decode(body, type=KeptFlight).flight
    rows: list[Row] = []
    for imu in flight.imus:
        flown = min(imu.drift.get("flown", ()), key=lambda each: abs(each.seconds - 30.0), default=None)
        which = {
            "flight": flight.key,
            "began_at": _at(flight.began_at),
            "instance": imu.imu,
            "gyro_id": imu.gyro_id,
            "accel_id": imu.accel_id,
            "calibration_at": _at(imu.calibration),
            "drift_s": flown and flown.seconds,
            "drift_m": flown and flown.median_m,
        }
        for split in imu.axes:
            triad, _, axis = split.axis.partition(" ")
            row: Row = {**which, "triad": triad[:16], "axis": axis[:1]}
            for name in ("in_flight", "turn_on", "motors"):
                term = getattr(split, name)
                row |= {name: term and term.value, f"{name}_sigma": term and term.sigma}
            rows.append(row)
    # The type of a flight has no limits of its own.
    for name, value in (each for row in rows for each in row.items()):
        if isinstance(value, int | float) and abs(value) > _MOST:
            raise NotTakenError(f"{name}: found {value:g}; allowed: up to {_MOST:g}")
    return {"flights": rows}


def _kept_raw(body: bytes) -> Rows:
    msgspec.json.decode(body, type=dict[str, Any])
    return {}


KINDS: Final[dict[str, Callable[[bytes], Rows]]] = {
    "calibration": _calibration,
    "arming": _arming,
    "undo": _undo,
    "alignment": _alignment,
    "event": _event,
    "profile": _kept_raw,
    "curve": _kept_raw,
    "flight": _flight,
}
"""Parsers of the bodies by kind; items of other kinds are kept until a newer companion knows them."""


def moment(words: str) -> datetime.datetime:
    """Parse a time of ISO 8601, in UTC unless it names another zone.

    Raises:
        NotTakenError: it is no time, or out of range.
    """
    try:
        found = datetime.datetime.fromisoformat(words)
        found = found.replace(tzinfo=datetime.UTC) if found.tzinfo is None else found.astimezone(datetime.UTC)
    except (ValueError, OverflowError):
        raise NotTakenError(f"found {words[:40]!r}; allowed: a time such as 2026-11-23T06:12:00.000Z") from None
    if not _EARLIEST <= found < _LATEST:
        raise NotTakenError(f"found {words[:40]!r}; allowed: a time from {_EARLIEST.year} to {_LATEST.year - 1}")
    return found


def _at(words: str | None) -> datetime.datetime | None:
    return None if words is None else moment(words)


def addressed(topic: str) -> tuple[str, str] | None:
    """Give the aircraft of a topic and "hello" or "item"; None: it is another topic."""
    match = _AIRCRAFT.fullmatch(topic)
    return None if match is None else (match[1], match[2])


def read_hello(aircraft: str, payload: bytes) -> Hello:
    """Parse a hello on that aircraft's topic.

    Raises:
        NotTakenError: it is none, names another aircraft, or has a newer format.
    """
    return _of(aircraft, _decode(payload, Hello))


def read_key(aircraft: str, payload: bytes) -> ItemKey:
    """Parse the key of an item on that aircraft's topic, of any format.

    Raises:
        NotTakenError: it has none, or names another aircraft.
    """
    if len(payload) > MOST_BYTES:
        raise NotTakenError(f"found {len(payload)} bytes; allowed: up to {MOST_BYTES}")
    return _of(aircraft, _decode(payload, ItemKey))


def read_item(item: ItemKey, payload: bytes) -> tuple[Row, Rows]:
    """Parse an item into its own columns and rows of other tables; `state` "unknown": a newer kind or format.

    Raises:
        NotTakenError: kind and format are known, but the body does not fit them.
    """
    if item.format_version != FORMAT_VERSION:
        return {"state": "unknown", "kind": None, "at": None, "clock": None, "same": None}, {}
    told = _decode(payload, _Told)
    columns: Row = {"kind": told.kind[:64], "at": moment(told.at), "clock": told.clock[:16], "same": None}
    if told.kind not in KINDS:
        return {**columns, "state": "unknown"}, {}
    try:
        rows = KINDS[told.kind](bytes(told.body))
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise NotTakenError(f"{told.kind}: {error}") from None
    for row in rows.get("events", ()):
        row["at"] = columns["at"]
    columns["same"] = _same(told, rows)
    return {**columns, "state": "taken"}, {table: [{**item.key, **row} for row in of] for table, of in rows.items()}


def ranges(sequences: Iterable[int]) -> list[list[int]]:
    """Combine numbers in any order into ranges from first to last, both included."""
    found: list[list[int]] = []
    for sequence in sorted(set(sequences)):
        if found and found[-1][1] == sequence - 1:
            found[-1][1] = sequence
        else:
            found.append([sequence, sequence])
    return found


def answers(epoch: str, found: list[list[int]]) -> list[bytes]:
    """Encode ranges as payloads of `confirmed` or `wanted`."""
    return [
        msgspec.json.encode(
            {"format_version": FORMAT_VERSION, "epoch": epoch, "sequences": found[start : start + MOST_RANGES]}
        )
        for start in range(0, len(found), MOST_RANGES)
    ]


def _decode(payload: bytes, kind: type[_Kind]) -> _Kind:
    try:
        return msgspec.json.decode(payload, type=kind)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise NotTakenError(str(error)) from None


def _of(aircraft: str, told: _Keyed) -> _Keyed:
    if told.aircraft != aircraft:
        raise NotTakenError(f"says that it is {told.aircraft}, on the topic of {aircraft}")
    return told


def _same(told: _Told, rows: Rows) -> str:
    """Hash everything that stays the same when an item is sent again under another epoch, so not `undone_at`."""
    content: Any = [(table, {**row, "undone_at": None}) for table in sorted(rows) for row in rows[table]]
    if not rows:
        content = msgspec.json.decode(told.body)
    told_again = msgspec.json.encode((told.kind, told.at, content), order="deterministic")
    return hashlib.sha256(told_again).hexdigest()[:32]
