"""The state of the collector and of the decoders as JSON, exactly, so that a recording may begin at any time.

Two steps, so that the event loop pays little: `freeze` copies what changes and keeps what never does; `to_json` does
the rest wherever there is time. Only classes named here are written or made from a file: reading a recording runs
nothing of what it says.
"""

from __future__ import annotations

import base64
import dataclasses
import datetime
import math
from collections import Counter, deque
from collections.abc import Callable
from typing import Any, Final

import msgspec
import numpy as np

from companion.autopilot.firmware.imu_calibration import FarStep, ImuCalibration, ImuParameters
from companion.autopilot.firmware.rivals import Rival
from companion.calibration.collector.rolling import RollingCollector
from companion.calibration.collector.sources import Source
from companion.calibration.collector.stop import Settings
from companion.calibration.collector.trace import TraceLog
from companion.calibration.means.estimates import Estimates
from companion.calibration.means.field_heading import FieldHeading
from companion.calibration.means.pose_models import CompassModel, GradienterModel
from companion.calibration.means.pose_windows import FieldWindow, HeadingWindow, TiltWindow
from companion.calibration.means.windows import Hidden, ImuInput, ImuWindow, Window
from companion.calibration.noise.allan import AllanModel, NoiseProfile
from companion.calibration.seconds.batches import Batch, BatchSource, Counts
from companion.calibration.solution.pose_effect import PoseEffect
from companion.calibration.solution.prior import Expectation, Expected, ExpectedImu
from companion.calibration.solution.site import Whereabouts
from companion.calibration.stillness.gates import ImuGate, PoseGate, Verdict
from companion.calibration.stillness.heading_watch import HeadingWatch
from companion.calibration.stillness.settling import Lag, Settling
from companion.calibration.stillness.stretch import Stretch
from companion.errors import StorageError
from companion.protocols.decoding.clock import DeviceClock, SampleTimes
from companion.protocols.registry import PROTOCOLS

_CHANGING: Final[dict[str, type]] = {
    each.__name__: each
    for each in (
        RollingCollector,
        Source,
        BatchSource,
        FieldHeading,
        HeadingWatch,
        ImuGate,
        PoseGate,
        Settling,
        Stretch,
        DeviceClock,
        SampleTimes,
        *(info.decoder for kind in PROTOCOLS.values() for info in kind.values()),
    )
}
"""Objects whose attributes change."""

_VALUES: Final[dict[str, type]] = {
    each.__name__: each
    for each in (
        AllanModel,
        Batch,
        CompassModel,
        Counts,
        Expectation,
        Expected,
        ExpectedImu,
        FarStep,
        FieldWindow,
        GradienterModel,
        HeadingWindow,
        Hidden,
        ImuCalibration,
        ImuInput,
        ImuParameters,
        ImuWindow,
        Lag,
        NoiseProfile,
        PoseEffect,
        Rival,
        Settings,
        TiltWindow,
        Verdict,
        Whereabouts,
        Window,
    )
}
"""Values that never change once made."""

# What is only remembered to save work or to be drawn later: (class, attribute) and what makes it anew.
_FORGOTTEN: Final[dict[tuple[str, str], Callable[[], Any]]] = {
    ("RollingCollector", "_estimates"): Estimates,
    ("RollingCollector", "_trace"): TraceLog,
    ("ImuGate", "_means"): lambda: None,
    ("ImuGate", "_ordered"): lambda: None,
    ("PoseGate", "_refined"): lambda: None,
    ("VectorNavDecoder", "_layouts"): dict,
}
_DEEPEST: Final = 40
_MOST_VALUES: Final = 1_000_000
"""An hour of three IMUs has 200 000."""
_LEAST_ROW_BYTES: Final = 8
"""Of a stack, each row of which becomes an array: without it, nothing at all would become a billion of them."""
_LONGEST_TYPE: Final = 8
_UNREADABLE: Final = (
    msgspec.MsgspecError, ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError,
)  # fmt: skip


@dataclasses.dataclass(frozen=True, slots=True)
class _Frozen:
    """An object that changes, as it was."""

    name: str
    attributes: dict[str, Any]


def freeze(value: Any, as_class: type | None = None) -> Any:
    """A copy that later changes do not reach; values that never change are kept as they are.

    Args:
        value: an object of a known class, a container, or a plain value.
        as_class: written as this class, whose attributes it has and perhaps more.
    """
    if isinstance(value, dict):
        return type(value)({key: freeze(item) for key, item in value.items()})
    if isinstance(value, deque):
        return deque(map(freeze, value), value.maxlen)
    if isinstance(value, list):
        return list(map(freeze, value))
    kind = as_class or type(value)
    if _CHANGING.get(kind.__name__) is not kind:
        return value
    more: frozenset[str] = getattr(value, "not_state", frozenset())
    attributes = {
        name: freeze(item)
        for name, item in vars(value).items()
        if (kind.__name__, name) not in _FORGOTTEN and name not in more
    }
    return _Frozen(kind.__name__, attributes)


def to_json(frozen: Any) -> bytes:
    """What `freeze` gave, as JSON."""
    return msgspec.json.encode(_plain(frozen))


def from_json(data: bytes | str) -> Any:
    """The objects behind what `to_json` gave, each with its own state.

    Raises:
        StorageError: it is nothing that this version could have written.
    """
    try:
        if data.count("," if isinstance(data, str) else b",") >= _MOST_VALUES:  # type: ignore[arg-type]
            raise ValueError(f"more than {_MOST_VALUES} values")
        return _made(msgspec.json.decode(data), _DEEPEST)
    except _UNREADABLE as error:
        raise StorageError(f"the state in the recording is of another version or damaged ({error})") from None


