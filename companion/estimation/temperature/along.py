"""What a curve says of one window whose temperature changes, and of the time when it is warm.

Where a warm-up will end says the present rate: a board that goes to its end as exp(-t / tau) has tau dT/dt to go, at
whatever temperature of the air, and tau is what earlier power-ups have shown.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Final

import msgspec
import numpy as np

from companion.estimation.temperature.curve import FEWEST, Curve, State
from companion.physics.frames import Array, vector
from companion.physics.statistics import MAD_TO_SIGMA
from companion.samples import Vector

_SLOWED_K_S: Final = 0.25 / 60.0
"""By less than that a warm-up that slows down tells nothing of where it ends."""
_LEAST: Final = 0.05
"""One sigma of tau, the least of it: boards have more than one."""
WARM_AFTER: Final = 5.0
"""So many tau."""
_TO_END: Final = (-1.0 / 6.0, -4.0 / 6.0, 5.0 / 6.0)
"""The last less the mean by Simpson's rule."""


class Warm(msgspec.Struct, frozen=True, kw_only=True):
    """When it will be warm; vehicle FRD, rad/s or m/s^2."""

    degc: float
    change: Vector
    """Of the bias, from the end of the window."""
    variance: Vector


class Along(msgspec.Struct, frozen=True, kw_only=True):
    """What the curve of one triad says of a window; vehicle FRD, rad/s or m/s^2, and those a second."""

    shift: Vector
    """From the mean over it to its end."""
    shift_variance: Vector
    slope: Vector
    slope_variance: Vector
    warm: Warm | None = None
    """None: nobody knows where it will end, or no power-up has been there."""

    def less(self, shift: Array, slope: Array) -> Along:
        """The same where somebody takes off so much by temperature: when warm, too, so that nothing is foretold."""
        if not shift.any() and not slope.any():
            return self
        return msgspec.structs.replace(
            self, shift=vector(self.shift - shift), slope=vector(self.slope - slope), warm=None
        )


class Settling(msgspec.Struct, frozen=True):
    """How slowly a board goes to its end."""

    tau_s: float
    sigma_s: float


def settling(power_ups: Iterable[Sequence[State]]) -> Settling | None:
    """Out of the states of earlier power-ups, in their order; None of too few.

    From where it rose fastest to the last one it has gained tau times by what it has slowed down.
    """
    found = []
    for states in power_ups:
        steepest, last = max(states, key=lambda state: state[1]), states[-1]
        slowed = steepest[1] - last[1]
        if slowed > _SLOWED_K_S and last[0] > steepest[0]:
            found.append((last[0] - steepest[0]) / slowed)
    if len(found) < FEWEST:
        return None
    tau = _middle(found)
    scatter = MAD_TO_SIGMA * _middle([abs(each - tau) for each in found])
    return Settling(tau, math.hypot(scatter, _LEAST * tau))


def _middle(values: Sequence[float]) -> float:
    return sorted(values)[len(values) // 2]


def along(
    curve: Curve,
    states: tuple[State, State, State],
    span_s: float,
    end_variance: float,
    settles: Settling | None,
    wander: float = 0.0,
) -> Along:
    """Of a window whose temperature was in these `states` at its beginning, in its middle and at its end.

    `end_variance`, K^2, is that of how far its end is from the mean, `wander` that of what the bias does by itself
    until it is warm.
    """
    start, _, end = states
    shift, of_shift = curve.moves(zip(_TO_END, states, strict=True))
    slope, of_slope = curve.change(start, end)
    by_end = np.square(_per_k(curve, end[0])) * end_variance
    return Along(
        shift=vector(shift),
        shift_variance=vector(of_shift + by_end),
        slope=vector(slope / span_s),
        # A line goes by half of its change from its middle to its end.
        slope_variance=vector(of_slope / span_s**2 + by_end * (2.0 / span_s) ** 2),
        warm=None if settles is None else _warm(curve, states, end_variance * (2.0 / span_s) ** 2, settles, wander),
    )


def _warm(curve: Curve, states: Sequence[State], k_s_variance: float, settles: Settling, wander: float) -> Warm | None:
    _, (middle_degc, k_s), end = states
    degc = middle_degc + settles.tau_s * k_s
    if curve.beyond_k(degc) > 0.0:
        return None
    change, variance = curve.change(end, (degc, 0.0))
    of_degc = (settles.sigma_s * k_s) ** 2 + settles.tau_s**2 * k_s_variance
    return Warm(
        degc=degc, change=vector(change), variance=vector(variance + wander + np.square(_per_k(curve, degc)) * of_degc)
    )


def _per_k(curve: Curve, degc: float) -> Array:
    return curve.change((degc - 0.5, 0.0), (degc + 0.5, 0.0))[0]
