"""Pages of IMUs: one model with all its parts, and one IMU's biases over temperature."""

from __future__ import annotations

import datetime
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import groupby
from operator import attrgetter
from typing import Final

import msgspec
import numpy as np
import sqlalchemy as sa

from companion.estimation.solution.by_temperature import ByTemperature, Expected, ExpectedForces, Seen
from companion.fleet.judgement import Part, parts_of
from companion.fleet.schema import Moment, aircraft, parts
from companion.fleet.sequential import Typical, typical_part
from companion.physics.frames import Floats
from companion.physics.units import UNITS
from companion.report import svg
from companion.report.by_temperature import biases_by_temperature
from companion.report.markup import Child, Markup, join, row, tag
from companion.report.page import AXES, CLASSES, NAMES, page
from companion.samples import TRIADS, Triad, rows_of

OUTSIDE: Final = 3.0
"""Least distance from the typical part, in sigmas of the spread, for the list of outliers."""
MOST_OUTSIDE: Final = 30
_BINS: Final = 40
_DOT: Final = 7.5
_LEAST_HEIGHT: Final = 36.0
_MOST_HEIGHT: Final = 180.0


def models(connection: sa.Connection) -> dict[str, int]:
    """Count the parts of each model."""
    one = sa.and_(parts.c.model.is_not(None), parts.c.triad == "gyro", parts.c.axis == "x")
    query = sa.select(parts.c.model, sa.func.count()).where(one).group_by(parts.c.model).order_by(parts.c.model)
    return {row[0]: row[1] for row in connection.execute(query)}


def model_links(connection: sa.Connection) -> Markup | None:
    """Link to the page of each model."""
    links = [
        join(tag("a", model, href=f"/model/{model}"), f" ({count} parts) ")
        for model, count in models(connection).items()
    ]
    return tag("p", "IMU models: ", *links) if links else None


def model_page(connection: sa.Connection, model: str, now: datetime.datetime, source: str) -> str | None:
    """Show all parts of one model; None: there are none."""
    of_model = parts_of(connection, model)
    if not of_model:
        return None
    of_parts = aircraft.c.aircraft.in_({one for one, _ in of_model})
    query = sa.select(aircraft.c.aircraft, aircraft.c.name).where(of_parts)
    names = {row.aircraft: row.name for row in connection.execute(query)}
    typical = typical_part(list(of_model.values()))
    turn_on = np.array([part.turn_on for part in of_model.values()])
    all_parts = models(connection).get(model, 0)
    power_ups = sum(part.power_ups for part in of_model.values())
    shown: list[Child] = [
        tag("p", tag("a", "Fleet", href="/")),
        tag("h1", f"IMU model {model}"),
        tag("p", f"{len(of_model)} parts, {power_ups} power-ups", class_="lead"),
        tag("p", f"The first {len(of_model)} of {all_parts} parts.") if len(of_model) < all_parts else None,
        tag("p", "How far the biases of each part scatter from one power-up to the next, at one temperature."),
    ]
    for triad in TRIADS:
        shown += _distribution(turn_on, triad, typical)
        if typical is not None:
            shown.append(_outside(list(of_model), turn_on, triad, typical, names))
    if typical is None:
        shown.append(tag("p", "Too few parts with a known scatter to say which one is typical."))
    return page(f"IMU model {model}", now, *shown, source=source)


