"""What a recording holds: topics, the JSON of their messages, and the JSON schemas of these.

Foxglove takes a schema only where every field has one plain type, and no array lies in another; so what is unknown is
left out of a message instead of being null, and what has no such form is a JSON text in a field of its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, Literal

import msgspec

from companion.calibration.solution.record import ImuRecord, Record, to_json
from companion.samples import CompassSample, ImuSample, TiltSample

FORMAT_VERSION: Final = "2"
METADATA: Final = "companion"
"""Name of the metadata record with versions and times."""
CONFIG: Final = "configuration.json"
"""Name of the attachment with the configuration in force."""
START, JOURNAL, RECORD = "/companion/start", "/companion/journal", "/companion/record"
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
    detail: bytes = b""
    """As `details.encode` made it; what it is depends on the event."""


class StartEntry(msgspec.Struct, frozen=True, gc=False):
    """The recording begins here, and what follows is replayed from nothing."""

    t_s: float
    """What happened before that is the past, which it begins with."""
    lost: int
    """Messages that were dropped right before, because the disk did not keep up."""


class RecordEntry(msgspec.Struct, frozen=True, gc=False):
    """The exact record out of a message on the record's topic."""

    t_s: float
    record: str


def imu_json(sample: ImuSample, message: str | None) -> bytes:
    """One IMU sample; readings with nine digits, which every float32 keeps."""
    text = (
        f'{{"t_s":{sample.t_s!r},"gyro_rad_s":{_nine(sample.gyro_rad_s)},"accel_m_s2":{_nine(sample.accel_m_s2)}'
        + (f',"temperature_degc":{sample.temperature_degc!r}' if _known(sample.temperature_degc) else "")
        + (f',"sequence":{sample.sequence}' if sample.sequence is not None else "")
        + (f',"t_device_s":{sample.t_device_s!r}' if _known(sample.t_device_s) else "")
        + (f',"message":"{message}"' if message is not None else "")
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


def tilt_json(sample: TiltSample) -> bytes:
    """One reading of the gradienter."""
    fields = {"t_s": sample.t_s, "x_deg": sample.x_deg, "y_deg": sample.y_deg}
    return msgspec.json.encode(_without_none({**fields, "temperature_degc": sample.temperature_degc}))


def compass_json(sample: CompassSample) -> bytes:
    """One heading."""
    fields = {"t_s": sample.t_s, "heading_deg": sample.heading_deg}
    return msgspec.json.encode(_without_none({**fields, "pitch_deg": sample.pitch_deg, "roll_deg": sample.roll_deg}))


def record_json(record: Record, t_s: float) -> bytes:
    """A record: its figures as far as a schema can hold them, and the whole of it as a text."""
    plain = msgspec.to_builtins(record)
    view = {key: plain[key] for key in ("state", "reason", "warnings", "started_at", "duration_s", "system_id")}
    view["pose"], view["site"] = plain["pose"] or {}, plain["site"] or {}
    view["magnetic"] = plain["magnetic"]
    view["imus"] = [{key: item for key, item in _imu(imu).items() if item is not None} for imu in record.imus]
    return msgspec.json.encode(_without_none({"t_s": t_s, **view, "record": to_json(record).decode()}))


def is_finite(values: Sequence[float]) -> bool:
    """Whether JSON can hold these."""
    return all(map(math.isfinite, values))


def _nine(values: Sequence[float]) -> str:
    return f"[{','.join([f'{value:.9g}' for value in values])}]"


def _known(value: float | None) -> bool:
    return value is not None and math.isfinite(value)


def _without_none(fields: dict[str, Any]) -> dict[str, Any]:
    return {
        key: _without_none(item) if isinstance(item, dict) else item for key, item in fields.items() if item is not None
    }


def _imu(imu: ImuRecord) -> dict[str, Any]:
    return {
        "name": imu.name,
        "samples": imu.samples,
        "temperature_degc": imu.temperature_degc,
        **{key: getattr(imu, key) for key in _TRIADS},
        "warnings": list(imu.warnings),
        "written": list(imu.written),
    }


# --- schemas

_NUMBER: Final = {"type": "number"}
_INTEGER: Final = {"type": "integer"}
_TEXT: Final = {"type": "string"}
_BASE64: Final = {"type": "string", "contentEncoding": "base64"}
_TRIAD: Final = {"type": "array", "items": _NUMBER, "minItems": 3, "maxItems": 3}
_TEXTS: Final = {"type": "array", "items": _TEXT}
_TRIADS: Final = (
    "gyro_bias_rad_s",
    "gyro_sigma_stat_rad_s",
    "gyro_sigma_use_rad_s",
    "accel_bias_m_s2",
    "accel_sigma_stat_m_s2",
    "accel_sigma_use_m_s2",
    "residual_gyro_rad_s",
    "residual_accel_m_s2",
)


def _object(required: str, **properties: Any) -> dict[str, Any]:
    return {
        "type": "object",
        "properties": properties,
        "required": required.split(),
        "additionalProperties": False,
    }


SCHEMAS: Final[dict[str, dict[str, Any]]] = {
    "companion.RawBytes": _object("t_s", t_s=_NUMBER, data=_BASE64),
    "companion.Imu": _object(
        "t_s gyro_rad_s accel_m_s2",
        t_s=_NUMBER,
        gyro_rad_s=_TRIAD,
        accel_m_s2=_TRIAD,
        temperature_degc=_NUMBER,
        sequence=_INTEGER,
        t_device_s=_NUMBER,
        message=_TEXT,
    ),
    "companion.Gradienter": _object(
        "t_s x_deg y_deg", t_s=_NUMBER, x_deg=_NUMBER, y_deg=_NUMBER, temperature_degc=_NUMBER
    ),
    "companion.Compass": _object(
        "t_s heading_deg", t_s=_NUMBER, heading_deg=_NUMBER, pitch_deg=_NUMBER, roll_deg=_NUMBER
    ),
    "companion.Journal": _object("t_s event", t_s=_NUMBER, event=_TEXT, detail=_BASE64),
    "companion.Start": _object("t_s lost", t_s=_NUMBER, lost=_INTEGER),
    "companion.Record": _object(
        "t_s state reason warnings started_at duration_s imus record",
        t_s=_NUMBER,
        state=_TEXT,
        reason=_TEXT,
        warnings=_TEXTS,
        started_at=_TEXT,
        duration_s=_NUMBER,
        system_id=_INTEGER,
        pose=_object(
            "",
            theta_deg=_NUMBER,
            gamma_deg=_NUMBER,
            psi_deg=_NUMBER,
            sigma_deg=_object("", theta=_NUMBER, gamma=_NUMBER, psi=_NUMBER),
        ),
        site=_object(
            "",
            latitude_deg=_NUMBER,
            height_m=_NUMBER,
            gravity_m_s2=_NUMBER,
            declination_deg=_NUMBER,
            source=_TEXT,
        ),
        magnetic=_object(
            "",
            heading_bound_deg=_NUMBER,
            heading_from=_TEXT,
            field_gauss=_NUMBER,
            field_expected_gauss=_NUMBER,
            inclination_deg=_NUMBER,
            inclination_expected_deg=_NUMBER,
            device_minus_field_deg=_NUMBER,
            wander_deg=_NUMBER,
        ),
        imus={
            "type": "array",
            "items": _object(
                "name samples warnings written",
                name=_TEXT,
                samples=_INTEGER,
                temperature_degc=_NUMBER,
                **dict.fromkeys(_TRIADS, _TRIAD),
                warnings=_TEXTS,
                written=_TEXTS,
            ),
        },
        record=_TEXT,
    ),
}


def schema_of(topic: str) -> str:
    """The name of a topic's schema."""
    known = {
        START: "companion.Start",
        JOURNAL: "companion.Journal",
        RECORD: "companion.Record",
        GRADIENTER: "companion.Gradienter",
        COMPASS: "companion.Compass",
    }
    return known.get(topic) or ("companion.Imu" if topic.startswith(IMU) else "companion.RawBytes")
