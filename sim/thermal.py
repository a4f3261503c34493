"""Self-heating of a board, and a bias that follows the board's temperature: for aircraft, and for studies of days.

A piece of a part keeps its curve and its usual bias all its life; every power-up adds an offset of its own. The die is
as warm as its thermometer was a moment before, so that heating and cooling differ.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from sim.earth import Array

_BEND_K: Final = 40.0
"""Kelvin from the reference at which linear, square and cubic terms of a drawn curve have equal sigmas."""
LAG_S: Final = (5.0, 30.0)
RISE_K: Final = (10.0, 25.0)
TIME_CONSTANT_S: Final = (100.0, 600.0)


def warming(start_degc: float, end_degc: float, time_constant_s: float) -> Callable[[float], float]:
    """Return a temperature that approaches `end_degc` exponentially, as in a box that was just switched on."""
    return lambda t_s: end_degc + (start_degc - end_degc) * math.exp(-max(t_s, 0.0) / time_constant_s)


@dataclass(frozen=True, slots=True)
class ThermalBoard:
    """Self-heating of a board above the air's temperature, and its time constant."""

    rise_k: float
    time_constant_s: float

    @classmethod
    def drawn(cls, random: np.random.Generator) -> ThermalBoard:
        """Draw a typical board of a small aircraft."""
        time_constant_s = random.uniform(*TIME_CONSTANT_S)
        return cls(random.uniform(*RISE_K), time_constant_s)

    def switched_on(self, air_degc: float, cold: float = 1.0) -> Callable[[float], float]:
        """Return temperature in degC as a function of seconds since power-on; `cold` is 0 for a board already warm."""
        return warming(air_degc + (1.0 - cold) * self.rise_k, air_degc + self.rise_k, self.time_constant_s)


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """Bias as a function of temperature, in kelvin from the part's reference temperature.

    Attributes:
        powers: coefficients (n,) of n axes: of the kelvin, their square, their cube.
        lag_s: lag of the die behind its thermometer.
    """

    powers: tuple[Array, ...]
    lag_s: float = 0.0

    def at(self, kelvin: float | Array) -> Array:
        """Return the bias (n,) at one temperature, or (m, n) at m temperatures (m, 1)."""
        found: Array = self.powers[-1] * kelvin
        for each in self.powers[-2::-1]:
            found = (found + each) * kelvin
        return found


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """One piece of a part: three gyros, or three gyros and three accelerometers.

    Attributes:
        curve: curve of its biases.
        usual: bias (n,) at the reference temperature, mean of all power-ups.
        scatter: one sigma (n,) from power-up to power-up.
    """

    curve: Curve
    usual: Array
    scatter: Array

    @classmethod
    def drawn(cls, random: np.random.Generator, usual: Array, scatter: Array, per_kelvin: Array) -> Piece:
        """Draw a piece whose slopes are normal with these sigmas (n,)."""
        powers = random.normal(0.0, 1.0, (3, len(per_kelvin))) * per_kelvin
        curve = Curve((powers[0], powers[1] / _BEND_K, powers[2] / _BEND_K**2), random.uniform(*LAG_S))
        return cls(curve, usual, scatter)

    def turned_on(self, random: np.random.Generator) -> Array:
        """Draw the biases (n,) at the reference temperature for one more power-up."""
        return np.asarray(random.normal(self.usual, self.scatter))
