"""Allowance for a warm-up that is too slow to show within one window, and the drift that the window does show.

A slope s moves the mean of the next minute by s (T + 60 s) / 2 from the mean over a window of length T. The allowance
uses the window's slope with its standard error. The time t since power-up limits the slope: a box warms by `WARM_UP_K`
with an unknown time constant, so its rate is at most WARM_UP_K / (e t). A measured temperature rate refines this limit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np

from companion.estimation.noise.allan import WARM_UP_K
from companion.estimation.seconds.batch import Batch
from companion.physics.frames import Floats, Matrix
from companion.physics.units import DEG_H, MG
from companion.samples import Triad, rows_of

QUICKEST_S: Final = 60.0  # Shortest time constant of a warm-up; boards take 1 to 20 min
NEXT_S: Final = 60.0  # Assumed duration of an unseen slope after the window
_LATER_S: Final = (120.0, 600.0, 3600.0)
_WORTH_WAITING: Final = 2.0 / 3.0  # A later sigma is worth waiting for below this share of the present one
_TEMPERATURE_WARNING_K: Final = 3.0
UNKNOWN: Final = 1.0
"""Variance for a slope that the window is too short to show, (rad/s^2)^2 or (m/s^3)^2: larger than any warm-up."""
_TINY: Final = float(np.finfo(float).tiny)
_BENT_SIGMAS: Final = 3.0  # Curvature over its sigma above which the temperature is fitted by a parabola
_STEPS_K: Final = (1.0, 0.5, 0.25, 0.1, 0.05, 0.01)  # Resolutions of thermometers


State = tuple[float, float]
"""Temperature, degC, and its rate, K/s."""


class Path(msgspec.Struct, frozen=True, kw_only=True):
    """Temperature over a window, fitted by a line or a parabola."""

    states: tuple[State, State, State]  # At the beginning, in the middle and at the end
    span_s: float
    variance: float
    """Variance of the difference between the temperature at the end and the mean temperature, K^2."""

    @property
    def mean_degc(self) -> float:
        (start, _), (middle, _), (end, _) = self.states
        return (start + 4.0 * middle + end) / 6.0


class Warming(msgspec.Struct, frozen=True, kw_only=True):
    """Slopes of gyro and accelerometer readings (6,), rad/s^2 and m/s^3, and of the temperature in one window.

    `ramp`: significant slopes, zero for other axes. With a ramp, the reported mean is the end of the line. `variance`:
    variance of the slope, with the IMU's flicker and walk; `UNKNOWN` if the window is too short. `level_variance`:
    variance of a mean, without a ramp, over the next minutes. `warm_up`: bias change of gyro and accelerometer if
    the temperature rises by `WARM_UP_K`, rad/s and m/s^2. `rate`: rate of the temperature, K/s, and its variance; None
    without a thermometer. `path`: None if the temperature does not change significantly.
    """

    slope: Floats
    ramp: Floats
    variance: Floats
    level_variance: Floats
    warm_up: tuple[float, float]
    half_s: float  # Half of the window's length
    rate: tuple[float, float] | None
    path: Path | None

    def rotated(self, rotation: Matrix) -> Warming:
        both = np.kron(np.eye(2), rotation)
        return msgspec.structs.replace(
            self,
            slope=both @ self.slope,
            ramp=both @ self.ramp,
            variance=np.minimum(np.square(both) @ self.variance, UNKNOWN),
            level_variance=np.square(both) @ self.level_variance,
        )

    @property
    def rate_k_s(self) -> float:
        """Significant rate of the temperature, K/s; zero if the change may be chance, or without a thermometer."""
        return 0.0 if self.rate is None or self.path is None else self.rate[0]

    def ahead(self, triad: Triad) -> Floats:
        """Return the reported mean minus the mean over the window, (3,); with a ramp, the ramp's end is reported."""
        return self.ramp[rows_of(triad)] * self.half_s

    def goes_on(self, triad: Triad) -> tuple[Floats, Floats]:
        """Return the bias' slope (3,) expected after the window, by ramp or thermometer, and the slope's sigma (3,)."""
        rows, move = rows_of(triad), self.warm_up[0 if triad == "gyro" else 1]
        prior = np.square(self.rate_k_s * move / WARM_UP_K)
        share = np.where(self.ramp[rows] != 0.0, 1.0, prior / (prior + self.variance[rows] + _TINY))
        return share * self.slope[rows], np.sqrt(share * self.variance[rows])

    def unseen(self, powered_s: float) -> Floats:
        """Return the variance (6,) of the next minute's biases from an undetected slope, (rad/s)^2 and (m/s^2)^2.

        `powered_s`: least possible time since power-up, s, at the end of the window.
        """
        age_s = max(powered_s, 0.0)
        steepest = math.exp(-age_s / QUICKEST_S) / QUICKEST_S if age_s < QUICKEST_S else 1.0 / (math.e * age_s)
        rate2 = (WARM_UP_K / 2.0 * steepest) ** 2
        if self.rate is not None:
            rate2 = float(_mean_square(rate2, *self.rate))
        prior = rate2 * np.repeat(np.square(self.warm_up), 3) / WARM_UP_K**2
        return _mean_square(prior, self.slope - self.ramp, self.variance) * (self.half_s + NEXT_S / 2.0) ** 2

    def in_words(self, name: str, powered_s: float, other_variance: Floats) -> str:
        """Explain that a warm-up causes most of a gyro's variance; empty if not. `other_variance` (6,): of the rest."""
        if self.unseen(powered_s)[:3].max() <= other_variance[:3].max():
            return ""
        if self.rate_k_s:
            k_min = abs(self.rate_k_s) * 60.0
            return f"gyro {name}: its temperature changes by {k_min:.1f} K a minute, sigma allows for that"
        age = f"{powered_s:.0f} s" if powered_s < 120.0 else f"{powered_s / 60.0:.0f} min"
        words = f"gyro {name}: on for {age}, may still be warming, sigma allows for that"
        now, *later = (math.sqrt((self.unseen(at_s) + other_variance)[:3].max()) for at_s in (powered_s, *_LATER_S))
        for at_s, sigma in zip(_LATER_S, later, strict=True):
            if sigma <= _WORTH_WAITING * now:
                return f"{words}; after {at_s / 60.0:.0f} min about {sigma / DEG_H:.0f} deg/h"
        return words


