"""What a still sensor's own noise looks like, whatever its spectrum, told from motion by physics and not by a profile.

Behind a low-pass filter the noise of a still sensor is as slow as the motion of an aircraft, and as large. What tells
the two apart is their density at low frequencies:

- Noise behind any filter is flat down to zero frequency, or rises there (flicker): the Allan variance times its
  averaging time, which is the density N^2 for white noise, never grows towards shorter times.
- An aircraft that stands on something can only rock: its angle is bounded, so that its rate has nothing at zero
  frequency and stands out at the frequency of the rocking. The same goes for its speed and its acceleration.
- Noise is steady: no second of it is an outlier among the others. And no part on the market has more than a density
  that is known, so that nothing beyond it is ever learned.

The density at averages of a second and more says what chance can do with a second's mean; together with the variance
it says how many independent values a second holds, which behind a filter are fewer than its samples.
"""

from __future__ import annotations

import functools
import math
from collections import deque
from collections.abc import Iterable
from typing import Final

import msgspec
import numpy as np

from companion.estimation.noise.allan import allan_variance
from companion.estimation.seconds.batch import Batch
from companion.physics.frames import Floats
from companion.physics.statistics import chi_square_ratio
from companion.physics.units import DEG, MG

LEARN_S: Final = 30
"""Seconds without a motion beyond any noise from which it is learned: some 70 degrees of freedom in three axes."""
KEPT_S: Final = 60
EVERY_S: Final = 5
"""Looked at anew so often."""
KNOWN_EVERY_S: Final = 30
"""Once it is known."""
GYRO_MOST_RAD_S: Final = 0.07 * DEG
"""Largest density that is believed, times sqrt(s): 250 deg/h. The noisiest common part has 150."""
ACCEL_MOST_M_S2: Final = 1.0 * MG
"""Likewise: three times the noisiest common part."""
RED: Final = 2.0
"""Density at averages of several seconds over that at one, and of one over half a one: flicker raises it, warming up,
and a filter of 1 Hz. Slow rocking has 8 times as much at twice the time."""
WHITE: Final = 0.8
"""Share of the variance that successive differences show, from which noise is white: no filter to reckon with."""
ROUND: Final = 40.0
"""Largest over smallest variance of a second's steps in any direction: axes three times as noisy as others, and
chance."""
_SIGMAS: Final = 2.5
_OUTLIER_SIGMAS: Final = 4.5
_GAP: Final = 4
_CALM: Final = 1.6
"""What has no more than so many times it may be noise: said while that is being found out."""
_BEYOND: Final = 3.0
"""What has more than so many times the largest density in one second is motion, not a noisier part."""
_SPANS: Final = (1, 2, 4, 8)
_NAMED: Final = 1.5
"""Over the density of a part that somebody named."""
_AT_REST: Final = 3.0
_HINT_S: Final = 5
"""So long without a motion beyond any noise, and it may be noise."""
_SHARPEST: Final = 1.5
"""Relative variance of a second's variance, in v / N^2: 1 for white noise and one pole, 1.5 for two, 2 for a wall."""


class Known(msgspec.Struct, frozen=True):
    """The noise of the three axes of one triad at rest, in squares of its unit."""

    variance: list[float]
    """Of one sample."""
    white: list[float]
    """The part of it that successive differences show (`Batch.white`)."""
    density: list[float]
    """N^2 at low frequencies: the variance of a second's mean."""

    @property
    def rms(self) -> float:
        """Of one sample, over the three axes."""
        return math.sqrt(sum(self.variance) / 3.0)

    @property
    def slow(self) -> float:
        """Mean of what looks like motion."""
        return sum(total - white for total, white in zip(self.variance, self.white, strict=True)) / 3.0

    @property
    def chance(self) -> float:
        """Standard deviation of a second's variance, the mean of the three axes."""
        both = sum(variance * density for variance, density in zip(self.variance, self.density, strict=True))
        return math.sqrt(_SHARPEST * both) / 3.0

    @property
    def freedom(self) -> float:
        """Independent values a second, of one axis."""
        return max(sum(self.variance) / sum(self.density) / _SHARPEST, 1.0)


