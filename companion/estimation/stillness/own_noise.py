"""Noise of a motionless sensor with any spectrum: learned from its stream, and distinguished from motion by physics.

Behind a low-pass filter, noise of a motionless sensor can be as slow and as large as the motion of an aircraft. Four
facts distinguish noise from motion:

- Noise behind any filter is flat down to zero frequency, or rises there (flicker). Its density, the Allan variance
  times the averaging time, never grows towards shorter times. A standing aircraft only rocks: its angle is bounded, so
  its rate has no power at zero frequency, but a peak at the rocking frequency. So has its acceleration.
- Noise is steady: no second is an outlier among the others.
- Noise has no favourite axis.
- No sensor model on the market exceeds a known density.

The density at averaging times of one second and more gives the chance error of a one-second mean. Variance over density
is the number of independent values in a second; behind a filter, there are fewer of them than samples.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

import msgspec
import numpy as np

from companion.estimation.noise.allan import allan_variance
from companion.estimation.seconds.batch import Batch
from companion.physics.frames import Floats
from companion.physics.statistics import chi_square_ratio
from companion.physics.units import DEG, MG

LEARN_S: Final = 30
"""Least seconds of rest from which noise is learned: their three axes give some 70 degrees of freedom."""
KEPT_S: Final = 60
EVERY_S: Final = 5  # Period of learning until both triads are known, then `LEARN_S`
MOST: Final = (0.07 * DEG, 1.0 * MG)
"""Largest plausible noise N of gyro and accelerometer, SI * sqrt(s): 250 deg/h * sqrt(s) (the noisiest common gyro has
150), and three times the noisiest common accelerometer."""
RED: Final = 2.0
"""Largest ratio of noise densities at two averaging times: several seconds and one second, or one and half a second.
Flicker, warm-up and a 1 Hz filter raise the ratio; slow rocking raises it to 8 if one time is double the other."""
WHITE: Final = 0.8
"""Noise is white (unfiltered) if successive differences show more than this share of its variance."""
ROUND: Final = 40.0
"""Largest ratio of noise variances, noisiest over quietest direction: sigmas of axes differ by factors up to 3."""
_SIGMAS: Final = 2.5
_OUTLIER_SIGMAS: Final = 4.5
_BEYOND: Final = 1.6  # Limit in multiples of the largest density, beyond which a second is motion
_GAP: Final = 4  # Largest distance of consecutive seconds
_SPANS: Final = (1, 2, 4, 8)
_NAMED: Final = 1.5  # Margin over the density of a part that the configuration names
_AT_REST: Final = 3.0
_HINT_S: Final = 5  # Seconds without motion beyond any noise after which a hint may say that it is noise
_SHARPEST: Final = 1.5
"""Variance of a second's variance v, over v N^2: 1 for white noise or one filter pole, 1.5 for 2 poles, 2 for many."""


class Known(msgspec.Struct, frozen=True):
    """Learned noise of the three axes of one triad at rest, in squares of the triad's unit; each (3,).

    `variance`: of one sample. `white`: share of this variance in successive differences (`Batch.white`). `density`: N^2
    at low frequencies, which is the variance of a one-second mean.
    """

    variance: Floats
    white: Floats
    density: Floats

    @property
    def chance(self) -> float:
        """Return the standard deviation of one second's variance, averaged over the three axes."""
        return math.sqrt(_SHARPEST * float(self.variance @ self.density)) / 3.0

    @property
    def freedom(self) -> float:
        """Return the number of statistically independent values per axis in one second."""
        return max(float(self.variance.sum() / self.density.sum()) / _SHARPEST, 1.0)