def _mean_square(prior: Floats | float, measured: Floats | float, variance: Floats | float) -> Floats:
    """Return the mean square of a slope: prior mean square, updated by a measured slope with its variance."""
    share = prior / (prior + variance + _TINY)
    return np.asarray(np.square(share * measured) + share * variance)


def temperature(batches: Sequence[Batch]) -> tuple[tuple[float, float] | None, Path | None]:
    """Fit the temperature over a window; return the fields `rate` and `path` of a `Warming`."""
    known = [(batch.slot + 0.5, batch.temperature_degc) for batch in batches if batch.temperature_degc is not None]
    if len(known) < 3:
        return None, None
    times, degc = np.array(known, dtype=np.float64).T
    half_s = (batches[-1].slot + 1.0 - batches[0].slot) / 2.0
    times -= batches[0].slot + half_s
    (k_s, level), (of_k_s, _) = _fitted(times, degc, 1)
    rate = k_s, of_k_s
    if abs(k_s) < 2.0 * math.sqrt(of_k_s):
        return rate, None
    bend = of_bend = 0.0
    if len(known) > 3:
        bent, of_bent = _fitted(times, degc, 2)
        if abs(bent[0]) > _BENT_SIGMAS * math.sqrt(of_bent[0]):
            (bend, k_s, level), (of_bend, of_k_s, _) = bent, of_bent
    start, middle, end = (
        (level + k_s * at_s + bend * at_s**2, k_s + 2.0 * bend * at_s) for at_s in (-half_s, 0.0, half_s)
    )
    variance = of_k_s * half_s**2 + of_bend * (2.0 / 3.0 * half_s**2) ** 2
    return rate, Path(states=(start, middle, end), span_s=2.0 * half_s, variance=variance)


def _fitted(times: Floats, degc: Floats, degree: int) -> tuple[list[float], list[float]]:
    """Fit a line or a parabola to temperatures; return its coefficients, highest power first, and their variances."""
    found, covariance = np.polyfit(times, degc - degc[0], degree, cov=True)
    found[-1] += degc[0]
    half_s = (times[-1] - times[0] + 1.0) / 2.0
    # A step q of the thermometer hides up to q / 2 at each end: q sqrt(3) / 4 as one sigma of each coefficient.
    hidden = 3.0 * (_resolution_k(degc) / 4.0) ** 2 / half_s ** (2.0 * np.arange(degree, -1.0, -1.0))
    return found.tolist(), (np.diag(covariance) + hidden).tolist()


def _resolution_k(degc: Floats) -> float:
    """Return the resolution, K, of a thermometer that shows at most three values; zero if it shows more."""
    values = np.unique(degc)
    if len(values) == 1:
        # Largest step that its digits allow.
        return next((step for step in _STEPS_K if abs(values[0] / step - round(values[0] / step)) < 1e-6), 0.0)
    return float(np.diff(values).min()) if len(values) <= 3 else 0.0


def drifting(name: str, ramps: Floats, temperatures_degc: Sequence[float]) -> tuple[str, ...]:
    """Return warnings about the drift of one IMU. `ramps` (6,): slopes of gyro, rad/s^2, and accelerometer, m/s^3."""
    found, size = [], np.abs(ramps)
    span = max(temperatures_degc, default=0.0) - min(temperatures_degc, default=0.0)
    if size[:3].any():
        found.append(f"warm-up: gyro {name} drifts {size[:3].max() / DEG_H:.1f} deg/h per second")
    if size[3:].any():
        found.append(f"warm-up: accel {name} drifts {size[3:].max() / MG * 60.0:.2f} mg per minute")
    if span > _TEMPERATURE_WARNING_K:
        found.append(f"temperature of imu {name} moved by {span:.1f} K")
    return tuple(found)
