"""Biases over temperature, as plots: for reports and for the page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import msgspec

from companion.estimation.solution.by_temperature import ByTemperature, Expected
from companion.physics.units import UNITS
from companion.report import svg
from companion.report.markup import Child, Markup, tag
from companion.report.page import AXES, CLASSES, NAMES
from companion.samples import TRIADS, Triad, Vector

_LEAST_K: Final = 4.0
"""Least width of an axis, so that a tenth of a kelvin does not fill it."""
_WHEN: Final = {"now": "now", "then": "this calibration"}


class _Dot(msgspec.Struct, frozen=True):
    """One triad in a still window, or as expected at a temperature."""

    degc: float
    bias: Vector
    sigma: Vector


def biases_by_temperature(imus: Sequence[ByTemperature], *, looking_back: bool = False) -> Markup:
    """Draw each IMU's plots, or say what they need; `looking_back`: now is a calibration."""
    return tag("div", *(part for imu in imus for part in _imu(imu, looking_back=looking_back)))


def _imu(imu: ByTemperature, *, looking_back: bool) -> list[Child]:
    figures = [_figure(imu, triad, "then" if looking_back else "now") for triad in TRIADS]
    return [
        tag("h3", f"IMU {imu.imu}"),
        tag("p", f"{imu.summary}."),
        tag("p", f"{imu.needs}.") if imu.needs else None,
        tag("div", *figures, class_="pairs") if imu.points else None,
    ]


def _figure(imu: ByTemperature, triad: Triad, when: str) -> Markup | None:
    power_ups: dict[int, list[_Dot]] = {}
    for one in imu.points:
        bias, sigma = (one.gyro_deg_h, one.sigma_deg_h) if triad == "gyro" else (one.accel_mg, one.accel_sigma_mg)
        if bias is not None and sigma is not None:
            power_ups.setdefault(one.power_up, []).append(_Dot(one.degc, bias, sigma))
    if not power_ups:
        return None
    now, rows = (imu.now if triad == "gyro" else None), _curve(imu, triad)
    seen = [dot.degc for dots in power_ups.values() for dot in dots]
    across = svg.linear([*seen, *([now.degc] if now else [])], least=_LEAST_K)
    plots = []
    for axis in range(3):
        curve = [(row.degc, row.bias[axis], 2.0 * row.sigma[axis]) for row in rows]
        dots = [(dot.degc, dot.bias[axis], dot.sigma[axis]) for each in power_ups.values() for dot in each]
        ends = [value + sign * by for _, value, by in (*dots, *curve) for sign in (-1.0, 1.0)]
        plot = svg.Plot(
            across,
            svg.linear([*ends, *([now.gyro_deg_h[axis]] if now else [])], ticks=3),
            name=f"IMU {imu.imu}, {NAMES[triad].lower()} {AXES[axis]}: bias by temperature",
            told=f"{len(dots)} points, {min(b for _, b, _ in dots):+.1f} to {max(b for _, b, _ in dots):+.1f}.",
            height=110.0,
            x_label="temperature of the IMU, degC" if axis == 2 else "",
            y_label=_label(imu, triad, axis, when),
        )
        class_ = CLASSES[axis]
        plot.area([(degc, value - by, value + by) for degc, value, by in curve], f"area {class_}")
        plot.line([(degc, value) for degc, value, _ in curve], f"curve {class_}")
        for number, each in power_ups.items():
            _power_up(plot, each, axis, class_ if number == imu.today else "past")
        if now is not None:
            _mark(plot, now.degc, now.gyro_deg_h[axis])
        plots.append(plot.svg())
    return tag("figure", tag("h4", NAMES[triad]), *plots, tag("figcaption", _caption(imu, triad, when)))


def _curve(imu: ByTemperature, triad: Triad) -> list[_Dot]:
    if triad == "gyro":
        return [_Dot(row.degc, row.gyro_deg_h, row.sigma_deg_h) for row in imu.curve]
    return [_Dot(row.degc, row.accel_mg, row.sigma_mg) for row in imu.accel_curve]


def _power_up(plot: svg.Plot, dots: Sequence[_Dot], axis: int, class_: str) -> None:
    points = [(dot.degc, dot.bias[axis]) for dot in dots]
    plot.line(points, f"run {class_}")
    plot.points(points, class_, [(dot.bias[axis] - dot.sigma[axis], dot.bias[axis] + dot.sigma[axis]) for dot in dots])


def _mark(plot: svg.Plot, degc: float, bias: float) -> None:
    plot.upright(degc, "now")
    x, y = plot.at(degc, bias)
    plot.draw(tag("circle", cx=f"{x:.1f}", cy=f"{y:.1f}", r=8, class_="ring"))


def _label(imu: ByTemperature, triad: Triad, axis: int, when: str) -> str:
    name = f"{AXES[axis]}, {UNITS[triad].name}"
    if triad == "accel":
        return name
    told = [(when, imu.now), ("at power-up", imu.at_power_up)]
    said = [f"{words} {_value(found, axis)}" for words, found in told if found is not None]
    return f"{name}: {', '.join(said)}" if said else name


def _value(found: Expected, axis: int) -> str:
    return f"{found.gyro_deg_h[axis]:+.0f} ± {found.sigma_deg_h[axis]:.0f}"


def _caption(imu: ByTemperature, triad: Triad, when: str) -> str:
    words = ["A dot is a still window, a line joins those of one power-up."]
    if _curve(imu, triad):
        words.append("Curve and band: the next power-up, with two sigma, as far as it was seen.")
    if triad == "gyro" and imu.now is not None:
        words.append(f"Ring and dashes: {_WHEN[when]}, {imu.now.degc:.1f} degC.")
    return " ".join(words)
