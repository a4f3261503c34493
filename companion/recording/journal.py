"""The event loop's side of recording: what happens goes into a bounded queue, which a thread empties.

An entry is (topic, time, function, arguments): the function makes the message out of values that never change, in the
thread. What finds no room is lost together with what waited before it, since a gap in the middle cannot be replayed
across; the journal then begins anew with what is in force, and says how much was lost.

What events carry are plain values as MessagePack, exact to the last bit, infinities included. Signing keys are kept
out: the payload of MAVLink's SETUP_SIGNING, which autopilots forward to us when it is sent to all components, is
replaced by zeros. What is left of it fails its checksum in a replay.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from typing import Any, Final

import msgspec
import numpy as np

from companion.autopilot.firmware.imu_calibration import ImuCalibration
from companion.calibration.collector.rolling import RollingCollector
from companion.calibration.means.windows import ImuInput, Window
from companion.calibration.records.record import Record
from companion.calibration.solution.otherwise import NOTHING, Otherwise
from companion.calibration.solution.prior import Expectation
from companion.calibration.solution.site import Whereabouts
from companion.calibration.turning.watch import Turn
from companion.config.sections import Config
from companion.configured import models
from companion.links.system.listeners import Listeners
from companion.recording import topics
from companion.recording.topics import JournalEvent
from companion.samples import CompassSample, ImuSample, TiltSample

MOST_DETAIL_BYTES: Final = 1024 * 1024
"""The most bytes of one detail; ours have some thousand."""

Offsets = dict[str, ImuCalibration | None]


class Means(msgspec.Struct, frozen=True):
    """Means were taken of the still stretch."""

    number: int
    wander_deg: float | None
    """How far the heading has wandered since the aircraft last moved, which may be before the recording."""
    begun_s: dict[str, float]
    """By IMU, since when it has been on, which may be likewise."""
    turn: Turn
    """What was known of the platform's own rate, likewise."""


class Solved(msgspec.Struct, frozen=True, kw_only=True):
    """What a calibration was worked out from, besides the readings."""

    window: int | None
    refined: Window | None
    """The means that a dither found: they come of other readings than those of the window."""
    where: Whereabouts
    what: str
    offsets: Offsets
    alignment: tuple[float, float, float] | None
    """The gradienter's: offset x and y, and sigma, in degrees."""
    expectation: Expectation
    """What was known from before: it lies on the daemon's disk, and changes with every calibration."""
    otherwise: Otherwise = NOTHING
    """What filled in for a gradienter or a compass."""


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
"""The most entries that wait: some 15 s of a 200 Hz IMU beside 100 Hz telemetry, longer than a memory card stalls."""
MOST_BYTES: Final = 2 * 1024 * 1024
"""The most raw bytes among them; in JSON and packed they take seven times as much for a moment. 15 s of an IMU at 1 kHz
have 1.4 MB."""

Entry = tuple[str, float, Callable[..., bytes], tuple[Any, ...]]


_encode: Final = msgspec.json.encode


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
        self.items = [(topics.START, t_s, _encode, (topics.StartEntry(t_s, self.lost),))]
        self.items += [_event_entry(t_s, event, detail) for event, detail in self._in_force.values()]
        self.is_on, self.lost, self._bytes = True, 0, 0

    def end(self) -> None:
        """Nobody wants it any more."""
        self.is_on, self.lost, self._bytes, self.items = False, 0, 0, []

    def drain(self) -> list[Entry]:
        """Everything that waits, which then no longer does."""
        items, self.items, self._bytes = self.items, [], 0
        return items

    def raw(self, topic: str, t_s: float, data: bytes | None) -> None:
        """Bytes that came or went; None: some are missing here."""
        self._add((topic, t_s, _encode, (topics.RawBytes(t_s, data),)), len(data or b""))

    def imu(self, name: str, sample: ImuSample, message: str | None) -> None:
        """A sample that goes into the collector; `message` is the autopilot's that it came in."""
        self._add((topics.IMU + name, sample.t_s, topics.imu_json, (sample, message)))

    def tilt(self, sample: TiltSample) -> None:
        """A reading of the gradienter."""
        entry = topics.TiltEntry(sample.t_s, sample.x_deg, sample.y_deg, sample.temperature_degc)
        self._add((topics.GRADIENTER, sample.t_s, _encode, (entry,)))

    def compass(self, sample: CompassSample) -> None:
        """A heading."""
        entry = topics.CompassEntry(sample.t_s, sample.heading_deg, sample.pitch_deg, sample.roll_deg)
        self._add((topics.COMPASS, sample.t_s, _encode, (entry,)))

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


def _event_entry(t_s: float, event: topics.JournalEvent, detail: Any) -> Entry:
    return topics.JOURNAL, t_s, _event, (t_s, event, detail)


