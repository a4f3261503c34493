"""What the pages show of IMUs: one's biases over temperature."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import msgspec
import sqlalchemy as sa

from companion.calibration.solution.by_temperature import ByTemperature, Seen
from companion.fleet.contract import Curve
from companion.fleet.schema import items
from companion.report.by_temperature import biases_by_temperature
from companion.report.markup import Markup

_CURVES: Final = 16
"""The latest that are looked at, of all IMUs of an aircraft."""


class Told(msgspec.Struct, frozen=True):
    """An item."""

    at: str
    body: Curve


def curves(connection: sa.Connection, which: str) -> dict[str, Told]:
    """The latest curve over temperature of each IMU of an aircraft."""
    query = (
        sa.select(items.c.payload)
        .where(items.c.aircraft == which, items.c.kind == "curve", items.c.state == "taken")
        .order_by(items.c.received_at.desc(), items.c.sequence.desc())
        .limit(_CURVES)
    )
    found: dict[str, Told] = {}
    for payload in connection.execute(query).scalars():
        try:
            told = msgspec.json.decode(payload, type=Told)
        except (msgspec.MsgspecError, RecursionError):
            continue
        found.setdefault(told.body.imu, told)
    return found


def by_temperature(told: Told | None, points: Sequence[Seen]) -> Markup | None:
    """Its curve, and what its calibrations have found."""
    if told is None:
        return None
    curve = told.body
    shown = ByTemperature(
        imu=f"{curve.imu} by temperature",
        summary=f"From {curve.power_ups} power-ups on {curve.days} days, as told {told.at[:10]}",
        power_ups=curve.power_ups,
        days=curve.days,
        points=tuple(points),
        curve=curve.curve,
        accel_curve=curve.accel_curve,
        needs=None,
        today=None,
        now=None,
        at_power_up=None,
    )
    return biases_by_temperature([shown], looking_back=True)
