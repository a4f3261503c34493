"""What a recording holds: topics, the JSON of their messages, and the JSON schemas of these.

Foxglove takes a schema only where every field has one plain type, and no array lies in another; so what is unknown is
left out of a message instead of being null, and what has no such form is a JSON text in a field of its own.
"""

from __future__ import annotations

import math
import types
from collections.abc import Sequence
from typing import Any, Final, Literal, get_args, get_origin, get_type_hints

import msgspec

from companion.calibration.records.record import Record, to_json
from companion.samples import ImuSample

FORMAT_VERSION: Final = "3"
METADATA: Final = "companion"
"""Name of the metadata record with versions and times."""
CONFIG: Final = "configuration.json"
"""Name of the attachment with the configuration in force."""
START, PAST, JOURNAL, RECORD = "/companion/start", "/companion/past", "/companion/journal", "/companion/record"
MAVLINK_IN, MAVLINK_OUT = "/mavlink/in", "/mavlink/out"
SERIAL, IMU = "/serial/", "/imu/"
"""Topics of raw bytes and of samples begin so; the device's or the IMU's name follows."""
GRADIENTER, COMPASS = "/gradienter", "/compass"

JournalEvent = Literal["tick", "window", "reset", "imu", "expect", "place", "offsets", "solved"]


class RawBytes(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """Bytes as they came or went; without `data`: bytes are missing here, the port was opened again."""

    t_s: float
    data: bytes | None = None


class JournalEntry(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """What was done with the collector, in the order in which it was."""

    t_s: float
    event: JournalEvent
    detail: bytes | None = None
    """As `journal.encode` made it; what it is depends on the event."""


class StartEntry(msgspec.Struct, frozen=True, gc=False):
    """The recording begins here, and what follows is replayed from nothing."""

    t_s: float
    """What happened before that is the past, which it begins with."""
    lost: int
    """Messages that were dropped right before, because the disk did not keep up."""


class PastEntry(msgspec.Struct, frozen=True, gc=False):
    """A second before the recording, as far as a replay needs it."""

    t_s: float
    """Its end."""
    packed: bytes
    """[[topic, t_s, data], ...] as MessagePack, compressed by zstd."""


class TiltEntry(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """One reading of the gradienter."""

    t_s: float
    x_deg: float
    y_deg: float
    temperature_degc: float | None = None


class CompassEntry(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """One heading."""

    t_s: float
    heading_deg: float
    pitch_deg: float | None = None
    roll_deg: float | None = None


class RecordEntry(msgspec.Struct, frozen=True, gc=False):
    """A calibration has ended."""

    t_s: float
    record: str
    """The whole of it, as JSON."""


def imu_json(sample: ImuSample, message: str | None) -> bytes:
    """One IMU sample; readings with nine digits, which every float32 keeps."""
    text = (
        f'{{"t_s":{sample.t_s!r},"gyro_rad_s":{_nine(sample.gyro_rad_s)},"accel_m_s2":{_nine(sample.accel_m_s2)}'
        + (f',"temperature_degc":{sample.temperature_degc!r}' if _known(sample.temperature_degc) else "")
        + (f',"sequence":{sample.sequence}' if sample.sequence is not None else "")
        + (f',"t_device_s":{sample.t_device_s!r}' if _known(sample.t_device_s) else "")
        + (f',"message":"{message}"' if message is not None else "")
        + (f',"shared_variance":{list(sample.shared_variance)!r}' if sample.shared_variance is not None else "")
    )
    return f"{text}}}".encode()


class ImuEntry(msgspec.Struct, frozen=True, gc=False):
    """What `imu_json` gave, read back."""

    t_s: float
    gyro_rad_s: tuple[float, float, float]
    accel_m_s2: tuple[float, float, float]
    temperature_degc: float | None = None
    sequence: int | None = None
    t_device_s: float | None = None
    message: str | None = None
    shared_variance: tuple[float, ...] | None = None


def record_json(record: Record, t_s: float) -> bytes:
    """A record."""
    return msgspec.json.encode(RecordEntry(t_s, to_json(record).decode()))


def _nine(values: Sequence[float]) -> str:
    return f"[{','.join([f'{value:.9g}' for value in values])}]"


def _known(value: float | None) -> bool:
    return value is not None and math.isfinite(value)


# --- schemas


def _schema(kind: Any) -> dict[str, Any]:
    """Of a type, in the few words that Foxglove knows."""
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        hints = get_type_hints(kind)
        return {
            "type": "object",
            "properties": {name: _schema(hint) for name, hint in hints.items()},
            "required": [name for name, hint in hints.items() if type(None) not in get_args(hint)],
            "additionalProperties": False,
        }
    parts = [part for part in get_args(kind) if part is not type(None)]
    if get_origin(kind) is tuple:
        length = {} if Ellipsis in parts else {"minItems": len(parts), "maxItems": len(parts)}
        return {"type": "array", "items": _schema(parts[0]), **length}
    if kind in _PLAIN:
        return _PLAIN[kind]
    return _schema(parts[0] if parts and isinstance(kind, types.UnionType) else str)


_PLAIN: Final[dict[Any, dict[str, Any]]] = {
    float: {"type": "number"},
    int: {"type": "integer"},
    str: {"type": "string"},
    bytes: {"type": "string", "contentEncoding": "base64"},
}
_KINDS: Final[dict[str, type[msgspec.Struct]]] = {
    START: StartEntry,
    PAST: PastEntry,
    JOURNAL: JournalEntry,
    RECORD: RecordEntry,
    GRADIENTER: TiltEntry,
    COMPASS: CompassEntry,
}


def schema_of(topic: str) -> tuple[str, dict[str, Any]]:
    """The name of a topic's schema, and the schema."""
    kind = _KINDS.get(topic) or (ImuEntry if topic.startswith(IMU) else RawBytes)
    return f"companion.{kind.__name__.removesuffix('Entry')}", _schema(kind)