class OwnNoise:
    """Learns the noise of one IMU from its seconds, moving or not; knows nothing until it is certain.

    `white` is N of the profile, gyro and accelerometer, where somebody named a noisier part than is common. `at_rest`:
    somebody says that it is; three times as much noise is believed.
    """

    def __init__(self, white: tuple[float, float] = (0.0, 0.0), *, at_rest: bool = False) -> None:
        self.known: list[Known | None] = [None, None]
        """Gyro, accelerometer; what was learned once stays, until something newer is."""
        self._most2 = np.repeat(
            [
                max(_AT_REST * most if at_rest else most, _NAMED * named) ** 2
                for most, named in zip((GYRO_MOST_RAD_S, ACCEL_MOST_M_S2), white, strict=True)
            ],
            3,
        )
        self._at_rest = at_rest
        self._too_much = [False, False]
        self._calm = 0
        """Seconds in a row that any common part's noise may look like."""
        self._seconds: deque[Batch] = deque(maxlen=KEPT_S)
        self._since = 0

    def clear(self) -> None:
        """The readings are not comparable with earlier ones; what is known stays."""
        self._seconds.clear()
        self._since = self._calm = 0
        self._too_much = [False, False]

    def hint(self, triad: int) -> str:
        """What to add to the words that gyro (0) or accelerometer (1) moves: when it may be noise; else nothing."""
        if self._at_rest or self.known[triad] is not None:
            return ""
        if self._too_much[triad]:
            return " (steady as noise: name its part, or companion profile)"
        left_s = LEARN_S - self._since
        return f" (motion or noise: known in {left_s} s)" if self._calm >= _HINT_S and left_s > 0 else ""

    def add(self, batch: Batch) -> None:
        """Take the next second."""
        before = self._seconds[-1] if self._seconds else None
        if not len(batch.allan) or self._is_beyond(batch, before, _BEYOND):
            self.clear()
            return
        self._calm = 0 if self._since < LEARN_S and self._is_beyond(batch, before, _CALM) else self._calm + 1
        self._seconds.append(batch)
        self._since += 1
        every_s = EVERY_S if None in self.known else KNOWN_EVERY_S
        if self._since >= LEARN_S and (self._since - LEARN_S) % every_s == 0:
            self._learn()

    def _learn(self) -> None:
        seconds = list(self._seconds)
        # All, or the latest: the others may have something in them that is over.
        seen = [_Seen(seconds), _Seen(seconds[-LEARN_S:])] if len(seconds) > LEARN_S else [_Seen(seconds)]
        for triad, part in enumerate((slice(0, 3), slice(3, 6))):
            found = next(filter(None, (some.noise(part) for some in seen)), None)
            self._too_much[triad] = found is not None and sum(found.density) / 3.0 > float(self._most2[part][0])
            if found is not None and not self._too_much[triad]:
                self.known[triad] = found

    def _is_beyond(self, batch: Batch, before: Batch | None, times: float) -> bool:
        """Whether a second alone has more than so many times what any sensor's noise has."""
        most2 = times**2 * self._most2
        if before is not None:
            if not 0 < batch.slot - before.slot <= _GAP:
                return True
            step = batch.mean - before.mean
            if (step * step > 2.0 * _OUTLIER_SIGMAS**2 * most2).any():
                return True
        return bool((batch.allan > _allowed(len(batch.allan)) * most2).any())


def learned_of(batches: Iterable[Batch]) -> OwnNoise:
    """What the seconds of a whole recording at rest tell."""
    own = OwnNoise(at_rest=True)
    for batch in batches:
        own.add(batch)
    return own


