"""Figures for plots: Allan deviation of what was kept, runs of verdicts, biases over the history, their slope."""

from __future__ import annotations

import datetime
import itertools
import math
from collections.abc import Iterable, Sequence
from typing import Final, Literal

import msgspec

from companion.calibration.collector.trace import MAX_SECONDS, ImuTrace, Trace, VerdictTrace
from companion.calibration.solution.record import Record
from companion.samples import Triad, Vector

State = Literal["still", "moving", "fault", "unknown"]

LEAST_SECONDS: Final = 10
"""Fewer still seconds give an Allan deviation that means nothing."""
_MOST: Final = 1e4
"""SI units or degC: beyond is a damaged file, which must not squash the rest of a plot."""
_LATEST_S: Final = 230 * 365.25 * 86400
"""The year 2200."""
SLOPE_POINTS: Final = 5
SLOPE_SPAN_K: Final = 5.0
"""A bias is set against temperature with a line from so many points over so many kelvin (method section 3)."""


class AllanPoint(msgspec.Struct, frozen=True):
    """Allan deviation of three axes at one averaging time, with about one sigma to either side."""

    tau_s: int
    deviation: Vector
    low: Vector
    high: Vector


class Allan(msgspec.Struct, frozen=True):
    """Of one triad, over `seconds` still seconds; `of_result`: those that the result is the mean of."""

    points: tuple[AllanPoint, ...]
    seconds: int
    of_result: bool


def allan(trace: Trace, imu: ImuTrace, triad: Triad) -> Allan | None:
    """Overlapping Allan deviation of the one-second means; None where too little was still.

    rad/s or m/s^2, at 1, 2, 4, ... s up to a third of the whole: beyond, there is nothing left to average.
    """
    import numpy as np

    from companion.calibration.noise.allan import allan_variance

    places = _measured(trace) if trace.measured is not None else _longest_still(trace)
    values = imu.gyro_rad_s if triad == "gyro" else imu.accel_m_s2
    known = [(trace.second[k], value) for k in places if (value := values[k]) is not None]
    # A window is contiguous but for a fifth; what is spread wider was not written by us.
    if len(known) < LEAST_SECONDS or known[-1][0] - known[0][0] > 10 * MAX_SECONDS:
        return None
    slots = np.array([second for second, _ in known], dtype=np.int64)
    means = np.array([value for _, value in known], dtype=np.float64)
    points: list[AllanPoint] = []
    span = 1
    while span * 3 <= slots[-1] - slots[0] + 1:
        variance, freedom = allan_variance(slots, means, span)
        if freedom > 0.0:
            deviation = np.sqrt(variance)
            low, high = _interval(freedom)
            points.append(AllanPoint(span, _axes(deviation), _axes(deviation * low), _axes(deviation * high)))
        span *= 2
    return Allan(tuple(points), len(known), trace.measured is not None)


def _measured(trace: Trace) -> list[int]:
    first, last = trace.measured or (0, 0)
    return [k for k, second in enumerate(trace.second) if trace.good[k] and first <= second < last]


def _longest_still(trace: Trace) -> list[int]:
    best: list[int] = []
    run: list[int] = []
    for k, second in enumerate(trace.second):
        joined = run and trace.second[run[-1]] == second - 1
        run = ([*run, k] if joined else [k]) if trace.good[k] else []
        best = max(best, run, key=len)
    return best


def _interval(freedom: float) -> tuple[float, float]:
    """Factors on a deviation for a 68 % interval: chi-square by Wilson and Hilferty."""
    spread = 2.0 / (9.0 * freedom)
    low, high = ((max(1.0 - spread + z * math.sqrt(spread), 0.2)) ** 3 for z in (-1.0, 1.0))
    return math.sqrt(1.0 / high), math.sqrt(1.0 / low)


def _axes(values: Iterable[float]) -> Vector:
    x, y, z = (float(value) for value in values)
    return x, y, z


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
    temperature_degc: float | None
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
                found.append(Point(number, unix_s(record.started_at), _believable(one.temperature_degc), bias, sigma))
    return found


def _believable(temperature_degc: float | None) -> float | None:
    return temperature_degc if temperature_degc is not None and abs(temperature_degc) < _MOST else None


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


class Slope(msgspec.Struct, frozen=True):
    """A bias against temperature: value = at_mean + per_k * (temperature - mean_degc)."""

    per_k: float
    sigma_per_k: float
    at_mean: float
    mean_degc: float


def slope(points: Sequence[Point], axis: int) -> Slope | None:
    """Least squares against temperature; None where the points are too few or too close together.

    Its sigma comes from the scatter around the line.
    """
    import numpy as np

    known = [(point.temperature_degc, point.bias[axis]) for point in points if point.temperature_degc is not None]
    temperatures = np.array([temperature for temperature, _ in known], dtype=np.float64)
    if len(known) < SLOPE_POINTS or float(np.ptp(temperatures)) < SLOPE_SPAN_K:
        return None
    values = np.array([value for _, value in known], dtype=np.float64)
    mean = float(temperatures.mean())
    off = temperatures - mean
    square = float(np.square(off).sum())
    per_k = float((off * values).sum()) / square
    left = values - values.mean() - per_k * off
    sigma = math.sqrt(float(np.square(left).sum()) / (len(known) - 2) / square)
    return Slope(per_k, sigma, float(values.mean()), mean)
