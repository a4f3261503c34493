"""The event loop's side of recording: what happens goes into bounded queues, which a thread empties.

An entry is (topic, time, function, arguments): the function makes the message out of values that never change, in the
thread. What finds no room is lost together with what waited before it, since a gap in the middle cannot be replayed
across; the next entry is then a `Beginning` with the whole state again, which says how much was lost.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Final

import msgspec

from companion.calibration.solution.record import Record
from companion.recording import topics
from companion.recording.state import to_json
from companion.samples import CompassSample, ImuSample, TiltSample

MOST_ENTRIES: Final = 12_000
"""Some 15 s of a 200 Hz IMU beside 100 Hz telemetry: longer than a memory card stalls."""
MOST_BYTES: Final = 4 * 1024 * 1024
"""Of raw bytes among them."""

Entry = tuple[str, float, Callable[..., bytes], tuple[Any, ...]]


@dataclasses.dataclass(frozen=True, slots=True)
class Beginning:
    """Everything that a replay has to know when it starts here."""

    t_s: float
    unix_s: float
    """The host's clock at `t_s`."""
    versions: dict[str, str]
    config: bytes
    """JSON."""
    state: Any
    """As `freeze` gave it."""
    lost: int = 0


class Queue:
    """What waits for one file."""

    def __init__(self) -> None:
        self.items: list[Entry | Beginning] = []
        self.lost = 0
        """Entries that were dropped since the last beginning; while there are any, nothing is taken."""
        self.lost_in_all = 0
        self._bytes = 0

    def begin(self, beginning: Beginning) -> None:
        """From here on it can be replayed."""
        self.items.append(dataclasses.replace(beginning, lost=self.lost))
        self.lost = 0

    def add(self, entry: Entry, size: int) -> None:
        """Take an entry, or lose it and all that waits."""
        if self.lost:
            self._lose(1)
        elif len(self.items) >= MOST_ENTRIES or self._bytes + size > MOST_BYTES:
            self._lose(len(self.items) + 1)
            self.items.clear()
            self._bytes = 0
        else:
            self._bytes += size
            self.items.append(entry)

    def take(self) -> list[Entry | Beginning]:
        """Everything that waits, which then no longer does."""
        items, self.items, self._bytes = self.items, [], 0
        return items

    def _lose(self, number: int) -> None:
        self.lost += number
        self.lost_in_all += number


class Journal:
    """What happens, to every queue."""

    def __init__(self) -> None:
        self.queues: list[Queue] = []

    def raw(self, topic: str, t_s: float, data: bytes | None) -> None:
        """Bytes that came or went; None: some are missing here."""
        if self.queues:
            self._add((topic, t_s, _raw, (t_s, data)), len(data or b""))

    def imu(self, name: str, sample: ImuSample, message: str | None, t_s: float) -> None:
        """A sample that goes into the collector; `message` is the autopilot's that it came in."""
        if self.queues:
            self._add((topics.IMU + name, t_s, topics.imu_json, (sample, message)))

    def tilt(self, sample: TiltSample) -> None:
        """A reading of the gradienter."""
        if self.queues:
            self._add((topics.GRADIENTER, sample.t_s, topics.tilt_json, (sample,)))

    def compass(self, sample: CompassSample) -> None:
        """A heading."""
        if self.queues:
            self._add((topics.COMPASS, sample.t_s, topics.compass_json, (sample,)))

    def event(self, t_s: float, event: topics.JournalEvent, detail: Any = None) -> None:
        """What is about to be done with the collector; `detail` never changes, or is frozen."""
        if self.queues:
            self._add((topics.JOURNAL, t_s, _event, (t_s, event, detail)))

    def record(self, record: Record, t_s: float) -> None:
        """A calibration has ended."""
        if self.queues:
            self._add((topics.RECORD, t_s, topics.record_json, (record, t_s)))

    def _add(self, entry: Entry, size: int = 0) -> None:
        for queue in self.queues:
            queue.add(entry, size)


def _raw(t_s: float, data: bytes | None) -> bytes:
    return msgspec.json.encode(topics.RawBytes(t_s, data))


def _event(t_s: float, event: topics.JournalEvent, detail: Any) -> bytes:
    text = "" if detail is None else to_json(detail).decode()
    return msgspec.json.encode(topics.JournalEntry(t_s, event, text))
