"""Biases over temperature as drawn: read off the plots again by their own axes, and compared with what went in."""

from __future__ import annotations

import datetime
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
from companion.physics.units import DEG_H, MG
from companion.report.by_temperature import biases_by_temperature
from tests.support.histories import OFFSET_DEG_H, gyro_deg_h_at, windows_of_days

NOW = datetime.datetime(2026, 6, 1, 12, 0, tzinfo=datetime.UTC)
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
        """What a tenth of a unit of the picture is worth, with the ticks' own tenths."""
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
    """Of each triad the three axes; the ticks of the temperature stand below the third."""
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


def test_the_accelerometers_curve_is_drawn_where_it_was_shown() -> None:
    slope_mg = np.array([0.3, -0.2, 0.1])

    def warmer(point: Point) -> Point:
        assert point.accel is not None
        assert point.temperature_degc is not None
        bias = np.array(point.accel.bias) + slope_mg * (point.temperature_degc - 25.0) * MG
        return msgspec.structs.replace(point, accel=msgspec.structs.replace(point.accel, bias=tuple(bias.tolist())))

    _, forces = plots(learned([warmer(point) for point in windows_of_days(10)]))
    for axis, drawn in enumerate(forces):
        (curve,), (_,) = drawn.paths("curve"), drawn.paths("area")
        (low, first), *_, (high, last) = curve
        assert (low, high) == pytest.approx((8.0, 38.0), abs=0.1)
        assert (last - first) / (high - low) == pytest.approx(slope_mg[axis], abs=0.02)


def test_what_is_now_is_the_last_window_moved_along_the_curve() -> None:
    points = windows_of_days(10)
    imu = learned(points, now_degc=30.0)
    last = points[-1]
    assert (imu.now, imu.today) != (None, None)
    assert imu.now is not None
    assert imu.at_power_up is not None
    assert last.gyro is not None
    assert last.temperature_degc is not None
    moved = np.array(last.gyro.bias) / DEG_H + gyro_deg_h_at(30.0) - gyro_deg_h_at(last.temperature_degc)
    assert (np.abs(imu.now.gyro_deg_h - moved) < 2.0 * np.array(imu.now.sigma_deg_h)).all()
    assert max(imu.now.sigma_deg_h) < 7.0
    np.testing.assert_allclose(imu.at_power_up.gyro_deg_h, gyro_deg_h_at(30.0), atol=2.0 * OFFSET_DEG_H)
    assert min(imu.at_power_up.sigma_deg_h) > 0.6 * OFFSET_DEG_H


def test_windows_of_one_power_up_are_joined_and_this_one_stands_out() -> None:
    gyros, accelerometers = plots(learned(windows_of_days(6, windows=4)))
    for drawn in (*gyros, *accelerometers):
        assert [len(run) for run in drawn.paths("run")] == [4] * 6
        assert len(drawn.paths("run past")) == 5


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
