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
from typing import Final, NamedTuple

import msgspec
import numpy as np

from companion.estimation.noise.allan import WARM_UP_K
from companion.estimation.seconds.batch import Batch
from companion.physics.frames import Floats, Matrix, vector
from companion.physics.units import DEG_H, MG
from companion.samples import Triad, Vector, rows_of

QUICKEST_S: Final = 60.0
"""The shortest time constant of a warm-up: boards take 1 to 20 min."""
NEXT_S: Final = 60.0
"""So far ahead an unseen slope is believed to go on."""
_LATER_S: Final = (120.0, 600.0, 3600.0)
"""Ages at which to say what sigma will be."""
_WORTH_WAITING: Final = 2.0 / 3.0
"""Of the present sigma: what is no better than that is no reason to wait."""
_FEWEST: Final = 3
_TEMPERATURE_WARNING_K: Final = 3.0
_NOTHING: Final = 1.0
"""Variance of a slope of which the window tells nothing, (rad/s^2)^2 or (m/s^3)^2: beyond every warm-up."""
_OF_STEPS: Final = math.sqrt(3.0)
"""One sigma of a slope over T by readings that are off by at most A is sqrt(3) A / T; its largest is 3 A / T."""
_BENT_SIGMAS: Final = 3.0
"""Of the curvature of a temperature's way, beyond which it is no line."""
_STEPS_K: Final = (1.0, 0.5, 0.25, 0.1, 0.05, 0.01)
"""Resolutions of thermometers, coarse ones first."""


class Lines(NamedTuple):
    """Straight lines through the readings of gyro and accelerometer, rad/s^2 and m/s^3; (6,), or the (3,) of one."""

    hidden: Floats
    """Slopes that are not significant; zero of the others."""
    hidden_variance: Floats
    """Likewise; infinite where the window tells nothing."""
    ramp: Floats
    """Slopes that are, so that the mean that is given is the end of the line."""
    variance: Floats
    """Of both."""
    level_variance: Floats
    """Of the mean over the window for the next minutes, as if there were no ramp."""

    @property
    def slope(self) -> Floats:
        """Significant or not."""
        return self.hidden + self.ramp


class Path(msgspec.Struct, frozen=True, kw_only=True):
    """How the temperature went through a window, a line or a parabola."""

    degc: Vector
    """At its beginning, in its middle and at its end."""
    span_s: float
    variance: float
    """Of how far the end is from the mean."""

    @property
    def mean_degc(self) -> float:
        """Over the window."""
        start, middle, end = self.degc
        return (start + 4.0 * middle + end) / 6.0

    @property
    def states(self) -> tuple[tuple[float, float], tuple[float, float], tuple[float, float]]:
        """Temperature and how fast it rose, degC and K/s, at these three."""
        start, middle, end = self.degc
        mean, change = (end - start) / self.span_s, 2.0 * (end - 2.0 * middle + start) / self.span_s
        return (start, mean - change), (middle, mean), (end, mean + change)


class Warming(msgspec.Struct, frozen=True, kw_only=True):
    """What one window tells of slopes; vehicle FRD, rad/s^2 and m/s^3."""

    lines: Lines
    """Variances are at most `_NOTHING`."""
    warm_up: tuple[float, float]
    """By how much a warm-up of `WARM_UP_K` moves the biases of gyro and accelerometer, rad/s and m/s^2."""
    lever_s: float
    """Middle of the window to the middle of the next minute."""
    k_s: float | None
    """How fast its thermometer goes up; None: it has none."""
    k_s_variance: float = 0.0
    path: Path | None = None
    """None: its temperature is not known to have changed."""

    @property
    def half_s(self) -> float:
        """Middle of the window to its end."""
        return self.lever_s - NEXT_S / 2.0

    def of(self, triad: Triad) -> Lines:
        """Those of one triad."""
        return Lines(*(each[rows_of(triad)] for each in self.lines))

    def ahead(self, triad: Triad) -> Floats:
        """By how much the mean that is given is more than that over the window, where it is the end of a ramp, (3,)."""
        return self.of(triad).ramp * self.half_s

    def goes_on(self, triad: Triad) -> tuple[Floats, Floats]:
        """The slope that will go on for some seconds and one sigma of it, (3,).

        That of a ramp, or what the thermometer's rate leaves of another.
        """
        lines, move = self.of(triad), self.warm_up[0 if triad == "gyro" else 1]
        prior = np.square(self.rate_k_s * move / WARM_UP_K)
        share = np.where(lines.ramp != 0.0, 1.0, prior / np.maximum(prior + lines.variance, np.finfo(float).tiny))
        return share * lines.slope, np.sqrt(share * lines.variance)

    @property
    def rate_k_s(self) -> float:
        """How fast its temperature is known to rise; zero where that may be chance, or it has no thermometer."""
        return self.k_s if self.k_s is not None and abs(self.k_s) > 2.0 * math.sqrt(self.k_s_variance) else 0.0

    def unseen(self, powered_s: float) -> Floats:
        """Variance (6,) that the next minute's biases have by slopes nobody sees: gyro (rad/s)^2, accel (m/s^2)^2.

        `powered_s`: for so long the sensor has been switched on at least, at the end of the window.
        """
        kelvin = self._kelvin(powered_s) / WARM_UP_K**2
        slope, variance = self.lines.hidden, self.lines.hidden_variance
        prior = kelvin * np.repeat(np.square(self.warm_up), 3)
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
        age = f"{powered_s:.0f} s" if powered_s < 120.0 else f"{powered_s / 60.0:.0f} min"
        words = f"gyro {name}: on for {age}, may still be warming, sigma allows for that"
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


