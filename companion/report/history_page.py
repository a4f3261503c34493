"""The page over all calibrations of an aircraft."""

from __future__ import annotations

import datetime
import re
from collections import Counter
from collections.abc import Sequence
from typing import Final

import msgspec

from companion.calibration.solution.record import Arming, Record
from companion.report import svg
from companion.report.analysis import history, unix_s
from companion.report.markup import Child, Markup, join, tag
from companion.report.page import (
    MAX_IMUS,
    NAMES,
    TRIADS,
    arming_items,
    card,
    damaged,
    drift,
    moment,
    page,
    written_count,
)

MAX_FAILURES: Final = 20
MAX_ARMINGS: Final = 60
_FIGURES: Final = re.compile(r"\d+(\.\d+)?")
_ROWS: Final = (("done", 4.0), ("failed", 3.0), ("cancelled", 2.0), ("armed", 1.0), ("uncal.", 0.0))


class Material(msgspec.Struct, frozen=True, kw_only=True):
    """Everything that the page over the history is made of."""

    vehicle: int | None
    records: Sequence[tuple[int, Record]]
    """Of this aircraft, oldest first."""
    left_out: int
    """Older ones that are not shown."""
    others: Sequence[int]
    """System ids of other aircraft in the same storage."""
    armings: Sequence[Arming]
    """Oldest first."""
    damaged: Sequence[str]


def history_page(material: Material, now: datetime.datetime) -> str:
    """The file's content."""
    records = material.records
    vehicle = "vehicle not heard" if material.vehicle is None else f"vehicle {material.vehicle}"
    counts = Counter(record.state for _, record in records)
    span = f"{moment(records[0][1].started_at)} to {moment(records[-1][1].started_at)}"
    counted = ", ".join(f"{counts[state]} {state}" for state in ("done", "failed", "cancelled"))
    others = ", ".join(f"{other} (--vehicle {other})" for other in material.others)
    return page(
        f"Calibrations of {vehicle}",
        now,
        tag("h1", f"Calibrations of {vehicle}"),
        tag("p", f"{len(records)} calibrations: {counted}", class_="lead"),
        tag("p", span),
        tag("p", f"{material.left_out} older ones are not shown (--limit).") if material.left_out else None,
        tag("p", f"Other vehicles in these records: {others}.") if others else None,
        damaged(material.damaged),
        _outcomes(records, material.armings),
        _failures(records),
        _biases(records),
        _armings(material.armings),
        _table(records),
    )


def _outcomes(records: Sequence[tuple[int, Record]], armings: Sequence[Arming]) -> Markup:
    moments = [(unix_s(record.started_at), record) for _, record in records]
    armed = [(unix_s(arming.armed_at), arming) for arming in armings]
    known = [place for place, _ in (*moments, *armed) if place is not None]
    parts: list[Child] = [tag("h2", "What happened when")]
    if not known:
        parts.append(card("", "No times are known."))
        return tag("section", *parts)
    rows = svg.Axis(-0.6, 4.6, tuple((place, words) for words, place in _ROWS))
    plot = svg.Plot(svg.times(known), rows, name="outcomes over time", height=120.0, x_label="time (UTC)", left=78.0)
    for state, row, class_, shape in (
        ("done", 4.0, "ok", "circle"),
        ("failed", 3.0, "bad", "cross"),
        ("cancelled", 2.0, "warn", "square"),
    ):
        places = [(place, row) for place, record in moments if place is not None and record.state == state]
        plot.points(places, class_, shape=shape)
    for row, bad, class_, shape in ((1.0, False, "ok", "triangle"), (0.0, True, "bad", "cross")):
        found = [(x, row) for x, arming in armed if x is not None and (arming.state == "uncalibrated") == bad]
        plot.points(found, class_, shape=shape)
    parts.append(tag("figure", plot.svg(), tag("figcaption", "uncal.: armed without a calibration in force.")))
    return tag("section", *parts)


def _failures(records: Sequence[tuple[int, Record]]) -> Markup:
    failed = [(number, record) for number, record in reversed(records) if record.state != "done"]
    parts: list[Child] = [tag("h2", "What went wrong")]
    if not failed:
        parts.append(card("fine", "Nothing: all are done."))
    groups: dict[tuple[str, str], list[tuple[int, Record]]] = {}
    for number, record in failed:
        # The same thing with other figures is the same thing.
        groups.setdefault((record.state, _FIGURES.sub("#", record.reason)), []).append((number, record))
    for (state, _), same in list(groups.items())[:MAX_FAILURES]:
        times = f"{len(same)} times, last " if len(same) > 1 else ""
        numbers = ", ".join(str(number) for number, _ in same[:10]) + (", …" if len(same) > 10 else "")
        parts.append(tag("h3", f"{state}: {times}{moment(same[0][1].started_at)}"))
        parts.append(tag("p", f"number {numbers}", class_="soft"))
        parts.append(card("alarm" if state == "failed" else "", tag("p", same[0][1].reason)))
    if len(groups) > MAX_FAILURES:
        parts.append(tag("p", f"{len(groups) - MAX_FAILURES} other kinds stand in the table below."))
    return tag("section", *parts)


def _biases(records: Sequence[tuple[int, Record]]) -> Markup:
    names = list(dict.fromkeys(imu.name for _, record in records for imu in record.imus))
    parts: list[Child] = []
    for name in names[:MAX_IMUS]:
        parts.append(tag("h2", f"IMU {name}"))
        figures: list[Child] = []
        for triad in TRIADS:
            points = history(records, name, triad)
            if points:
                plots = drift(points, triad, name=f"{name} {triad}") or card("", "No time is known.")
                figures.append(tag("div", tag("h3", f"{NAMES[triad]} against time"), plots))
        parts.append(tag("div", *figures, class_="pairs") if figures else card("", "No finished calibration."))
    if len(names) > MAX_IMUS:
        parts.append(card("caution", f"{len(names) - MAX_IMUS} more IMUs are not shown."))
    return join(*parts)


def _armings(armings: Sequence[Arming]) -> Markup:
    if not armings:
        return join(tag("h2", "Armings"), card("", "None is kept."))
    more = len(armings) - MAX_ARMINGS
    return join(
        tag("h2", "Armings"),
        arming_items(armings[::-1][:MAX_ARMINGS]),
        tag("p", f"{more} older ones are not shown.") if more > 0 else None,
    )


def _table(records: Sequence[tuple[int, Record]]) -> Markup:
    rows = []
    for number, record in reversed(records):
        written = written_count(record)
        became = f"; {written} parameters written" if written and record.state == "done" else ""
        became += f", undone {moment(record.undone_at)}" if record.undone_at else ""
        rows.append(
            tag(
                "tr",
                tag("td", str(number), class_="no"),
                tag(
                    "td",
                    tag("strong", record.state, class_=record.state),
                    f" {moment(record.started_at)}",
                    tag("br"),
                    record.reason[:160],
                    became,
                    class_="left",
                ),
            )
        )
    head = tag("tr", tag("th", "no.", class_="no"), tag("th", "what came of it", class_="left"))
    more = tag("p", "More about one: companion report NUMBER.", class_="soft")
    return join(tag("h2", "All, newest first"), more, tag("table", head, *rows))
