"""What a warm-up that a window is too short to show may still do to the bias in the next minute.

A slope s moves the mean over the next minute by s (T + 60 s) / 2 from that over T. White noise hides slopes below some
t of 5 (`robust.is_ramp`), in 10 s of a noisy gyro 80 (deg/h)/s. So what is known of s counts: the line through the
window with its standard error, and before it how fast the part may be warming. A box that was switched on goes up by
`WARM_UP_K` in an unknown time constant, and whatever that is, at an age t it warms by at most WARM_UP_K / (e t); a
thermometer says how fast it really does. Both are Gaussian here, and so is what they leave of s.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np

from companion.calibration.noise.allan import WARM_UP_K
from companion.calibration.seconds.batch import Batch
from companion.physics.frames import Floats, Matrix, vector
from companion.physics.units import DEG_H
from companion.samples import Vector

QUICKEST_S: Final = 60.0
"""The shortest time constant of a warm-up: boards take 1 to 20 min."""
NEXT_S: Final = 60.0
"""So far ahead an unseen slope is believed to go on."""
_LATER_S: Final = (120.0, 600.0, 3600.0)
"""Ages at which to say what sigma will be."""
_WORTH_WAITING: Final = 2.0 / 3.0
"""Of the present sigma: what is no better than that is no reason to wait."""
_FEWEST: Final = 3
_NOTHING: Final = 1.0
"""Variance of a slope of which the window tells nothing, (rad/s^2)^2 or (m/s^3)^2: beyond every warm-up."""
_OF_STEPS: Final = math.sqrt(3.0)
"""One sigma of a slope over T by readings that are off by at most A is sqrt(3) A / T; its largest is 3 A / T."""
_STEPS_K: Final = (1.0, 0.5, 0.25, 0.1, 0.05, 0.01)
"""Resolutions of thermometers, coarse ones first."""


class Warming(msgspec.Struct, frozen=True, kw_only=True):
    """What one window tells of slopes; vehicle FRD, rad/s^2 and m/s^3."""

    gyro_slope: Vector
    """Zero, with a variance of zero, where a ramp was seen: its end is the mean then."""
    gyro_variance: Vector
    accel_slope: Vector
    accel_variance: Vector
    gyro_warm_up: float
    """By how much a warm-up of `WARM_UP_K` moves the bias, rad/s."""
    accel_warm_up: float
    """m/s^2."""
    lever_s: float
    """Middle of the window to the middle of the next minute."""
    k_s: float | None
    """How fast its thermometer goes up; None: it has none."""
    k_s_variance: float = 0.0

    @property
    def rate_k_s(self) -> float:
        """How fast its temperature is known to rise; zero where that may be chance, or it has no thermometer."""
        return self.k_s if self.k_s is not None and abs(self.k_s) > 2.0 * math.sqrt(self.k_s_variance) else 0.0

    def unseen(self, powered_s: float) -> Floats:
        """Variance (6,) that the next minute's biases have by slopes nobody sees: gyro (rad/s)^2, accel (m/s^2)^2.

        `powered_s`: for so long the sensor has been switched on at least, at the end of the window.
        """
        kelvin = self._kelvin(powered_s) / WARM_UP_K**2
        slope = np.array([*self.gyro_slope, *self.accel_slope])
        variance = np.array([*self.gyro_variance, *self.accel_variance])
        prior = kelvin * np.repeat([self.gyro_warm_up**2, self.accel_warm_up**2], 3)
        share = prior / np.maximum(prior + variance, np.finfo(float).tiny)
        return np.asarray((np.square(share * slope) + share * variance) * self.lever_s**2)

    def in_words(self, name: str, powered_s: float, other_variance: Floats) -> str:
        """Why the gyros' sigma is wide, where that is for the warm-up above all; else empty.

        `other_variance` (6,) is what is in sigma besides.
        """
        unseen = self.unseen(powered_s)[:3]
        if unseen.max() <= other_variance[:3].max():
            return ""
        if self.rate_k_s:
            k_min = abs(self.rate_k_s) * 60.0
            return f"gyro {name}: its temperature moves by {k_min:.1f} K a minute, sigma allows for that"
        words = f"gyro {name}: on for {_age(powered_s)}, may still be warming, sigma allows for that"
        at_s, sigma = self._better(powered_s, other_variance)
        return words if at_s is None else f"{words}; after {at_s / 60.0:.0f} min about {sigma / DEG_H:.0f} deg/h"

    def _better(self, powered_s: float, other_variance: Floats) -> tuple[float | None, float]:
        """The age from which the gyros' sigma is better by a third, and what it is then; None: it never will be."""

        def sigma(age_s: float) -> float:
            return math.sqrt((self.unseen(age_s)[:3] + other_variance[:3]).max())

        enough = _WORTH_WAITING * sigma(powered_s)
        return next(((at_s, sigma(at_s)) for at_s in _LATER_S if sigma(at_s) <= enough), (None, 0.0))

    def _kelvin(self, powered_s: float) -> float:
        """Mean square of the rate, K/s, by age and thermometer."""
        prior = likely_k_s(powered_s) ** 2
        if self.k_s is None:
            return prior
        share = prior / (prior + self.k_s_variance)
        return (share * self.k_s) ** 2 + share * self.k_s_variance


