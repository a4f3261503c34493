"""Verdicts of the seconds of a calibration, kept beside its record to show later how still it was."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Annotated, Final

import msgspec

from companion import formats
from companion.estimation.collector.intake import Kind, Source
from companion.estimation.stillness.gates import Verdict

FORMAT_VERSION: Final = 2
"""Version 1 held the noise of each IMU too."""

MAX_SECONDS: Final = 600
"""Ten times the longest usual window; 1 MB in memory, 100 kB on disk with three IMUs."""

MAX_WORDS: Final = 100
_Second = Annotated[int, msgspec.Meta(ge=-100_000_000, le=100_000_000)]


class VerdictTrace(msgspec.Struct, frozen=True, kw_only=True):
    """Verdicts on one source."""

    kind: Kind
    name: str
    words: tuple[str | None, ...]
    """None: still. Else why not; empty while nothing was known yet."""
    fault: tuple[bool, ...]
    """True: the device is at fault, not the aircraft."""


class Trace(msgspec.Struct, frozen=True, kw_only=True):
    """The seconds before and during one calibration."""

    format_version: int = FORMAT_VERSION
    started_at: str
    """Start of the record that it belongs to."""
    second: Annotated[tuple[_Second, ...], msgspec.Meta(max_length=MAX_SECONDS)]
    """Seconds since the request; negative before it. Ascending, with gaps where nothing was judged."""
    good: tuple[bool, ...]
    """Still for all sources."""
    measured: tuple[_Second, _Second] | None
    """The result is the mean of the good seconds from the first up to, without, the last; None: no result."""
    cut: bool
    """The calibration took longer than what is kept: its beginning is missing."""
    verdicts: tuple[VerdictTrace, ...]


def to_json(trace: Trace) -> bytes:
    """The trace as JSON."""
    return msgspec.json.encode(trace)


def from_json(data: bytes) -> Trace:
    """Read a trace back.

    Raises:
        msgspec.MsgspecError: not a trace, or one of a newer companion.
    """
    trace: Trace = formats.decode(data, Trace, FORMAT_VERSION)
    length = len(trace.second)
    columns: list[Sequence[object]] = [trace.good]
    for verdict in trace.verdicts:
        columns += [verdict.words, verdict.fault]
    if any(len(column) != length for column in columns):
        raise msgspec.ValidationError(f"not every column has {length} seconds")
    if any(later <= earlier for earlier, later in zip(trace.second, trace.second[1:], strict=False)):
        raise msgspec.ValidationError("seconds do not ascend")
    return trace


Second = tuple[int, bool, dict[tuple[Kind, str], Verdict]]
"""Slot, whether it was good, and the verdict on each source."""


class Snapshot(msgspec.Struct, frozen=True):
    """Seconds of one calibration; `trace` may run in another thread."""

    seconds: tuple[Second, ...]
    started_s: float
    measured_s: tuple[float, float] | None
    cut: bool

    def trace(self, started_at: str) -> Trace:
        """Return the seconds as columns; takes milliseconds."""
        origin = math.floor(self.started_s)
        names = dict.fromkeys(name for _, _, said in self.seconds for name in said)
        columns = {name: [said.get(name) for _, _, said in self.seconds] for name in names}
        measured = self.measured_s
        return Trace(
            started_at=started_at,
            second=tuple(slot - origin for slot, _, _ in self.seconds),
            good=tuple(good for _, good, _ in self.seconds),
            measured=None if measured is None else (round(measured[0]) - origin, round(measured[1]) - origin),
            cut=self.cut,
            verdicts=tuple(
                VerdictTrace(
                    kind=kind,
                    name=name,
                    words=tuple("" if one is None else None if one.still else one.words[:MAX_WORDS] for one in column),
                    fault=tuple(one is not None and one.fault for one in column),
                )
                for (kind, name), column in columns.items()
            ),
        )


class TraceLog:
    """The latest seconds as they were judged."""

    def __init__(self) -> None:
        self._seconds: deque[Second] = deque(maxlen=MAX_SECONDS)

    def add(self, slot: int, sources: Sequence[Source], *, good: bool) -> None:
        """Add a second that has just been judged."""
        if self._seconds and slot <= self._seconds[-1][0]:
            # The clock went back: old and new seconds cannot be compared.
            self._seconds.clear()
        self._seconds.append((slot, good, {(each.kind, each.name): each.verdict for each in sources}))

    def snapshot(self, started_s: float, measured_s: tuple[float, float] | None) -> Snapshot:
        """Return the seconds since the start of a calibration, or of its window where that was earlier."""
        first = math.floor(started_s if measured_s is None else min(started_s, measured_s[0]))
        cut = len(self._seconds) == MAX_SECONDS and self._seconds[0][0] > first
        kept = tuple(second for second in self._seconds if second[0] >= first)
        return Snapshot(kept, started_s, measured_s, cut)
