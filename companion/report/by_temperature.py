"""Plots of biases over temperature, for the page."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import msgspec

from companion.estimation.solution.by_temperature import ByTemperature
from companion.physics.units import UNITS
from companion.report.markup import Child, Markup, Plot, linear, tag
from companion.report.page import AXES, CLASSES, NAMES
from companion.samples import TRIADS, Triad, Vector

_LEAST_K: Final = 4.0
"""Least width of an axis, so that a tenth of a kelvin does not fill it."""

_Dot = tuple[float, Vector, Vector]
"""Temperature, bias and sigma of one triad."""


def biases_by_temperature(imus: Sequence[ByTemperature]) -> Markup:
    """Draw each IMU's plots, or say what they need."""
    return tag("div", *(part for imu in imus for part in _imu(imu)))


def _imu(imu: ByTemperature) -> list[Child]:
    return [
        tag("h3", f"IMU {imu.imu}"),
        tag("p", f"{imu.summary}."),
        tag("p", f"{imu.needs}.") if imu.needs else None,
        tag("div", *(_figure(imu, triad) for triad in TRIADS), class_="pairs") if imu.points else None,
    ]


def _figure(imu: ByTemperature, triad: Triad) -> Markup | None:
    gyro = triad == "gyro"
    power_ups: dict[int, list[_Dot]] = {}
    for one in imu.points:
        bias, sigma = (one.gyro_deg_h, one.sigma_deg_h) if gyro else (one.accel_mg, one.accel_sigma_mg)
        if bias is not None and sigma is not None:
            power_ups.setdefault(one.power_up, []).append((one.degc, bias, sigma))
    if not power_ups:
        return None
    seen = [dot for dots in power_ups.values() for dot in dots]
    rows: list[_Dot] = [msgspec.structs.astuple(row) for row in (imu.curve if gyro else imu.accel_curve)]
    now = imu.now if gyro else None
    across = linear([*(degc for degc, _, _ in seen), *([now.degc] if now else [])], least=_LEAST_K)
    plots = []
    for axis in range(3):
        class_ = CLASSES[axis]
        curve = [(degc, bias[axis], 2.0 * sigma[axis]) for degc, bias, sigma in rows]
        dots = [(degc, bias[axis], sigma[axis]) for degc, bias, sigma in seen]
        ends = [value + sign * by for _, value, by in (*dots, *curve) for sign in (-1.0, 1.0)]
        plot = Plot(
            across,
            linear([*ends, *([now.gyro_deg_h[axis]] if now else [])], ticks=3),
            name=f"IMU {imu.imu}, {NAMES[triad].lower()} {AXES[axis]}: bias by temperature",
            told=f"{len(dots)} points, {min(b for _, b, _ in dots):+.1f} to {max(b for _, b, _ in dots):+.1f}.",
            height=110.0,
            x_label="temperature of the IMU, degC" if axis == 2 else "",
            y_label=_label(imu, triad, axis),
        )
        plot.area([(degc, value - by, value + by) for degc, value, by in curve], f"area {class_}")
        plot.line([(degc, value) for degc, value, _ in curve], f"curve {class_}")
        for number, each in power_ups.items():
            points = [(degc, bias[axis]) for degc, bias, _ in each]
            spans = [(bias[axis] - sigma[axis], bias[axis] + sigma[axis]) for _, bias, sigma in each]
            colour = class_ if number == imu.today else "past"
            plot.line(points, f"run {colour}")
            plot.points(points, colour, spans)
        if now is not None:
            plot.upright(now.degc, "now")
            plot.ring(now.degc, now.gyro_deg_h[axis])
        plots.append(plot.svg())
    caption = ["A dot is a still window, a line joins those of one power-up."]
    if rows:
        caption.append("Curve and band: the next power-up, with two sigma, as far as it was seen.")
    if now is not None:
        caption.append(f"Ring and dashes: now, {now.degc:.1f} degC.")
    return tag("figure", tag("h4", NAMES[triad]), *plots, tag("figcaption", " ".join(caption)))


def _label(imu: ByTemperature, triad: Triad, axis: int) -> str:
    name = f"{AXES[axis]}, {UNITS[triad].name}"
    if triad == "accel":
        return name
    told = [("now", imu.now), ("at power-up", imu.at_power_up)]
    said = [f"{words} {found.gyro_deg_h[axis]:+.0f} ± {found.sigma_deg_h[axis]:.0f}" for words, found in told if found]
    return f"{name}: {', '.join(said)}" if said else name