def _event(t_s: float, event: topics.JournalEvent, detail: Any) -> bytes:
    return _encode(topics.JournalEntry(t_s, event, None if detail is None else encode(detail)))


_ID: Final = (256).to_bytes(3, "little")
"""Message id of SETUP_SIGNING in a MAVLink 2 header; MAVLink 1 has no such id."""
_ID_AT: Final = 7
_HEADER: Final = 10
_MARKER: Final = 0xFD


class KeyFilter:
    """For one direction of one link; give it all bytes in their order."""

    def __init__(self) -> None:
        self._before = b""
        self._left = 0
        """Bytes of such a payload that are still to come."""

    def __call__(self, data: bytes) -> bytes:
        """The same bytes, without keys."""
        known = self._before + data
        self._before = known[1 - _HEADER :]
        if not self._left and _ID not in known:
            return data
        return self._blank(known, len(known) - len(data))

    def restart(self) -> None:
        """Some bytes are missing here."""
        self._before, self._left = b"", 0

    def _blank(self, known: bytes, behind: int) -> bytes:
        out = bytearray(known)
        end = behind + self._left
        out[behind:end] = bytes(min(self._left, len(out) - behind))
        place = known.find(_ID)
        while place >= 0:
            start = place - _ID_AT
            if start >= 0 and known[start] == _MARKER:
                payload, end_here = start + _HEADER, start + _HEADER + known[start + 1]
                out[payload:end_here] = bytes(max(0, min(end_here, len(out)) - payload))
                end = max(end, end_here)
            place = known.find(_ID, place + 1)
        self._left = max(0, end - len(known))
        return bytes(out[behind:])


WINDOWS_KEPT: Final = 240
"""Between a measurement and its solution a dither may lie, while others look at the readings once a second."""


class RecordedCollector(RollingCollector):
    """`RollingCollector` as the configuration has it, every call of which goes into a journal first."""

    def __init__(self, config: Config) -> None:
        self.journal = Journal()
        self.windows: deque[tuple[int, Window]] = deque(maxlen=WINDOWS_KEPT)
        """The latest windows of whole stretches, with their numbers."""
        self.seconds: Listeners[[]] = Listeners()
        """Told when every source has had its say on a second, from within whatever call brought that about: look
        later, not there."""
        self._messages: dict[str, str | None] = {}
        """By IMU, the autopilot's message that its samples come in."""
        self._windows_made = 0
        super().__init__(
            models.settings(config),
            [models.imu_input(imu, None) for imu in config.imu],
            models.gradienter_model(config.gradienter),
            models.compass_model(config.compass),
            on_deck=config.vehicle.platform == "deck",
        )

    def number_of(self, window: Window) -> int | None:
        """The number of a window that was made lately."""
        return next((number for number, each in self.windows if each is window), None)

    def add_imu(self, name: str, sample: ImuSample) -> None:  # noqa: D102 - as in the base class
        if self.journal.is_on:
            self.journal.imu(name, sample, self._messages.get(name))
        super().add_imu(name, sample)

    def add_tilt(self, sample: TiltSample) -> None:  # noqa: D102
        self.journal.tilt(sample)
        super().add_tilt(sample)

    def _take_heading(self, sample: CompassSample) -> None:
        self.journal.compass(sample)
        super()._take_heading(sample)

    def _evaluate(self) -> None:
        before = self._next
        super()._evaluate()
        if self._next != before:
            self.seconds.tell()

    def set_imu(self, imu: ImuInput, message: str | None = None) -> None:
        """As in the base class; `message` is the autopilot's that its samples come in, None for one of our own."""
        self._messages[imu.name] = message
        self.journal.set_in_force(self._loop_s(), "imu", imu)
        super().set_imu(imu)

    def expect(self, *, gradienter: bool, compass: bool) -> None:  # noqa: D102
        self.journal.set_in_force(self._loop_s(), "expect", (gradienter, compass))
        super().expect(gradienter=gradienter, compass=compass)

    def reset(self, why: str, imu: str | None = None) -> None:  # noqa: D102
        self.journal.event(self._loop_s(), "reset", (why, imu))
        super().reset(why, imu)

    def _loop_s(self) -> float:
        """Before the journal begins, when nothing of this is written with its time, there may be no loop yet."""
        return asyncio.get_running_loop().time() if self.journal.is_on else 0.0

    def tick(self, now_s: float) -> None:  # noqa: D102
        self.journal.event(now_s, "tick")
        super().tick(now_s)

    def window(self, now_s: float, *, since_s: float | None = None) -> Window:  # noqa: D102
        if since_s is not None:
            # A look at what a write has done: nothing is estimated from it.
            return super().window(now_s, since_s=since_s)
        self._windows_made += 1
        number = self._windows_made
        self.journal.event(now_s, "window", Means(number, self.wander_deg, self.begun_s, self.turn))
        window = super().window(now_s)
        self.windows.append((number, window))
        return window