def likely_k_s(powered_s: float) -> float:
    """One sigma of how fast a sensor may be warming that was switched on so long ago, K/s."""
    age_s = max(powered_s, 0.0)
    steepest = math.exp(-age_s / QUICKEST_S) / QUICKEST_S if age_s < QUICKEST_S else 1.0 / (math.e * age_s)
    return WARM_UP_K / 2.0 * steepest


def temperature_rate(batches: Sequence[Batch]) -> tuple[float, float] | None:
    """How fast a thermometer goes up, K/s, and the variance of that; None where there is none, or too little of it."""
    found = _fitted(batches, 1)
    return None if found is None else (found[0][1], found[1][1])


def temperature_path(batches: Sequence[Batch]) -> Path | None:
    """How a thermometer went through a window; None where it is not known to have changed."""
    line, bent = _fitted(batches, 1), _fitted(batches, 2)
    if line is None or abs(line[0][1]) < 2.0 * math.sqrt(line[1][1]):
        return None
    is_bent = bent is not None and abs(bent[0][2]) > _BENT_SIGMAS * math.sqrt(bent[1][2])
    (level, k_s, bend), (_, of_k_s, of_bend) = bent if bent is not None and is_bent else line
    half_s = (batches[-1].slot + 1.0 - batches[0].slot) / 2.0
    at = np.array([-half_s, 0.0, half_s])
    return Path(
        degc=vector(level + k_s * at + bend * at**2),
        span_s=2.0 * half_s,
        variance=of_k_s * half_s**2 + of_bend * (2.0 / 3.0 * half_s**2) ** 2,
    )


def _fitted(batches: Sequence[Batch], degree: int) -> tuple[Vector, Vector] | None:
    """Of a line or a parabola through the temperatures, about the middle of the window: coefficients and variances."""
    known = [(batch.slot, batch.temperature_degc) for batch in batches if batch.temperature_degc is not None]
    if len(known) < _FEWEST + degree - 1:
        return None
    table = np.array(known, dtype=np.float64)
    half_s = (table[-1, 0] - table[0, 0] + 1.0) / 2.0
    time = (table[:, 0] + 0.5 - (batches[0].slot + batches[-1].slot + 1.0) / 2.0) / half_s
    terms = time[:, None] ** np.arange(degree + 1)
    inverse = np.linalg.inv(terms.T @ terms)
    mean = float(table[:, 1].mean())
    found = inverse @ terms.T @ (table[:, 1] - mean)
    residual = table[:, 1] - mean - terms @ found
    scatter = float(residual @ residual) / max(len(known) - degree - 1, 1)
    # The same for every term: a step that is hidden at one end bends as much as it turns.
    hidden = (_OF_STEPS * _resolution_k(table[:, 1]) / 4.0) ** 2
    unit = half_s ** np.arange(3.0)
    value, variance = np.zeros(3), np.zeros(3)
    found[0] += mean
    value[: degree + 1], variance[: degree + 1] = found, scatter * np.diag(inverse) + hidden
    return vector(value / unit), vector(variance / np.square(unit))


def _resolution_k(degc: Floats) -> float:
    """The step of a thermometer that shows a few values only; zero where it shows many."""
    values = sorted(set(degc.tolist()))
    if len(values) > _FEWEST:
        return 0.0
    if len(values) > 1:
        return float(np.diff(values).min())
    # One value: as coarse as its digits allow.
    (value,) = values
    return next((step for step in _STEPS_K if abs(value / step - round(value / step)) < 1e-6), 0.0)


def warming(rotation: Matrix, lines: Lines, warm_up: tuple[float, float], batches: Sequence[Batch]) -> Warming:
    """Of one window, turned into the vehicle's axes; `warm_up` is what `WARM_UP_K` does."""

    def turned(values: Floats, turn: Matrix, most: float = math.inf) -> Floats:
        both = [turn @ np.minimum(values[rows], most) for rows in (slice(0, 3), slice(3, 6))]
        return np.minimum(np.concatenate(both), most)

    square = np.square(rotation)
    rate = temperature_rate(batches)
    return Warming(
        lines=Lines(
            turned(lines.hidden, rotation),
            turned(lines.hidden_variance, square, _NOTHING),
            turned(lines.ramp, rotation),
            turned(lines.variance, square, _NOTHING),
            turned(lines.level_variance, square),
        ),
        warm_up=warm_up,
        lever_s=(batches[-1].slot + 1.0 - batches[0].slot + NEXT_S) / 2.0,
        k_s=None if rate is None else rate[0],
        k_s_variance=0.0 if rate is None else rate[1],
        path=temperature_path(batches),
    )


def drifting(name: str, ramps: Floats, temperatures_degc: Sequence[float]) -> tuple[str, ...]:
    """What is to be said of the drift of one IMU; `ramps` (6,): gyro rad/s^2, accelerometer m/s^3."""
    found, size = [], np.abs(ramps)
    span = max(temperatures_degc, default=0.0) - min(temperatures_degc, default=0.0)
    if size[:3].any():
        found.append(f"warm-up: gyro {name} drifts {size[:3].max() / DEG_H:.1f} deg/h per second")
    if size[3:].any():
        found.append(f"warm-up: accel {name} drifts {size[3:].max() / MG * 60.0:.2f} mg per minute")
    if span > _TEMPERATURE_WARNING_K:
        found.append(f"temperature of imu {name} moved by {span:.1f} K")
    return tuple(found)