def _age(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 120.0 else f"{seconds / 60.0:.0f} min"


def likely_k_s(powered_s: float) -> float:
    """One sigma of how fast a sensor may be warming that was switched on so long ago, K/s."""
    age_s = max(powered_s, 0.0)
    steepest = math.exp(-age_s / QUICKEST_S) / QUICKEST_S if age_s < QUICKEST_S else 1.0 / (math.e * age_s)
    return WARM_UP_K / 2.0 * steepest


def temperature_rate(batches: Sequence[Batch]) -> tuple[float, float] | None:
    """How fast a thermometer goes up, K/s, and the variance of that; None where there is none, or too little of it."""
    known = [(batch.slot, batch.temperature_degc) for batch in batches if batch.temperature_degc is not None]
    if len(known) < _FEWEST:
        return None
    table = np.array(known, dtype=np.float64)
    time, degc = table[:, 0] - table[:, 0].mean(), table[:, 1]
    spread = float(np.square(time).sum())
    centred = degc - degc.mean()
    slope = float(time @ centred) / spread
    residual = centred - slope * time
    scatter = float(residual @ residual) / (len(known) - 2)
    hidden = _resolution_k(degc) / 2.0
    span_s = float(table[-1, 0] - table[0, 0] + 1.0)
    return slope, scatter / spread + (_OF_STEPS * hidden / span_s) ** 2


def _resolution_k(degc: Floats) -> float:
    """The step of a thermometer that shows a few values only; zero where it shows many."""
    values = np.unique(degc)
    if len(values) > _FEWEST:
        return 0.0
    if len(values) > 1:
        return float(np.diff(values).min())
    # One value: as coarse as its digits allow.
    value = float(values[0])
    return next((step for step in _STEPS_K if abs(value / step - round(value / step)) < 1e-6), 0.0)


def warming(
    rotation: Matrix,
    slopes: tuple[Floats, Floats],
    variances: tuple[Floats, Floats],
    warm_up: tuple[float, float],
    batches: Sequence[Batch],
) -> Warming:
    """Of one window, turned into the vehicle's axes.

    Slopes and their variances are of gyro and accelerometer, (3,) each, in the sensor's axes; a variance is infinite
    where the window tells nothing. `warm_up` is what `WARM_UP_K` does.
    """
    gyro, accel = (np.minimum(np.square(rotation) @ np.minimum(each, _NOTHING), _NOTHING) for each in variances)
    rate = temperature_rate(batches)
    return Warming(
        gyro_slope=vector(rotation @ slopes[0]),
        gyro_variance=vector(gyro),
        accel_slope=vector(rotation @ slopes[1]),
        accel_variance=vector(accel),
        gyro_warm_up=warm_up[0],
        accel_warm_up=warm_up[1],
        lever_s=(batches[-1].slot + 1.0 - batches[0].slot + NEXT_S) / 2.0,
        k_s=None if rate is None else rate[0],
        k_s_variance=0.0 if rate is None else rate[1],
    )
