"""Factors from the field's units to SI, and the units in which gyros and accelerometers are shown."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from companion.samples import Triad

DEG: Final = math.pi / 180.0

DEG_H: Final = math.pi / 180.0 / 3600.0

G: Final = 9.80665

MG: Final = 9.80665e-3


class Unit(NamedTuple):
    si: float
    name: str
    digits: int


UNITS: Final[dict[Triad, Unit]] = {"gyro": Unit(DEG_H, "deg/h", 0), "accel": Unit(MG, "mg", 1)}


def unit_of(axis: str) -> Unit:
    return UNITS["gyro" if axis.startswith("gyro") else "accel"]