def _distribution(turn_on: Floats, triad: Triad, typical: Typical | None) -> list[Child]:
    """Draw a dot for each part, above the others that scatter as much, and the typical part."""
    unit, unit_name, _ = UNITS[triad]
    columns = [np.sort(column[np.isfinite(column)]) / unit for column in turn_on[:, rows_of(triad)].T]
    if not any(map(len, columns)):
        return []
    across = svg.linear([0.0, *np.concatenate(columns).tolist()])
    across = msgspec.structs.replace(across, low=0.0, ticks=tuple(tick for tick in across.ticks if tick[0] >= 0.0))
    plots = []
    for axis, values in enumerate(columns):
        there: Counter[int] = Counter()
        points: list[svg.Pair] = []
        for value in values.tolist():
            place = round(across.share(value) * _BINS)
            there[place] += 1
            points.append((value, float(there[place])))
        most = float(max(there.values(), default=1))
        label = f"{AXES[axis]}, {unit_name}"
        usual = None
        if typical is not None and np.isfinite(typical.turn_on[rows_of(triad)][axis]):
            usual, spread = (
                float(each[rows_of(triad)][axis]) / unit for each in (typical.turn_on, typical.turn_on_spread)
            )
            label += f": typically {usual:.3g}, parts differ by {spread:.2g}"
        plot = svg.Plot(
            across,
            svg.Axis(0.0, most + 1.0, ()),
            name=f"{NAMES[triad].lower()} {AXES[axis]}: turn-on scatter of each part",
            told=f"{len(points)} parts",
            height=min(max(_DOT * (most + 1.0), _LEAST_HEIGHT), _MOST_HEIGHT),
            x_label=f"turn-on scatter, {unit_name}" if axis == 2 else "",
            y_label=label,
            left=16.0,
        )
        plot.points(points, CLASSES[axis], [(place, place) for _, place in points])
        if usual is not None:
            plot.upright(usual, "now")
        plots.append(plot.svg())
    words = "A dot is a part. " + ("Dashes: the typical one." if typical is not None else "")
    slopes = None
    if typical is not None and np.isfinite(per_k := typical.per_k[rows_of(triad)]).all():
        spreads = typical.per_k_spread[rows_of(triad)]
        each = ", ".join(
            f"{axis} {mean / unit:+.2g} ± {spread / unit:.2g}"
            for axis, mean, spread in zip(AXES, per_k, spreads, strict=True)
        )
        slopes = tag("p", f"By temperature, {unit_name} a kelvin, mean and how parts differ: {each}.")
    return [tag("h2", NAMES[triad]), tag("figure", *plots, tag("figcaption", words)), slopes]


def _outside(
    keys: Sequence[Part], turn_on: Floats, triad: Triad, typical: Typical, names: Mapping[str, str | None]
) -> Markup:
    """List the parts that scatter far more, or less, than the others."""
    unit, unit_name, _ = UNITS[triad]
    at = rows_of(triad)
    values, usual, spread = turn_on[:, at], typical.turn_on[at], typical.turn_on_spread[at]
    far = np.argwhere(np.abs(values - usual) > OUTSIDE * spread).tolist()
    if not far:
        return tag("p", "No part is far off the others (three times what they differ).", class_="soft")
    rows = []
    for part, axis in sorted(far, key=lambda one: -values[one[0], one[1]] / usual[one[1]])[:MOST_OUTSIDE]:
        which, imu = keys[part]
        link = tag("a", names.get(which) or which, href=f"/aircraft/{which}")
        value = values[part, axis]
        ratio = tag("td", f"{value / usual[axis]:.1f}", class_="warn")
        rows.append(row(tag("td", link, tag("small", f"IMU {imu}")), AXES[axis], f"{value / unit:.3g}", ratio))
    head = row(*(tag("th", words) for words in ("Far off the others", "axis", unit_name, "times the typical")))
    return tag("table", head, *rows, class_="fleet")


# --- one aircraft


def curves(connection: sa.Connection, which: str) -> dict[str, ByTemperature]:
    """Read the latest curve over temperature of each IMU of an aircraft."""
    query = """
        SELECT imu, triad, degc, power_ups, at,
               COALESCE(gyro_bias_deg_h, accel_bias_mg) AS bias, COALESCE(gyro_sigma_deg_h, accel_sigma_mg) AS sigma
        FROM temperature_curves WHERE aircraft = :which ORDER BY imu, degc, triad, axis"""
    found: dict[str, ByTemperature] = {}
    told = connection.execute(sa.text(query).columns(at=Moment()), {"which": which})
    for imu, rows in groupby(told, key=attrgetter("imu")):
        gyro, accel = list[Expected](), list[ExpectedForces]()
        for (degc, triad), (x, y, z) in groupby(rows, key=attrgetter("degc", "triad")):
            bias, sigma = (x.bias, y.bias, z.bias), (x.sigma, y.sigma, z.sigma)
            if triad == "gyro":
                gyro.append(Expected(degc=degc, gyro_deg_h=bias, sigma_deg_h=sigma))
            else:
                accel.append(ExpectedForces(degc=degc, accel_mg=bias, sigma_mg=sigma))
        found[imu] = ByTemperature(
            imu=f"{imu} by temperature",
            summary=f"The curve of {x.power_ups} power-ups, as told {x.at:%Y-%m-%d}",
            curve=tuple(gyro),
            accel_curve=tuple(accel),
        )
    return found


def by_temperature(told: ByTemperature | None, points: Sequence[Seen]) -> Markup | None:
    """Draw the curve of one IMU and the biases that its calibrations found."""
    if told is None:
        return None
    return biases_by_temperature([msgspec.structs.replace(told, points=tuple(points))], looking_back=True)
