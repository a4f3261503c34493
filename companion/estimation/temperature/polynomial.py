"""Bias over temperature as firmwares compensate it: a cubic in an IMU's own axes, constant beyond its span."""

from __future__ import annotations

import math
from typing import Final

import msgspec
import numpy as np

from companion.estimation.temperature.curve import REFERENCE_DEGC, UNIT_K, Curve
from companion.physics.frames import Array, Matrix, vector
from companion.samples import Vector

ZERO: Vector = (0.0, 0.0, 0.0)


class Polynomial(msgspec.Struct, frozen=True, kw_only=True):
    """c0 + c1 d + c2 d^2 + c3 d^3; d: the temperature, limited to the span, less the reference."""

    coefficients: tuple[Vector, Vector, Vector, Vector] = (ZERO, ZERO, ZERO, ZERO)
    """Constant first; rad/s or m/s^2 and per kelvin, square kelvin, cubic kelvin."""
    reference_degc: float = REFERENCE_DEGC
    low_degc: float = -math.inf
    high_degc: float = math.inf

    def at(self, degc: float) -> Array:
        """Return the bias at a temperature, (3,)."""
        d = min(max(degc, self.low_degc), self.high_degc) - self.reference_degc
        c0, c1, c2, c3 = np.array(self.coefficients)
        value: Array = c0 + (c1 + (c2 + c3 * d) * d) * d
        return value

    def zero_at(self, degc: float) -> Polynomial:
        """Return the polynomial with the constant that makes it zero at this temperature."""
        c0, *others = self.coefficients
        first, second, third = others
        constant = vector(np.subtract(c0, self.at(degc)))
        return msgspec.structs.replace(self, coefficients=(constant, first, second, third))


NOTHING: Final = Polynomial()


def of_curve(curve: Curve, orientation: Matrix, scale: Vector = (1.0, 1.0, 1.0)) -> Polynomial:
    """Convert a curve, over the span that was seen; zero at the reference.

    The lag is left out: no firmware knows of one.

    Args:
        curve: in the vehicle's axes.
        orientation: 3x3, the IMU's axes to the vehicle's.
        scale: factor that the firmware applies to the IMU's output afterwards.
    """
    low, high = curve.span_degc
    terms = np.zeros((4, 3))
    found = curve.coefficients[1:]
    terms[1 : 1 + len(found)] = found @ orientation / scale / UNIT_K ** np.arange(1.0, 1.0 + len(found))[:, None]
    _, first, second, third = map(vector, terms)
    return Polynomial(coefficients=(ZERO, first, second, third), low_degc=low, high_degc=high)
