"""The page of one flight, as its log told it."""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence
from typing import Final

from companion.estimation.records.flight_evidence import surely_moved
from companion.estimation.records.flight_record import (
    HEADS,
    UNSEEN,
    Drift,
    Flight,
    ImuFlight,
    KeptFlight,
    Split,
    Term,
    figure,
    legend,
    next_flight,
)
from companion.physics.units import unit_of
from companion.report import svg
from companion.report.markup import Child, Markup, cell, row, tag
from companion.report.page import CLASSES, MAX_IMUS, card, moment, page, with_sigma

_MARKS: Final = ("●", "■", "▲")
"""Marks that the plot draws for `CLASSES`."""
_MOST_SETS: Final = 8
_SHORTEST_M: Final = 0.01


def flight_page(number: int, kept: KeptFlight, flights: Sequence[Flight], now: datetime.datetime) -> str:
    """The file's content; `flights` are all that are known, this one among them."""
    flight = kept.flight
    imus = flight.imus[:MAX_IMUS]
    notes = [*flight.notes, *(f"IMU {imu.imu}: {words}" for imu in flight.imus for words in imu.notes)]
    hint = next_flight(flight)
    whose = "vehicle unknown" if flight.system_id is None else f"vehicle {flight.system_id}"
    return page(
        f"Flight {number}, {_when(flight)}",
        now,
        tag("h1", f"Flight {number}"),
        tag("p", f"{_when(flight)}, {whose}{_how_long(flight)}, log {kept.log}"),
        tag("p", figure(flight.imus) or "It did not fly, or too shortly to tell anything.", class_="lead"),
        card("fine" if hint.startswith("nothing") else "caution", tag("p", f"Next flight: {hint}.")),
        *(card("caution", tag("p", f"{one.words}.")) for one in surely_moved(flights, flight)),
        *(card("", tag("p", words)) for words in notes),
        *(part for imu in imus for part in _imu(flight, imu)),
        card("caution", f"{len(flight.imus) - MAX_IMUS} more IMUs are not shown.")
        if len(flight.imus) > MAX_IMUS
        else None,
        source="from what companion flight has read in the autopilot's log",
        clock="that log",
    )


def _when(flight: Flight) -> str:
    return "time unknown" if flight.began_at is None else moment(flight.began_at)


def _how_long(flight: Flight) -> str:
    stages = flight.stages
    if stages.take_off_s is None or stages.landing_s is None:
        return ""
    return f", {stages.landing_s - stages.take_off_s:.0f} s in the air"


def _imu(flight: Flight, imu: ImuFlight) -> list[Child]:
    whose = f"the calibration of {moment(imu.calibration)}" if imu.calibration else "no calibration known here"
    return [
        tag("h2", f"IMU {imu.imu}"),
        tag("p", f"{imu.rate_hz:.0f} Hz, offsets of {whose}", class_="soft"),
        *_drift(flight, imu),
        *_biases(flight, imu),
    ]


def _drift(flight: Flight, imu: ImuFlight) -> list[Child]:
    sets = {name: rows for name, rows in list(imu.drift.items())[:_MOST_SETS] if rows}
    if not sets:
        return [card("", "No drift known: it did not fly, or too shortly.")]
    # Those that were flown first: what the others are compared with.
    names = sorted(sets, key="flown".__ne__)
    spans = sorted({one.seconds for rows in sets.values() for one in rows})
    shape = {name: (CLASSES[k], _MARKS[k]) if k < len(CLASSES) else ("past", _MARKS[0]) for k, name in enumerate(names)}
    rows = [
        row(
            tag("td", tag("span", f"{shape[name][1]} ", class_=shape[name][0]), name),
            *(_drifted(f"drift.{imu.imu}.{name}.{span:.0f}", sets[name], span) for span in spans),
        )
        for name in names
    ]
    heads = ["offsets", *(f"{span:.0f} s, m" for span in spans)]
    compared = "Distance from the EKF's solution with GNSS, whose tilt each start has: 0.1 deg off make 8 m in 30 s."
    if flight.reference == "truth":
        compared = "Distance from the simulator's truth."
    return [
        tag("h3", "Drift without GNSS"),
        tag("table", tag("tr", *(tag("th", words) for words in heads)), *rows),
        tag(
            "figure",
            _drift_plot(imu, {name: sets[name] for name in names}, shape),
            tag("figcaption", f"{compared} Bars: up to what 19 of 20 starts stay within."),
        ),
    ]


def _drifted(key: str, rows: Sequence[Drift], span_s: float) -> Markup:
    found = next((one for one in rows if one.seconds == span_s), None)
    if found is None:
        return tag("td", "?")
    return cell(key, f"{found.median_m:.1f}", tag("small", f"95 %: {found.worst_m:.1f}"))


