"""HTML and SVG plots, built from parts: plain text is escaped, markup made here is not.

Names, reasons and warnings come from files and from the autopilot. None of them may become a tag, and no invisible
character may turn the reading direction of other text. The x, y and z series have the classes `sx`, `sy` and `sz`: the
style sheet has their colours, and the shapes of their markers differ too.
"""

from __future__ import annotations

import datetime
import html
import math
import re
from collections.abc import Sequence
from typing import Final

import msgspec

MAX_TEXT: Final = 600
"""Most characters in one piece of text, so that no file can make a page too large."""

# Controls (except line breaks and tabs), marks of text direction, zero-width characters, unpaired surrogates.
_INVISIBLE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u202a-\u202e\u2060-\u2069\ufeff\ud800-\udfff]")
_VOID: Final = frozenset({"meta", "path", "line", "rect", "circle", "br"})

WIDTH: Final = 360.0
_LEFT, _RIGHT, _TOP, _TITLE = 58.0, 12.0, 8.0, 20.0
_TICKS_HEIGHT, _LABEL_HEIGHT = 20.0, 16.0
_MARK: Final = 3.6
_MOST: Final = 1e12

Pair = tuple[float, float]
Dot = tuple[float, float, float]
"""Data point of a plot: x, y, and half the length of the error bar in y, in the units of the axes."""


class Markup(str):
    __slots__ = ()


Child = str | None
"""Content of an HTML element: a plain `str` is escaped, `Markup` is used unchanged, None adds nothing."""


def text(words: str) -> Markup:
    if isinstance(words, Markup):
        return words
    if len(words) > MAX_TEXT:
        words = words[:MAX_TEXT] + "…"
    return Markup(html.escape(_INVISIBLE.sub("\ufffd", words), quote=True))


def join(*children: Child) -> Markup:
    return Markup("".join(text(child) for child in children if child is not None))


def tag(element: str, /, *children: Child, **attributes: str | float | None) -> Markup:
    """Make an HTML element. In attribute names, `class_` means class and _ means a dash; None omits the attribute."""
    given = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{text(value if isinstance(value, str) else str(value))}"'
        for key, value in attributes.items()
        if value is not None
    )
    if element in _VOID:
        return Markup(f"<{element}{given}>" if element in {"meta", "br"} else f"<{element}{given}/>")
    return Markup(f"<{element}{given}>{join(*children)}</{element}>")


def row(*cells: Child, class_: str | None = None) -> Markup:
    return tag("tr", *(one if isinstance(one, Markup | None) else tag("td", one) for one in cells), class_=class_)


# --- plots


class Axis(msgspec.Struct, frozen=True):
    low: float
    high: float
    ticks: tuple[tuple[float, str], ...]

    def share(self, value: float) -> float:
        return min(max((value - self.low) / (self.high - self.low), 0.0), 1.0)


def linear(values: Sequence[float], *, ticks: int = 4, least: float = 0.0) -> Axis:
    """Make a linear axis around the values, at least `least` wide, so that tiny scatter does not fill the plot."""
    known = [value for value in values if abs(value) < _MOST] or [0.0]
    low, high = min(known), max(known)
    width = max(high - low, least, 1e-4 * max(abs(low), abs(high)), 1e-9)
    middle = (low + high) / 2.0
    low, high = middle - 0.56 * width, middle + 0.56 * width
    step = _nice((high - low) / ticks)
    if step > (high - low) / 2.0:  # a single tick would show no scale
        step = _nice(step / 2.6)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    first = math.ceil(low / step - 1e-9)
    places = [k * step for k in range(first, math.floor(high / step + 1e-9) + 1)]
    return Axis(low, high, tuple((place, f"{place:.{digits}f}") for place in places))


def in_order(labels: Sequence[str]) -> Axis:
    every = math.ceil(len(labels) / 4)
    ticks = tuple((float(k), labels[k]) for k in range(0, len(labels), every))
    return Axis(-0.5, len(labels) - 0.5, ticks)


def dates(values: Sequence[float]) -> Axis:
    """Make an axis of UTC times (s since 1970) at equal distances, labelled with dates or, within one day, times."""
    moments = [datetime.datetime.fromtimestamp(value, tz=datetime.UTC) for value in values]
    form = "%H:%M" if len({each.date() for each in moments}) == 1 else "%-d %b %y"
    return in_order([each.strftime(form) for each in moments])


def _nice(step: float) -> float:
    power = 10.0 ** math.floor(math.log10(step))
    return power * next(mark for mark in (1.0, 2.0, 5.0, 10.0) if step <= mark * power * 1.25)