class _Seen:
    """Some seconds in a row: six channels at all averaging times."""

    def __init__(self, seconds: list[Batch]) -> None:
        self._slots = np.array([batch.slot for batch in seconds], dtype=np.int64)
        self._means = np.array([batch.mean for batch in seconds])
        self._variances = np.array([batch.variance for batch in seconds])
        self._white = np.mean([batch.white for batch in seconds], axis=0)
        self._samples = float(np.mean([batch.n for batch in seconds]))
        depth = min(len(batch.allan) for batch in seconds)
        within = np.mean([batch.allan[:depth] for batch in seconds], axis=0)
        # Density and degrees of freedom of one channel, at times of parts of a second and of one sample.
        parts = _parts(depth)
        many = float(len(seconds))
        self._short = [
            *zip(within / parts[:, None], many * _freedom(parts), strict=True),
            (self._white / self._samples, many * self._samples * 2.0 / 3.0),
        ]
        self._long = [
            (span * variance, freedom)
            for span, (variance, freedom) in ((span, allan_variance(self._slots, self._means, span)) for span in _SPANS)
        ]

    def noise(self, part: slice) -> Known | None:
        """What it is, if it is noise and nothing else."""
        variance, white = self._variances[:, part].mean(axis=0), self._white[part]
        density, freedom = float(self._long[0][0][part].mean()), 3.0 * self._long[0][1]
        if not (float(white.min()) > 0.0 and density > 0.0):
            return None
        share = np.maximum(variance / variance.mean(), white / white.mean())
        is_white = float(white.mean()) > WHITE * float(variance.mean())
        densities = variance / self._samples if is_white else density * share
        found = Known(variance.tolist(), white.tolist(), densities.tolist())
        known = self._is_flat(part, density, freedom) and self._is_low(part, density * share, freedom)
        return found if known and self._is_steady(part, found) and self._is_round(part) else None

    def _is_flat(self, part: slice, density: float, freedom: float) -> bool:
        """Whether averages of more than a second have the density of a second's, or some more."""
        for values, many in self._long:
            longer, chance = float(values[part].mean()), _ratio(freedom, 3.0 * many)
            if longer > RED * density * chance or density > longer * chance:
                return False
        half, many = self._short[0]
        return density <= RED * float(half[part].mean()) * _ratio(freedom, 3.0 * many)

    def _is_low(self, part: slice, density: Floats, freedom: float) -> bool:
        """Whether parts of a second have no more."""
        return all(bool((values[part] <= density * _ratio(freedom, many)).all()) for values, many in self._short)

    def _is_steady(self, part: slice, found: Known) -> bool:
        """Whether no second is an outlier, by its variance or by its step from the one before."""
        most = float(self._variances[:, part].mean(axis=1).max())
        if most > sum(found.variance) / 3.0 * float(chi_square_ratio(3.0 * found.freedom, _OUTLIER_SIGMAS)):
            return False
        steps = np.square(self._steps(part)).mean(axis=1) / 2.0
        return float(steps.max()) <= sum(found.density) / 3.0 * float(chi_square_ratio(3.0, _OUTLIER_SIGMAS))

    def _is_round(self, part: slice) -> bool:
        """Whether the axes go their own ways, each about as far: a rocking aircraft turns about one axis or two."""
        steps = self._steps(part)
        least, _, largest = np.linalg.eigvalsh(steps.T @ steps).tolist()
        return bool(largest <= ROUND * least)

    def _steps(self, part: slice) -> Floats:
        return np.asarray(np.diff(self._means[:, part], axis=0)[np.diff(self._slots) == 1])


def _ratio(first: float, second: float) -> float:
    """Of two estimates of one variance by chance, by their degrees of freedom."""
    return math.exp(_SIGMAS * math.sqrt(2.0 / max(first, 1.0) + 2.0 / max(second, 1.0)))


def _parts(depth: int) -> Floats:
    """2, 4, 8 ... parts of a second."""
    return np.asarray(np.exp2(np.arange(1.0, depth + 1.0)))


def _freedom(parts: Floats) -> Floats:
    """Degrees of freedom of the Allan variance of so many parts of a second."""
    return np.maximum(0.75 * parts - 1.0, 1.0)


@functools.lru_cache(maxsize=8)
def _allowed(depth: int) -> Floats:
    """(depth, 1) Allan variance that chance alone may make of noise whose density is one."""
    parts = _parts(depth)
    return np.asarray((parts * chi_square_ratio(_freedom(parts), _OUTLIER_SIGMAS))[:, None])