def _drift_plot(imu: ImuFlight, sets: dict[str, list[Drift]], shape: dict[str, tuple[str, str]]) -> Markup:
    def up(metres: float) -> float:
        return math.log10(max(metres, _SHORTEST_M))

    ends = [up(metres) for rows in sets.values() for one in rows for metres in (one.median_m, one.worst_m)]
    low, high = math.floor(min(ends)), math.floor(max(ends)) + 1
    plot = svg.Plot(
        svg.linear([0.0, *(one.seconds for rows in sets.values() for one in rows)]),
        svg.Axis(low, high, tuple((float(k), f"{10.0**k:g}") for k in range(low, high + 1, max(1, (high - low) // 5)))),
        name=f"IMU {imu.imu}: drift without GNSS",
        height=130.0,
        x_label="seconds without GNSS",
        y_label="m, logarithmic",
    )
    for name, rows in sets.items():
        points = [(one.seconds, up(one.median_m)) for one in rows]
        plot.line(points, f"run {shape[name][0]}")
        plot.points(points, shape[name][0], [(up(one.median_m), up(one.worst_m)) for one in rows])
    return plot.svg()


def _biases(flight: Flight, imu: ImuFlight) -> list[Child]:
    shown = [term for term in HEADS if any(getattr(axis, term) for axis in imu.axes)]
    lacking = [head for term, head in HEADS.items() if term not in shown]
    heads = ["", *(f"{axis.axis}, {unit_of(axis.axis).name}" for axis in imu.axes)]
    rows = [row(HEADS[term], *(_term(f"{term}.{imu.imu}", axis, term) for axis in imu.axes)) for term in shown]
    return [
        tag("h3", "Biases that the offsets left"),
        tag("table", tag("tr", *(tag("th", words) for words in heads)), *rows, class_="terms") if rows else None,
        tag("ul", *(tag("li", words) for words in legend([imu])), class_="soft") if rows else None,
        card("", tag("p", f"Not known: {', '.join(lacking)}.") if lacking else None, tag("p", f"{UNSEEN}.")),
        tag("div", *_plots(flight, imu), class_="pairs") if imu.moments else None,
        tag(
            "p",
            "Zero is what the offsets take off. Dots: ten seconds each. Line: the bias that the EKF had."
            " Band: the mean in the air with one sigma. Dashes: take-off and landing.",
            class_="soft",
        )
        if imu.moments
        else None,
    ]  # fmt: skip


def _term(key: str, axis: Split, term: str) -> Markup:
    found: Term | None = getattr(axis, term)
    if found is None:
        return tag("td", "?")
    value, sigma = with_sigma(found.value, found.sigma, unit_of(axis.axis).si)
    return cell(f"{key}.{axis.axis}", value, tag("small", "± ", sigma))


def _plots(flight: Flight, imu: ImuFlight) -> list[Markup]:
    stages = flight.stages
    dashes = [each - stages.armed_s for each in (stages.take_off_s, stages.landing_s) if each is not None]
    across = svg.linear([*dashes, *(one.after_arming_s for one in imu.moments)], least=10.0)

    def plot(what: str, unit: str, ends: Sequence[float], height: float, *, last: bool) -> svg.Plot:
        label = "seconds after arming" if last else ""
        up = svg.linear(ends, ticks=3, least=1.0)
        drawn = svg.Plot(
            across, up, name=f"IMU {imu.imu}: {what}", height=height, x_label=label, y_label=f"{what}, {unit}"
        )
        for at_s in dashes:
            drawn.upright(at_s, "now")
        return drawn

    drawn = []
    for k, axis in enumerate(imu.axes):
        unit, name, _ = unit_of(axis.axis)
        dots = [(one.after_arming_s, one.left[k] / unit) for one in imu.moments]
        line = [(one.after_arming_s, one.ekf[k] / unit) for one in imu.moments if one.ekf is not None]
        mean, air = axis.in_flight, [x for x, _ in dots if dashes and x > dashes[0]]
        band = [] if mean is None else [(mean.value + sign * mean.sigma) / unit for sign in (-1.0, 1.0)]
        one = plot(axis.axis, name, [0.0, *band, *(y for _, y in (*dots, *line))], 96.0, last=k > 1)
        class_ = CLASSES[min(k, 2)]
        if band and air:
            one.area([(x, band[0], band[1]) for x in (air[0], air[-1])], f"area {class_}")
        one.line([(across.low, 0.0), (across.high, 0.0)], "run past")
        one.line(line, f"curve {class_}")
        one.points(dots, class_, [(y, y) for _, y in dots])
        drawn.append(one.svg())
    warmth = [(one.after_arming_s, one.degc) for one in imu.moments if one.degc is not None]
    shaking = [(one.after_arming_s, one.vibration_m_s2) for one in imu.moments if one.vibration_m_s2 is not None]
    for what, unit_name, points in (("temperature", "degC", warmth), ("vibration", "m/s²", shaking)):
        if points:
            one = plot(what, unit_name, [y for _, y in points], 60.0, last=True)
            one.line(points, "curve past")
            drawn.append(one.svg())
    return [tag("figure", *drawn[:3]), tag("figure", *drawn[3:])]
