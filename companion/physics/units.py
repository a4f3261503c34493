"""Factors from customary units (degrees, mg) to SI, and the units in which biases are shown."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from companion.samples import Triad

DEG: Final = math.pi / 180.0  # rad per degree

DEG_H: Final = math.pi / 180.0 / 3600.0  # rad/s per degree per hour

G: Final = 9.80665  # m/s^2 per g of the standard gravity

MG: Final = 9.80665e-3  # m/s^2 per milli-g of the standard gravity, the unit in which accelerometers are specified


class Unit(NamedTuple):
    si: float  # The unit in SI units
    name: str
    digits: int  # Decimals shown for a bias


UNITS: Final[dict[Triad, Unit]] = {"gyro": Unit(DEG_H, "deg/h", 0), "accel": Unit(MG, "mg", 1)}


def unit_of(axis: str) -> Unit:
    return UNITS["gyro" if axis.startswith("gyro") else "accel"]
