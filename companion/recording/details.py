"""What the events of the journal carry: plain values as MessagePack, exact to the last bit, infinities included."""

from __future__ import annotations

from typing import Any, Final

import msgspec
import numpy as np

from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.calibration.means.windows import ImuInput, Window
from companion.calibration.solution.prior import Expectation
from companion.calibration.solution.site import Whereabouts
from companion.recording.topics import JournalEvent

MOST_BYTES: Final = 1024 * 1024
"""Of one detail; ours have some thousand."""

Offsets = dict[str, ImuCalibration | None]


class Means(msgspec.Struct, frozen=True):
    """Means were taken of the still stretch."""

    number: int
    wander_deg: float | None
    """How far the heading has wandered since the aircraft last moved, which may be before the recording."""


class Solved(msgspec.Struct, frozen=True, kw_only=True):
    """What a calibration was worked out from, besides the readings."""

    window: int | None
    """The number of its means."""
    refined: Window | None
    """The means that a dither found: they come of other readings than those of the window."""
    where: Whereabouts
    what: str
    offsets: Offsets
    alignment: tuple[float, float, float] | None
    """The gradienter's: offset x and y, and sigma, in degrees."""
    expectation: Expectation
    """What was known from before: it lies on the daemon's disk, and changes with every calibration."""


_TYPES: Final[dict[JournalEvent, Any]] = {
    "window": Means,
    "reset": tuple[str, str | None],
    "imu": ImuInput,
    "expect": tuple[bool, bool],
    "place": Whereabouts,
    "offsets": Offsets,
    "solved": Solved,
}


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a {type(value).__name__} is not known to recordings")


def _array(kind: Any, plain: Any) -> Any:
    return np.array(plain, dtype=np.float64)


def encode(detail: Any) -> bytes:
    """A detail of an event."""
    return msgspec.msgpack.encode(detail, enc_hook=_plain)


def decode(event: JournalEvent, data: bytes | None) -> Any:
    """The detail of an event of that kind.

    Raises:
        ValueError: it is nothing that this version could have written.
    """
    if data is None or len(data) > MOST_BYTES:
        raise ValueError(f"found {data and len(data)} bytes of detail; allowed: {MOST_BYTES}")
    return msgspec.msgpack.decode(data, type=_TYPES[event], dec_hook=_array)
