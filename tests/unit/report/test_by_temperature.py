"""Biases over temperature as drawn: read off the plots again by their own axes, and compared with what went in."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from xml.etree import ElementTree

import msgspec
import numpy as np
import pytest

from companion.cli.show import temperature_lines
from companion.estimation.noise.allan import PROFILES
from companion.estimation.records.history import Point
from companion.estimation.solution.by_temperature import ByTemperature, by_temperature
from companion.estimation.solution.prior import curve_of
from companion.physics.units import DEG_H
from companion.report.page import biases_by_temperature
from tests.support.histories import OFFSET_DEG_H, gyro_deg_h_at, windows_of_days

MODEL, ACCEL_MODEL = PROFILES["icm42688p"].gyro, PROFILES["icm42688p"].accel


def learned(points: Sequence[Point], now_degc: float | None = None) -> ByTemperature:
    return by_temperature(
        "fc", points, curve_of(points, "gyro", MODEL), curve_of(points, "accel", ACCEL_MODEL),
        power_up=points[-1].power_up, now_degc=now_degc,
    )  # fmt: skip


def line_through(ticks: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Slope and offset, of (place, value)."""
    slope, offset = np.polyfit([place for place, _ in ticks], [value for _, value in ticks], 1).tolist()
    return slope, offset


class Drawn:
    """One plot, as somebody with a ruler reads it."""

    def __init__(self, svg: ElementTree.Element, across: tuple[float, float]) -> None:
        self._svg, self._across = svg, across
        ticks = [
            (float(it.get("y", "")) - 4.5, float(it.text or "")) for it in svg.iter("text") if it.get("class") == "end"
        ]
        self._up = line_through(ticks)
        self.words = " ".join(it.text or "" for it in svg.iter())

    def at(self, x: float, y: float) -> tuple[float, float]:
        return self._across[0] * x + self._across[1], self._up[0] * y + self._up[1]

    @property
    def unit(self) -> float:
        """Value of a tenth of a unit of the picture, with the ticks' own tenths."""
        return 0.4 * abs(self._up[0])

    def paths(self, class_: str) -> list[list[tuple[float, float]]]:
        return [
            [self.at(float(x), float(y)) for x, y in re.findall(r"(-?[\d.]+) (-?[\d.]+)", it.get("d", ""))]
            for it in self._svg.iter("path")
            if it.get("class", "").startswith(class_)
        ]

    def ring(self) -> tuple[float, float]:
        (it,) = self._svg.iter("circle")
        return self.at(float(it.get("cx", "")), float(it.get("cy", "")))


def plots(imu: ByTemperature) -> Iterator[list[Drawn]]:
    """Yield the three axes of each triad; the ticks of the temperature stand below the third."""
    root = ElementTree.fromstring(biases_by_temperature([imu]))  # noqa: S314 - our own
    for figure in root.iter("figure"):
        svgs = list(figure.iter("svg"))
        ticks = [
            (float(it.get("x", "")), float(it.text or "")) for it in svgs[-1].iter("text") if it.get("class") == "mid"
        ]
        yield [Drawn(svg, line_through(ticks)) for svg in svgs]


def test_points_curve_band_and_now_lie_where_their_values_are() -> None:
    points = windows_of_days(10)
    imu = learned(points, now_degc=30.0)
    gyros, _ = plots(imu)
    assert imu.now is not None
    for axis, drawn in enumerate(gyros):
        (curve,), (band,) = drawn.paths("curve"), drawn.paths("area")
        assert (curve[0][0], curve[-1][0]) == pytest.approx((8.0, 38.0), abs=0.1)
        for row, (degc, value) in zip(imu.curve, curve, strict=True):
            assert value == pytest.approx(gyro_deg_h_at(degc)[axis], abs=2.0 * row.sigma_deg_h[axis])
            assert row.sigma_deg_h[axis] < 2.0 * OFFSET_DEG_H
        low, high = band[: len(curve)], band[len(curve) :][::-1]
        for row, (_, below), (_, above) in zip(imu.curve, low, high, strict=True):
            assert above - below == pytest.approx(4.0 * row.sigma_deg_h[axis], abs=2.0 * drawn.unit)
        if axis == 0:  # the others' markers are drawn from a corner
            dots = [dot for path in drawn.paths("dot") for dot in path]
            assert len(dots) == len(points)
            for point in points:
                assert point.gyro is not None
                at = (point.temperature_degc or 0.0, point.gyro.bias[axis] / DEG_H)
                assert any(np.allclose(dot, at, rtol=0.0, atol=(0.1, drawn.unit)) for dot in dots), at
        degc, value = drawn.ring()
        assert degc == pytest.approx(30.0, abs=0.1)
        assert value == pytest.approx(imu.now.gyro_deg_h[axis], abs=drawn.unit)
        (dashes,) = drawn.paths("now")
        assert dashes[0][0] == pytest.approx(30.0, abs=0.1)


@pytest.mark.parametrize(
    ("points", "words"),
    [
        ([], "ten still seconds at a known temperature are the first point"),
        (windows_of_days(2), "2 of 5 power-ups seen; still seconds at other temperatures will draw a curve"),
        (
            windows_of_days(6, 1, step_k=0.0),
            "only 0 K seen; still seconds where it is warmer or colder will draw a curve",
        ),
        (
            [msgspec.structs.replace(point, temperature_degc=None) for point in windows_of_days(6)],
            "its temperature is not known: no curve without a thermometer",
        ),
    ],
)
def test_where_little_was_learned_a_line_says_what_is_needed(points: list[Point], words: str) -> None:
    imu = by_temperature("fc", points, curve_of(points, "gyro", MODEL), power_up=None)
    assert imu.needs == words
    assert words in biases_by_temperature([imu])
    assert temperature_lines([msgspec.to_builtins(imu)])[-1] == f"    {words}"
