"""Biases of one IMU over temperature, for the terminal, the web page and reports.

This module imports no numpy, because the web page's process reads its types.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Final

import msgspec

from companion.estimation.records.history import WEIGHS_FROM, Point, PowerUp, by_power_up
from companion.physics.units import DEG_H, MG
from companion.samples import Vector

if TYPE_CHECKING:
    from companion.estimation.solution.curve import Curve

STEP_K: Final = 1.0  # Distance between the rows of a curve
MOST_ROWS: Final = 60
_ENOUGH_K: Final = 5.0
"""Least range of measured temperatures, K, at which a curve is expected (method.md section 3.3)."""
_DAY_S: Final = 86400.0


class WindowBias(msgspec.Struct, frozen=True, kw_only=True):
    """Biases of one IMU from one motionless window, in vehicle axes (FRD), each with one sigma.

    `started_at` identifies the calibration that used the window; it is empty if no calibration used it.
    """

    at_unix_s: float
    started_at: str
    power_up: int  # Number of the power-up, from 0
    degc: float
    gyro_deg_h: Vector
    sigma_deg_h: Vector
    accel_mg: Vector | None  # None: the tilt was unknown
    accel_sigma_mg: Vector | None


class Expected(msgspec.Struct, frozen=True):
    """Expected gyro biases at one temperature, each with one sigma."""

    degc: float
    gyro_deg_h: Vector
    sigma_deg_h: Vector


class ExpectedForces(msgspec.Struct, frozen=True):
    """Expected accelerometer biases at one temperature, each with one sigma."""

    degc: float
    accel_mg: Vector
    sigma_mg: Vector


class ByTemperature(msgspec.Struct, frozen=True, kw_only=True):
    """Summary of one IMU's biases over temperature: measured windows and fitted curves."""

    imu: str
    summary: str = ""
    power_ups: int = 0
    days: int = 0
    points: tuple[WindowBias, ...] = ()
    curve: tuple[Expected, ...]  # Expected gyro biases of the next power-up; empty: no curve yet
    accel_curve: tuple[ExpectedForces, ...] = ()
    """Expected accelerometer biases of the next power-up, one row per temperature; empty while there is no curve."""
    needs: str | None = None  # Reason why there is no curve, and the remedy; None: there is one
    today: int | None = None  # Number of the present power-up; None: no window of it yet
    now: Expected | None = None  # Present bias: last measured in this power-up, then moved along the curve
    at_power_up: Expected | None = None  # Bias that the curve predicts for a power-up at the present temperature


def by_temperature(
    name: str,
    points: Sequence[Point],
    curve: Curve | None,
    accel: Curve | None = None,
    *,
    power_up: PowerUp | None,
    now_degc: float | None = None,
) -> ByTemperature:
    """Summarise one IMU's biases over temperature from its bias history and the curves fitted to the history.

    `power_up` is the present one, if known. Without `now_degc`, the temperature of its last window is used.
    """
    groups = by_power_up([point for point in points if point.temperature_degc is not None and point.gyro is not None])
    seen = [_window(point, k) for k, group in enumerate(groups) for point in group]
    same = (k for k, group in enumerate(groups) for p in group if power_up is not None and p.power_up.is_same(power_up))
    today = next(same, None)
    last = max((one for one in seen if one.power_up == today), key=lambda one: one.at_unix_s, default=None)
    degc = now_degc if now_degc is not None or last is None else last.degc
    degcs = [one.degc for one in seen]
    days = len({math.floor(one.at_unix_s / _DAY_S) for one in seen})
    windows = f"{_many(len(seen), 'still window')}, {_many(len(groups), 'power-up')} on {_many(days, 'day')}"
    return ByTemperature(
        imu=name,
        summary=f"{windows}, {min(degcs):.0f} to {max(degcs):.0f} degC" if degcs else "nothing seen yet",
        power_ups=len(groups),
        days=days,
        points=tuple(sorted(seen, key=lambda one: one.at_unix_s)),
        curve=() if curve is None else tuple(Expected(*_at(curve, step, DEG_H)) for step in _steps(curve)),
        accel_curve=() if accel is None else tuple(ExpectedForces(*_at(accel, step, MG)) for step in _steps(accel)),
        needs=None if curve is not None else _needs(len(points), len(groups), degcs),
        today=today,
        now=None if last is None or degc is None else _moved(last, curve, degc),
        at_power_up=None if curve is None or degc is None else Expected(*_at(curve, degc, DEG_H)),
    )


def _window(point: Point, power_up: int) -> WindowBias:
    gyro, accel = point.measured("gyro"), point.accel
    assert point.temperature_degc is not None
    return WindowBias(
        at_unix_s=round(point.unix_s),
        started_at=point.started_at,
        power_up=power_up,
        degc=point.temperature_degc,
        gyro_deg_h=_in(DEG_H, gyro.bias),
        sigma_deg_h=_in(DEG_H, gyro.sigma_use),
        accel_mg=None if accel is None else _in(MG, accel.bias),
        accel_sigma_mg=None if accel is None else _in(MG, accel.sigma_use),
    )


def _at(curve: Curve, degc: float, unit: float) -> tuple[float, Vector, Vector]:
    bias, variance = curve.at(degc)
    return round(degc, 2), _in(unit, bias), _in(unit, map(math.sqrt, variance))


def _moved(last: WindowBias, curve: Curve | None, degc: float) -> Expected:
    if curve is None:
        return Expected(last.degc, last.gyro_deg_h, last.sigma_deg_h)
    change, variance = curve.change((last.degc, 0.0), (degc, 0.0))
    sigma = map(math.hypot, last.sigma_deg_h, map(math.sqrt, variance / DEG_H**2))
    return Expected(round(degc, 2), _in(1.0, last.gyro_deg_h + change / DEG_H), _in(1.0, sigma))


def _steps(curve: Curve) -> Iterable[float]:
    low, high = curve.span_degc
    step = max(STEP_K, (high - low) / MOST_ROWS)
    inner = (step * k for k in range(math.floor(low / step) + 1, math.ceil(high / step)))
    return (low, *inner, high)


def _many(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _needs(known: int, power_ups: int, degc: Sequence[float]) -> str:
    if not degc:
        if known:
            return "its temperature is not known: no curve without a thermometer"
        return "ten still seconds at a known temperature are the first point"
    if power_ups < WEIGHS_FROM:
        return f"{power_ups} of {WEIGHS_FROM} power-ups seen; still seconds at other temperatures will draw a curve"
    span_k = max(degc) - min(degc)
    if span_k >= _ENOUGH_K:
        return "no curve: its bias does not follow the temperature that it tells; another sensor's?"
    return f"only {span_k:.0f} K seen; still seconds where it is warmer or colder will draw a curve"


def _in(unit: float, axes: Iterable[float]) -> Vector:
    x, y, z = (round(float(value) / unit, 3) for value in axes)
    return x, y, z
