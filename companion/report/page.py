"""Frame of all HTML pages, and parts that several pages share: boxes, plots of bias over time and temperature."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec

from companion import __version__
from companion.estimation.records.record import Record
from companion.physics.units import UNITS
from companion.report.markup import Child, Dot, Markup, Plot, dates, in_order, join, linear, tag
from companion.samples import TRIADS, Triad, Vector

if TYPE_CHECKING:
    from companion.estimation.solution.by_temperature import ByTemperature

NAMES: Final[Mapping[Triad, str]] = {"gyro": "Gyro", "accel": "Accelerometer"}
AXES: Final = ("x", "y", "z")
CLASSES: Final = ("sx", "sy", "sz")
_MOST: Final = 1e4
"""Largest bias or sigma in a plot (rad/s, m/s^2): a larger one is from a damaged file and would spoil the scale."""
_LATEST_S: Final = 230 * 365.25 * 86400
MAX_WARNINGS: Final = 40
MAX_IMUS: Final = 4
"""Most IMUs shown on a page, which then stays below half a megabyte: three of an autopilot and our own."""

# No script, no fetch, no form: a page contains everything inline.
_POLICY: Final = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"

_STYLES: Final = tuple(Path(__file__).with_name(name) for name in ("page.css", "plot.css"))
_LEAST_K: Final = 4.0
"""Least width of a temperature axis, K, so that a tenth of a kelvin does not fill it."""

_Window = tuple[float, Vector, Vector]


def page(title: str, now: datetime.datetime, *body: Child, source: str = "from the records on this computer") -> str:
    foot = tag(
        "p",
        f"Made {now:%Y-%m-%d %H:%M} UTC by companion {__version__} {source}. All axes:"
        f" x forward, y right, z down. Times: UTC by the companion's clock.",
        class_="soft",
    )
    head = join(
        Markup('<meta charset="utf-8">'),
        tag("meta", name="viewport", content="width=device-width, initial-scale=1"),
        tag("meta", http_equiv="Content-Security-Policy", content=_POLICY),
        tag("meta", name="color-scheme", content="light dark"),
        tag("title", title),
        tag("style", Markup("".join(style.read_text(encoding="utf-8") for style in _STYLES))),
    )
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}</head><body>{join(*body, foot)}</body></html>\n'


def card(kind: str, *children: Child) -> Markup:
    """Make a box; its kind, "alarm", "caution", "fine" or "", determines the colour."""
    return tag("div", *children, class_=f"card {kind}".strip())


def moment(iso: str) -> str:
    return f"{iso[:10]} {iso[11:16]} UTC" if len(iso) >= 16 else iso


def damaged(problems: Sequence[str]) -> Markup | None:
    more = [f"and {len(problems) - 10} more"] if len(problems) > 10 else []
    lines = [tag("li", problem) for problem in (*problems[:10], *more)]
    head = tag("p", "These files cannot be read and were skipped. They can be removed; nothing else depends on them.")
    return card("caution", head, tag("ul", *lines)) if problems else None


def with_sigma(value: float, sigma: float, unit: float, sign: str = "+") -> tuple[str, str]:
    """Format a value and its sigma, divided by `unit`, to the second significant digit of sigma."""
    shown = abs(sigma / unit)
    digits = min(max(1 - math.floor(math.log10(shown)), 0), 5) if 0 < shown < 1e9 else 1
    return f"{value / unit:{sign}.{digits}f}", f"{sigma / unit:.{digits}f}"


class PlotPoint(msgspec.Struct, frozen=True):
    """Bias and sigma of one gyro or accelerometer, x y z, in one calibration; rad/s or m/s^2."""

    number: int
    unix_s: float | None
    bias: Vector
    sigma_use: Vector


def history(records: Sequence[tuple[int, Record]], imu: str, triad: Triad) -> list[PlotPoint]:
    found: list[PlotPoint] = []
    for which, record in records:
        for one in record.imus:
            bias, _, sigma, *_ = one.of(triad)
            if one.name != imu or record.state != "done" or bias is None or sigma is None:
                continue
            if max(map(abs, (*bias, *sigma))) < _MOST:
                found.append(PlotPoint(which, unix_s(record.started_at), bias, sigma))
    return found


def unix_s(moment: str) -> float | None:
    """Convert an ISO 8601 time, by default in UTC, to s since 1970; None if invalid or outside 1970 to 2199."""
    try:
        parsed = datetime.datetime.fromisoformat(moment)
        return seconds_of(parsed if parsed.tzinfo else parsed.replace(tzinfo=datetime.UTC))
    except (ValueError, OverflowError):
        return None


def seconds_of(moment: datetime.datetime) -> float | None:
    """Convert a time with a zone to s since 1970; return None outside 1970 to 2199, the range of a time axis."""
    seconds = moment.timestamp()
    return seconds if 0.0 <= seconds < _LATEST_S else None


def drift(points: Sequence[PlotPoint], triad: Triad, *, name: str, this: int | None = None) -> Markup:
    unit, unit_name, _ = UNITS[triad]
    times = [point.unix_s for point in points if point.unix_s is not None]
    # Without a battery the clock restarts in the past at each boot.
    dated = len(times) == len(points) > 0 and times == sorted(times)
    if dated:
        across, label = dates(times), "time (UTC), in their order"
    else:
        across = in_order([str(point.number) for point in points])
        label = "number of the calibration (clock not sound)"
    plots: list[Markup] = []
    for axis in range(3):
        dots = [(float(k), each.bias[axis] / unit, each.sigma_use[axis] / unit) for k, each in enumerate(points)]
        plot = Plot(
            across,
            linear(_ends(dots), ticks=3),
            name=f"{name} {AXES[axis]}: bias against time",
            height=84.0,
            x_label=label if axis == 2 else None,
            y_label=f"{AXES[axis]}, {unit_name}",
        )
        plot.points(dots, CLASSES[axis])
        for point, (x, y, _) in zip(points, dots, strict=True):
            if point.number == this:
                plot.ring(x, y)
        plots.append(plot.svg())
    back = None if dated else "The companion's clock went back in between, so these stand in their order, not by time. "
    return tag("figure", *plots, tag("figcaption", back, "Bars: one sigma for the next minutes."))


def _ends(dots: Iterable[Dot]) -> list[float]:
    return [value + sign * by for _, value, by in dots for sign in (-1.0, 1.0)]


def arming_items(armings: Iterable[tuple[str, str, str]]) -> Markup:
    states = {"uncalibrated": tag("strong", "UNCALIBRATED: ", class_="bad"), "checked": "checked: "}
    return tag(
        "ul",
        *(tag("li", tag("strong", f"{moment(at)}: "), states.get(state), reason) for at, state, reason in armings),
    )


def biases_by_temperature(imus: Sequence[ByTemperature]) -> Markup:
    return tag("div", *(part for imu in imus for part in _curves(imu)))


def _curves(imu: ByTemperature) -> list[Child]:
    return [
        tag("h3", f"IMU {imu.imu}"),
        tag("p", f"{imu.summary}."),
        tag("p", f"{imu.needs}.") if imu.needs else None,
        tag("div", *(_figure(imu, triad) for triad in TRIADS), class_="pairs") if imu.points else None,
    ]


def _figure(imu: ByTemperature, triad: Triad) -> Markup | None:
    gyro = triad == "gyro"
    power_ups: dict[int, list[_Window]] = {}
    for one in imu.points:
        bias, sigma = (one.gyro_deg_h, one.sigma_deg_h) if gyro else (one.accel_mg, one.accel_sigma_mg)
        if bias is not None and sigma is not None:
            power_ups.setdefault(one.power_up, []).append((one.degc, bias, sigma))
    if not power_ups:
        return None
    seen = [dot for dots in power_ups.values() for dot in dots]
    rows: list[_Window] = [msgspec.structs.astuple(row) for row in (imu.curve if gyro else imu.accel_curve)]
    now = imu.now if gyro else None
    across = linear([*(degc for degc, _, _ in seen), *([now.degc] if now else [])], least=_LEAST_K)
    plots = []
    for axis in range(3):
        class_ = CLASSES[axis]
        curve = [(degc, bias[axis], 2.0 * sigma[axis]) for degc, bias, sigma in rows]
        dots = [(degc, bias[axis], sigma[axis]) for degc, bias, sigma in seen]
        plot = Plot(
            across,
            linear([*_ends((*dots, *curve)), *([now.gyro_deg_h[axis]] if now else [])], ticks=3),
            name=f"IMU {imu.imu}, {NAMES[triad].lower()} {AXES[axis]}: bias by temperature",
            told=f"{len(dots)} points, {min(b for _, b, _ in dots):+.1f} to {max(b for _, b, _ in dots):+.1f}.",
            height=110.0,
            x_label="temperature of the IMU, degC" if axis == 2 else "",
            y_label=_label(imu, triad, axis),
        )
        plot.area(curve, f"area {class_}")
        plot.line([(degc, value) for degc, value, _ in curve], f"curve {class_}")
        for number, each in power_ups.items():
            run = [(degc, bias[axis], sigma[axis]) for degc, bias, sigma in each]
            colour = class_ if number == imu.today else "past"
            plot.line([(degc, value) for degc, value, _ in run], f"run {colour}")
            plot.points(run, colour)
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