class OwnNoise:
    """Estimator of the noise of one IMU from seconds at rest or not; without result until the noise is certain.

    `white`: the profile's white noise N of gyro and accelerometer; a configured part may be noisier than common parts.
    `at_rest`: the operator confirms rest, so noise up to three times the usual limit is accepted.
    """

    def __init__(self, white: tuple[float, float] = (0.0, 0.0), *, at_rest: bool = False) -> None:
        self.known: list[Known | None] = [None, None]
        """Learned noise of gyro and of accelerometer; unchanged until newer noise is learned. None: not learned yet."""
        believed = [max(_AT_REST * m if at_rest else m, _NAMED * n) for m, n in zip(MOST, white, strict=True)]
        self._most2 = np.repeat(np.square(believed), 3)
        self._at_rest = at_rest
        self._seconds: deque[Batch] = deque(maxlen=KEPT_S)
        self.clear()

    def clear(self) -> None:
        """Drop the stored seconds, with which later ones cannot be compared, but not the learned noise."""
        self._seconds.clear()
        self._since = 0
        self._too_much = [False, False]

    def hint(self, triad: int) -> str:
        """Return a hint that apparent motion by gyro (0) or accelerometer (1) may be noise; else an empty text."""
        if self._at_rest or self.known[triad] is not None:
            return ""
        if self._too_much[triad]:
            return " (steady as noise: name its part, or companion log profile)"
        left_s = LEARN_S - self._since
        return f" (motion or noise: known in {left_s} s)" if self._since >= _HINT_S and left_s > 0 else ""

    def add(self, batch: Batch) -> None:
        if not len(batch.allan) or self._is_motion(batch):
            self.clear()
            return
        self._seconds.append(batch)
        self._since += 1
        every_s = EVERY_S if None in self.known else LEARN_S
        if self._since >= LEARN_S and (self._since - LEARN_S) % every_s == 0:
            self._learn()

    def _is_motion(self, batch: Batch) -> bool:
        most2 = _BEYOND**2 * self._most2
        if self._seconds:
            before = self._seconds[-1]
            step = batch.mean - before.mean
            if not 0 < batch.slot - before.slot <= _GAP or (step * step > 2.0 * _OUTLIER_SIGMAS**2 * most2).any():
                return True
        parts = parts_of_second(len(batch.allan))
        allowed = parts * chi_square_ratio(freedom_of(parts), _OUTLIER_SIGMAS)
        return bool((batch.allan > allowed[:, None] * most2).any())

    def _learn(self) -> None:
        seconds = list(self._seconds)
        # Try the latest seconds, then all: earlier ones may hold a motion that has ended.
        for some in (seconds[-LEARN_S:], seconds):
            for triad, part in enumerate((slice(0, 3), slice(3, 6))):
                found = _noise(some, part)
                if found is not None:
                    self._too_much[triad] = bool(found.density.mean() > self._most2[part][0])
                    self.known[triad] = self.known[triad] if self._too_much[triad] else found


def _noise(seconds: list[Batch], part: slice) -> Known | None:
    """Estimate the noise of three channels; None if these seconds show anything but noise."""
    slots = np.array([batch.slot for batch in seconds], dtype=np.int64)
    means = np.array([batch.mean[part] for batch in seconds])
    variances = np.array([batch.variance[part] for batch in seconds])
    samples, many = float(np.mean([batch.n for batch in seconds])), float(len(seconds))
    variance, white = variances.mean(axis=0), np.mean([batch.white[part] for batch in seconds], axis=0)
    # Density and degrees of freedom of one channel, by averaging time.
    spans = [(span, *allan_variance(slots, means, span)) for span in _SPANS]
    longer = [(span * found, freedom) for span, found, freedom in spans]
    depth = min(len(batch.allan) for batch in seconds)
    parts = parts_of_second(depth)
    within = np.mean([batch.allan[:depth, part] for batch in seconds], axis=0) / parts[:, None]
    shorter = [*zip(within, many * freedom_of(parts), strict=True), (white / samples, many * samples * 2.0 / 3.0)]
    density, freedom = float(longer[0][0].mean()), 3.0 * longer[0][1]
    if not (white.min() > 0.0 and density > 0.0):
        return None
    axes = density * np.maximum(variance / variance.mean(), white / white.mean())
    is_white = white.mean() > WHITE * variance.mean()
    found = Known(variance, white, variance / samples if is_white else axes)
    half, half_freedom = shorter[0]
    is_flat = density <= RED * half.mean() * _ratio(freedom, 3.0 * half_freedom) and all(
        density / _ratio(freedom, 3.0 * some) <= each.mean() <= RED * density * _ratio(freedom, 3.0 * some)
        for each, some in longer
    )
    is_low = all((each <= axes * _ratio(freedom, some)).all() for each, some in shorter)
    steps = np.diff(means, axis=0)[np.diff(slots) == 1]
    most = variance.mean() * chi_square_ratio(3.0 * found.freedom, _OUTLIER_SIGMAS)
    most_step = 2.0 * found.density.mean() * chi_square_ratio(3.0, _OUTLIER_SIGMAS)
    is_steady = variances.mean(axis=1).max() <= most and np.square(steps).mean(axis=1).max() <= most_step
    # A rocking aircraft turns about one axis or two.
    least, _, largest = np.linalg.eigvalsh(steps.T @ steps).tolist()
    return found if is_flat and is_low and is_steady and largest <= ROUND * least else None


def _ratio(first: float, second: float) -> float:
    """Return the largest ratio by chance of two estimates of one variance; arguments: their degrees of freedom."""
    return math.exp(_SIGMAS * math.sqrt(2.0 / max(first, 1.0) + 2.0 / max(second, 1.0)))


def parts_of_second(depth: int) -> Floats:
    return np.asarray(np.exp2(np.arange(1.0, depth + 1.0)))


def freedom_of(parts: Floats) -> Floats:
    """Return the degrees of freedom of an Allan variance within a second that is divided into `parts` averages."""
    return np.maximum(0.75 * parts - 1.0, 1.0)
