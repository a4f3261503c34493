"""Builds the bias-over-temperature summary of one IMU."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from companion.estimation.records.history import Point, PowerUp, by_power_up
from companion.estimation.solution.by_temperature import ByTemperature, Expected, ExpectedForces, Seen
from companion.estimation.solution.prior import WEIGHS_FROM
from companion.estimation.temperature.curve import Curve
from companion.physics.units import DEG_H, MG
from companion.samples import Vector

STEP_K: Final = 1.0
"""Distance of the rows of a curve."""
MOST_ROWS: Final = 60
_ENOUGH_K: Final = 5.0
_DAY_S: Final = 86400.0


def by_temperature(
    name: str,
    points: Sequence[Point],
    curve: Curve | None,
    accel: Curve | None = None,
    *,
    power_up: PowerUp | None,
    now_degc: float | None = None,
    started_at: str = "",
) -> ByTemperature:
    """Put together what is shown.

    Args:
        name: of the IMU.
        points: all that are kept of it.
        curve: through them, of the gyros.
        accel: likewise of the accelerometers.
        power_up: this one; None: not known.
        now_degc: the temperature; None: not known, then it is that of the last window of this power-up.
        started_at: the calibration that is now, for who looks back; empty: the last window of this power-up.
    """
    told = [point for point in points if point.temperature_degc is not None and point.gyro is not None]
    groups = by_power_up(told)
    seen = [found for k, group in enumerate(groups) for point in group if (found := _seen(point, k)) is not None]
    same = (k for k, group in enumerate(groups) for p in group if power_up is not None and p.power_up.is_same(power_up))
    today = next(same, None)
    of_today = [one for one in seen if one.power_up == today and started_at in ("", one.started_at)]
    last = max(of_today, key=lambda one: one.at_unix_s, default=None)
    degc = now_degc if now_degc is not None or last is None else last.degc
    days = len({math.floor(one.at_unix_s / _DAY_S) for one in seen})
    return ByTemperature(
        imu=name,
        summary=_summary(seen, len(groups), days),
        power_ups=len(groups),
        days=days,
        points=tuple(sorted(seen, key=lambda one: one.at_unix_s)),
        curve=tuple(_expected(curve, step) for step in _steps(*curve.span_degc)) if curve is not None else (),
        accel_curve=tuple(_forces(accel, step) for step in _steps(*accel.span_degc)) if accel is not None else (),
        needs=None if curve is not None else _needs(len(points), len(groups), [one.degc for one in seen]),
        today=today,
        now=_moved(last, curve, degc) if last is not None and degc is not None else None,
        at_power_up=_expected(curve, degc) if curve is not None and degc is not None else None,
    )


def _seen(point: Point, power_up: int) -> Seen | None:
    if point.temperature_degc is None or point.gyro is None:
        return None
    return Seen(
        at_unix_s=round(point.unix_s),
        started_at=point.started_at,
        power_up=power_up,
        degc=point.temperature_degc,
        gyro_deg_h=_in(DEG_H, point.gyro.bias),
        sigma_deg_h=_in(DEG_H, point.gyro.sigma_use),
        accel_mg=_in(MG, point.accel.bias) if point.accel is not None else None,
        accel_sigma_mg=_in(MG, point.accel.sigma_use) if point.accel is not None else None,
    )


def _expected(curve: Curve, degc: float) -> Expected:
    bias, variance = curve.at(degc)
    return Expected(degc=round(degc, 2), gyro_deg_h=_in(DEG_H, bias), sigma_deg_h=_in(DEG_H, np.sqrt(variance)))


def _forces(curve: Curve, degc: float) -> ExpectedForces:
    bias, variance = curve.at(degc)
    return ExpectedForces(degc=round(degc, 2), accel_mg=_in(MG, bias), sigma_mg=_in(MG, np.sqrt(variance)))


def _moved(last: Seen, curve: Curve | None, degc: float) -> Expected:
    """The bias that was measured last, as it is at another temperature; where no curve tells, it stays with its own."""
    if curve is None:
        return Expected(degc=last.degc, gyro_deg_h=last.gyro_deg_h, sigma_deg_h=last.sigma_deg_h)
    change, variance = curve.change((last.degc, 0.0), (degc, 0.0))
    return Expected(
        degc=round(degc, 2),
        gyro_deg_h=_in(1.0, np.add(last.gyro_deg_h, change / DEG_H)),
        sigma_deg_h=_in(1.0, np.sqrt(np.square(last.sigma_deg_h) + variance / DEG_H**2)),
    )


def _steps(low: float, high: float) -> Iterable[float]:
    step = max(STEP_K, (high - low) / MOST_ROWS)
    inner = (step * k for k in range(math.floor(low / step) + 1, math.ceil(high / step)))
    return (low, *inner, high)


def _summary(seen: Sequence[Seen], power_ups: int, days: int) -> str:
    if not seen:
        return "nothing seen yet"
    degc = [one.degc for one in seen]
    span = f"{min(degc):.0f} to {max(degc):.0f} degC"
    return f"{_many(len(seen), 'still window')}, {_many(power_ups, 'power-up')} on {_many(days, 'day')}, {span}"


def _many(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _needs(known: int, power_ups: int, degc: Sequence[float]) -> str:
    if not degc:
        if known:
            return "its temperature is not known: no curve without a thermometer"
        return "ten still seconds at a known temperature are the first point"
    if power_ups < WEIGHS_FROM:
        return f"{power_ups} of {WEIGHS_FROM} power-ups seen; still seconds at other temperatures will draw a curve"
    if max(degc) - min(degc) >= _ENOUGH_K:
        return "no curve: its bias does not follow the temperature that it tells; another sensor's?"
    return f"only {max(degc) - min(degc):.0f} K seen; still seconds where it is warmer or colder will draw a curve"


def _in(unit: float, axes: Iterable[float]) -> Vector:
    x, y, z = (round(float(value) / unit, 3) for value in axes)
    return x, y, z
