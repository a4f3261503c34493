"""Figures for plots: runs of verdicts, biases over the history."""

from __future__ import annotations

import datetime
import itertools
from collections.abc import Sequence
from typing import Final, Literal

import msgspec

from companion.calibration.collector.trace import Trace, VerdictTrace
from companion.calibration.solution.record import Record
from companion.samples import Triad, Vector

State = Literal["still", "moving", "fault", "unknown"]

_MOST: Final = 1e4
"""SI units: beyond is a damaged file, which must not squash the rest of a plot."""
_LATEST_S: Final = 230 * 365.25 * 86400
"""The year 2200."""


class Run(msgspec.Struct, frozen=True):
    """Seconds of one kind in a row; `last` is included."""

    first: int
    last: int
    state: State
    words: str
    """Of its first second."""


def runs(trace: Trace, verdict: VerdictTrace) -> list[Run]:
    """The verdicts of one source, joined where neighbours are of one kind."""
    states: list[State] = []
    for words, fault in zip(verdict.words, verdict.fault, strict=True):
        states.append("still" if words is None else "unknown" if not words else "fault" if fault else "moving")
    found: list[Run] = []
    for k, (second, state) in enumerate(zip(trace.second, states, strict=True)):
        before = found[-1] if found else None
        if before is not None and before.state == state and before.last == second - 1:
            found[-1] = msgspec.structs.replace(before, last=second)
        else:
            found.append(Run(second, second, state, verdict.words[k] or ""))
    return found


class Point(msgspec.Struct, frozen=True):
    """One triad of one IMU in one calibration of the history; SI units."""

    number: int
    unix_s: float | None
    bias: Vector
    sigma_use: Vector


def history(records: Sequence[tuple[int, Record]], imu: str, triad: Triad) -> list[Point]:
    """Biases of one triad over finished calibrations, in the order given; those that found none are left out."""
    found: list[Point] = []
    for number, record in records:
        for one in record.imus:
            bias, sigma = (
                (one.gyro_bias_rad_s, one.gyro_sigma_use_rad_s)
                if triad == "gyro"
                else (one.accel_bias_m_s2, one.accel_sigma_use_m_s2)
            )
            if one.name != imu or record.state != "done" or bias is None or sigma is None:
                continue
            if max(map(abs, (*bias, *sigma))) < _MOST:
                found.append(Point(number, unix_s(record.started_at), bias, sigma))
    return found


def unix_s(moment: str) -> float | None:
    """Seconds since 1970 of an ISO 8601 time, which is UTC if it does not say; None: it is none of this age."""
    try:
        parsed = datetime.datetime.fromisoformat(moment)
        seconds = (parsed if parsed.tzinfo else parsed.replace(tzinfo=datetime.UTC)).timestamp()
    except (ValueError, OverflowError):
        return None
    return seconds if 0.0 <= seconds < _LATEST_S else None


def clock_is_sound(points: Sequence[Point]) -> bool:
    """Whether the times ascend: a field computer without a clock battery begins in the past at every boot."""
    known = [point.unix_s for point in points]
    return None not in known and all(a <= b for a, b in itertools.pairwise(known) if a is not None and b is not None)
