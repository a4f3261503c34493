"""The event loop's side of recording: what happens goes into a bounded queue, which a thread empties.

An entry is (topic, time, function, arguments): the function makes the message out of values that never change, in the
thread. What finds no room is lost together with what waited before it, since a gap in the middle cannot be replayed
across; the journal then begins anew with what is in force, and says how much was lost.

What events carry are plain values as MessagePack, exact to the last bit, infinities included.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import msgspec
import numpy as np

from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.calibration.means.windows import ImuInput, Window
from companion.calibration.solution.prior import Expectation
from companion.calibration.solution.record import Record
from companion.calibration.solution.site import Whereabouts
from companion.recording import topics
from companion.recording.topics import JournalEvent
from companion.samples import CompassSample, ImuSample, TiltSample

MOST_DETAIL_BYTES: Final = 1024 * 1024
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
    if data is None or len(data) > MOST_DETAIL_BYTES:
        raise ValueError(f"found {data and len(data)} bytes of detail; allowed: {MOST_DETAIL_BYTES}")
    return msgspec.msgpack.decode(data, type=_TYPES[event], dec_hook=_array)


MOST_ENTRIES: Final = 12_000
"""Some 15 s of a 200 Hz IMU beside 100 Hz telemetry: longer than a memory card stalls."""
MOST_BYTES: Final = 4 * 1024 * 1024
"""Of raw bytes among them."""

Entry = tuple[str, float, Callable[..., bytes], tuple[Any, ...]]


class Journal:
    """What happens, as far as somebody wants it."""

    def __init__(self) -> None:
        self.is_on = False
        """Whether it is kept; what is in force is in any case."""
        self.lost = 0
        """Entries that were dropped since it began; while there are any, nothing is taken."""
        self.lost_in_all = 0
        self.items: list[Entry] = []
        self._bytes = 0
        self._in_force: dict[str, tuple[topics.JournalEvent, Any]] = {}

    def begin(self, t_s: float) -> None:
        """From here on it can be replayed."""
        self.items = [(topics.START, t_s, _start, (t_s, self.lost))]
        self.items += [_event_entry(t_s, event, detail) for event, detail in self._in_force.values()]
        self.is_on, self.lost, self._bytes = True, 0, 0

    def end(self) -> None:
        """Nobody wants it any more."""
        self.is_on, self.lost, self._bytes, self.items = False, 0, 0, []

    def take(self) -> list[Entry]:
        """Everything that waits, which then no longer does."""
        items, self.items, self._bytes = self.items, [], 0
        return items

    def raw(self, topic: str, t_s: float, data: bytes | None) -> None:
        """Bytes that came or went; None: some are missing here."""
        self._add((topic, t_s, _raw, (t_s, data)), len(data or b""))

    def imu(self, name: str, sample: ImuSample, message: str | None) -> None:
        """A sample that goes into the collector; `message` is the autopilot's that it came in."""
        self._add((topics.IMU + name, sample.t_s, topics.imu_json, (sample, message)))

    def tilt(self, sample: TiltSample) -> None:
        """A reading of the gradienter."""
        self._add((topics.GRADIENTER, sample.t_s, topics.tilt_json, (sample,)))

    def compass(self, sample: CompassSample) -> None:
        """A heading."""
        self._add((topics.COMPASS, sample.t_s, topics.compass_json, (sample,)))

    def event(self, t_s: float, event: topics.JournalEvent, detail: Any = None) -> None:
        """What is about to be done with the collector; `detail` never changes."""
        self._add(_event_entry(t_s, event, detail))

    def set_in_force(self, t_s: float, event: topics.JournalEvent, detail: Any) -> None:
        """The same of what holds until the next such event, and a recording that begins later has to know."""
        self._in_force[in_force_key(event, detail)] = event, detail
        self.event(t_s, event, detail)

    def record(self, record: Record, t_s: float) -> None:
        """A calibration has ended."""
        self._add((topics.RECORD, t_s, topics.record_json, (record, t_s)))

    def _add(self, entry: Entry, size: int = 0) -> None:
        if not self.is_on:
            return
        if self.lost:
            self._lose(1)
        elif len(self.items) >= MOST_ENTRIES or self._bytes + size > MOST_BYTES:
            self._lose(len(self.items) + 1)
            self.items.clear()
            self._bytes = 0
        else:
            self._bytes += size
            self.items.append(entry)

    def _lose(self, number: int) -> None:
        self.lost += number
        self.lost_in_all += number


def in_force_key(event: topics.JournalEvent, detail: Any) -> str:
    """What such an event replaces when it comes again."""
    return f"imu {detail.name}" if event == "imu" else event


def _start(t_s: float, lost: int) -> bytes:
    return msgspec.json.encode(topics.StartEntry(t_s, lost))


def _raw(t_s: float, data: bytes | None) -> bytes:
    return msgspec.json.encode(topics.RawBytes(t_s, data))


def _event_entry(t_s: float, event: topics.JournalEvent, detail: Any) -> Entry:
    return topics.JOURNAL, t_s, _event, (t_s, event, detail)


def _event(t_s: float, event: topics.JournalEvent, detail: Any) -> bytes:
    return msgspec.json.encode(topics.JournalEntry(t_s, event, None if detail is None else encode(detail)))