class Plot:
    """SVG plot in one frame with axes. Markers cover lines and areas; otherwise later shapes cover earlier ones.

    `x_label`: "" for ticks without a label; None for neither ticks nor label, as in a plot above another plot. `name`
    and `told` are title and description for a screen reader.
    """

    def __init__(
        self,
        x: Axis,
        y: Axis,
        *,
        name: str,
        told: str = "",
        height: float,
        x_label: str | None = None,
        y_label: str = "",
    ) -> None:
        self._top = _TOP + (_TITLE if y_label else 0.0)
        self._x, self._y, self._name, self._told, self._height = x, y, name, told, height
        self._x_label, self._y_label = x_label, y_label
        self._below: list[Markup] = []
        self._parts: list[Markup] = []

    def at(self, x: float, y: float) -> Pair:
        across = _LEFT + self._x.share(x) * (WIDTH - _LEFT - _RIGHT)
        return across, self._top + (1.0 - self._y.share(y)) * self._height

    def line(self, points: Sequence[Pair], class_: str) -> None:
        if len(points) > 1:
            self._below.append(_path(self._course(points), class_))

    def area(self, dots: Sequence[Dot], class_: str) -> None:
        if len(dots) > 1:
            around = [*((x, y - by) for x, y, by in dots), *((x, y + by) for x, y, by in reversed(dots))]
            self._below.append(_path(f"{self._course(around)}z", class_))

    def _course(self, points: Sequence[Pair]) -> str:
        return "M" + "L".join(_xy(*self.at(*point)) for point in points)

    def upright(self, x: float, class_: str) -> None:
        self._below.append(_path(f"M{_xy(*self.at(x, self._y.low))}V{_n(self._top)}", class_))

    def points(self, dots: Sequence[Dot], class_: str) -> None:
        """Draw a marker with error bar at each data point: a square for class `sy`, triangle for `sz`, else circle."""
        ends = [(self.at(x, y - by), self.at(x, y + by)) for x, y, by in dots]
        bars = [f"M{_xy(*bottom)}V{_n(top)}" for bottom, (_, top) in ends]
        self._parts.append(_path("".join(bars), f"bar {class_}"))
        places = [self.at(x, y) for x, y, _ in dots]
        if class_ not in {"sy", "sz"}:
            # A circle is drawn as a line without length and with round caps: a quarter of the characters.
            self._parts.append(_path("".join(f"M{_xy(*place)}h.01" for place in places), f"dot {class_}"))
            return
        marker = _square if class_ == "sy" else _triangle
        self._parts.append(_path("".join(marker(*place) for place in places), f"mark {class_}"))

    def ring(self, x: float, y: float) -> None:
        across, height = self.at(x, y)
        self._parts.append(tag("circle", cx=_n(across), cy=_n(height), r=8, class_="ring"))

    def svg(self) -> Markup:
        bottom = self._top + self._height
        below = 6.0 if self._x_label is None else _TICKS_HEIGHT + _LABEL_HEIGHT * bool(self._x_label)
        grid: list[Markup] = []
        for place, label in self._x.ticks:
            across = self.at(place, self._y.low)[0]
            grid.append(_path(f"M{_n(across)} {_n(self._top)}V{_n(bottom)}", "grid"))
            if self._x_label is not None:
                grid.append(tag("text", label, x=_n(across), y=_n(bottom + 15.0), class_="mid"))
        for place, label in self._y.ticks:
            height = self.at(self._x.low, place)[1]
            grid.append(_path(f"M{_n(_LEFT)} {_n(height)}H{_n(WIDTH - _RIGHT)}", "grid"))
            grid.append(tag("text", label, x=_n(_LEFT - 6.0), y=_n(height + 4.5), class_="end"))
        frame = tag(
            "rect", x=_n(_LEFT), y=_n(self._top), width=_n(WIDTH - _LEFT - _RIGHT), height=_n(self._height),
            class_="frame",
        )  # fmt: skip
        labels: list[Markup] = []
        if self._x_label:
            middle = (_LEFT + WIDTH - _RIGHT) / 2.0
            labels.append(tag("text", self._x_label, x=_n(middle), y=_n(bottom + 31.0), class_="mid label"))
        if self._y_label:
            labels.append(tag("text", self._y_label, x="0", y=_n(self._top - 8.0), class_="label"))
        return tag(
            "svg",
            tag("title", self._name),
            tag("desc", self._told) if self._told else None,
            *grid,
            frame,
            *self._below,
            *self._parts,
            *labels,
            viewBox=f"0 0 {_n(WIDTH)} {_n(bottom + below)}",
            role="img",
            class_="plot",
        )


def _path(course: str, class_: str) -> Markup:
    return tag("path", d=Markup(course), class_=class_)


def _square(x: float, y: float) -> str:
    side = 1.8 * _MARK
    return f"M{_xy(x - side / 2, y - side / 2)}h{_n(side)}v{_n(side)}h{_n(-side)}z"


def _triangle(x: float, y: float) -> str:
    return f"M{_xy(x, y - 1.25 * _MARK)}l{_xy(1.15 * _MARK, 2.1 * _MARK)}h{_n(-2.3 * _MARK)}z"


def _xy(x: float, y: float) -> str:
    return f"{_n(x)} {_n(y)}"


def _n(value: float) -> str:
    found = f"{value:.1f}"
    return found.removesuffix(".0") if found != "-0.0" else "0"