def _plain(value: Any) -> Any:
    kind = type(value)
    if value is None or kind in (bool, str, int):
        return value
    if kind is float:
        return value if math.isfinite(value) else {"$": "float", "text": repr(value)}
    if kind is list:
        return _plain_list(value)
    if isinstance(value, np.generic):
        return {"$": "scalar", "type": value.dtype.str, "data": base64.b64encode(value.tobytes()).decode()}
    if isinstance(value, np.ndarray):
        data = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode()
        return {"$": "array", "type": value.dtype.str, "shape": list(value.shape), "data": data}
    if isinstance(value, _Frozen):
        return {"$": value.name, "is": {name: _plain(item) for name, item in value.attributes.items()}}
    return _plain_container(value)


def _plain_list(values: list[Any]) -> Any:
    """As columns where that goes: there are hundreds of batches, of some ten arrays each."""
    kind = type(values[0]) if len(values) > 1 else None
    if kind is np.ndarray:
        first = values[0]
        if first.nbytes >= _LEAST_ROW_BYTES and all(
            type(v) is np.ndarray and v.shape == first.shape and v.dtype == first.dtype for v in values
        ):
            return {"$": "stack", "of": _plain(np.stack(values))}
    if kind is not None and kind.__name__ in _VALUES and all(type(value) is kind for value in values):
        columns = {name: _plain_list([getattr(value, name) for value in values]) for name in _names(values[0])}
        return {"$": "columns", "name": kind.__name__, "is": columns}
    return [_plain(item) for item in values]


def _plain_container(value: Any) -> Any:
    if isinstance(value, tuple):
        return {"$": "tuple", "of": _plain_list(list(value))}
    if isinstance(value, deque):
        return {"$": "deque", "longest": value.maxlen, "of": _plain_list(list(value))}
    if isinstance(value, dict):
        name = "counter" if isinstance(value, Counter) else "dict"
        return {"$": name, "keys": _plain_list(list(value)), "of": _plain_list(list(value.values()))}
    if isinstance(value, bytes):
        return {"$": "bytes", "data": base64.b64encode(value).decode()}
    if isinstance(value, datetime.date):
        return {"$": "date", "text": value.isoformat()}
    name = type(value).__name__
    if _VALUES.get(name) is not type(value):
        raise TypeError(f"a {name} is not known to recordings")
    return {"$": name, "is": {each: _plain(getattr(value, each)) for each in _names(value)}}


def _names(value: Any) -> tuple[str, ...]:
    """The fields of a structure."""
    if isinstance(value, msgspec.Struct):
        return value.__struct_fields__
    return tuple(field.name for field in dataclasses.fields(value))


def _made(plain: Any, depth: int) -> Any:
    if depth == 0:
        raise ValueError("too deep")
    if isinstance(plain, list):
        return [_made(item, depth - 1) for item in plain]
    if not isinstance(plain, dict):
        return plain
    name = plain["$"]
    if name in _SIMPLE:
        return _SIMPLE[name](plain)
    if name in _MANY:
        return _MANY[name](plain, _listed(plain["of"], depth - 1), depth)
    if name == "columns":
        fields = {key: _listed(item, depth - 1) for key, item in plain["is"].items()}
        kind, rows = _VALUES[plain["name"]], zip(*fields.values(), strict=True)
        return [kind(**dict(zip(fields, row, strict=True))) for row in rows]
    if name == "stack":
        stack = _made(plain["of"], depth - 1)
        if stack.nbytes < _LEAST_ROW_BYTES * len(stack):
            raise ValueError("a stack of next to nothing")
        # Copies: each is an array of its own.
        return [each.copy() for each in stack]
    fields = {key: _made(item, depth - 1) for key, item in plain["is"].items()}
    if name in _VALUES:
        return _VALUES[name](**fields)
    made: Any = object.__new__(_CHANGING[name])
    for (owner, attribute), empty in _FORGOTTEN.items():
        if owner == name:
            setattr(made, attribute, empty())
    for attribute, item in fields.items():
        setattr(made, attribute, item)
    return made


def _pairs(plain: dict[str, Any], of: list[Any], depth: int) -> dict[Any, Any]:
    return dict(zip(_listed(plain["keys"], depth - 1), of, strict=True))


def _listed(plain: Any, depth: int) -> list[Any]:
    """What is many values: written one by one, as columns or as a stack."""
    made = _made(plain, depth)
    if not isinstance(made, list):
        raise TypeError(f"a list was expected, not a {type(made).__name__}")
    return made


_MANY: Final[dict[str, Callable[[dict[str, Any], Any, int], Any]]] = {
    "tuple": lambda plain, of, depth: tuple(of),
    "deque": lambda plain, of, depth: deque(of, plain["longest"]),
    "dict": _pairs,
    "counter": lambda plain, of, depth: Counter(_pairs(plain, of, depth)),
}


def _array(plain: dict[str, Any]) -> Any:
    # A copy: what is made from a buffer could not be written to.
    return np.frombuffer(_bytes(plain), _numeric(plain["type"])).reshape(plain["shape"]).copy()


def _numeric(name: str) -> Any:
    kind: Any = np.dtype(name) if len(name) <= _LONGEST_TYPE else None
    if kind is None or kind.kind not in "biuf":
        raise ValueError(f"no numbers: {name[:_LONGEST_TYPE]}")
    return kind


def _bytes(plain: dict[str, Any]) -> bytes:
    return base64.b64decode(plain["data"], validate=True)


_SIMPLE: Final[dict[str, Any]] = {
    "array": _array,
    "scalar": lambda plain: np.frombuffer(_bytes(plain), _numeric(plain["type"]))[0],
    "float": lambda plain: float(plain["text"]),
    "bytes": _bytes,
    "date": lambda plain: datetime.date.fromisoformat(plain["text"]),
}
