"""Is the aircraft still? One verdict a second for every source, in words that name the device.

The detector is the generalised likelihood ratio test of Skog, Haendel, Nilsson and Rantakokko (IEEE Trans. Biomed.
Eng. 57(11), 2010) in its centred form: T = mean(sum((a - abar)^2 / s_a^2 + (w - wbar)^2 / s_w^2)), 6 (W - 1) / W when
at rest, because before a calibration the biases are unknown. What the centred form cannot see, a slow steady turn,
is left to gates on the means, and to `turning`. Method 3.1.

One set of constants serves all sensors; nothing here is tuned to a recording. Three ideas make that possible:

- Motion of an aircraft is slow against the sampling, sensor noise is mostly white. Half the mean square of
  successive differences measures the white part in the batch itself, so an absolute gate on *the rest* of the
  variance works on a sensor of any noise from its first second on.
- The sigmas of the likelihood ratio are learned from batches that passed that gate (their lower quartile), never
  from motion, and are floored by the profile's white noise.
- Every gate is widened by what chance alone can do with the number of samples in the batch.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Final, Literal

import msgspec
import numpy as np

from companion.config.sections import NoiseProfile
from companion.estimation.seconds.batch import Batch
from companion.estimation.seconds.recent import Recent
from companion.estimation.stillness.coarse import Steps
from companion.estimation.stillness.own_noise import OwnNoise
from companion.estimation.stillness.plausible import MOST_GYRO_RAD_S, unit_of_force
from companion.physics.frames import Floats
from companion.physics.statistics import chi_square_ratio
from companion.physics.units import DEG, MG

GYRO_MOTION_RAD_S: Final = 0.10 * DEG
"""rms of the slow part of the rate in one second. A tenth of a degree a second over 10 s is an attitude error of the
order of the gradienter's own; handling and walking are 10 to 1000 times more, sensors at rest below a half of it."""

ACCEL_MOTION_M_S2: Final = 10.0 * MG
"""The same for specific force: 10 mg is a tilt of half a degree within a second."""

GYRO_VIBRATION_RAD_S: Final = 1.0 * DEG
ACCEL_VIBRATION_M_S2: Final = 50.0 * MG
"""rms of everything, what is slow being gated already: three times the noisiest common sensor at its full rate. More
is a running motor, under which accelerometers rectify: their mean is no bias then."""

GLRT_RATIO: Final = 2.0
"""T over its value at rest. Noise at rest is stationary to some ten per cent; 2 is 40 % more amplitude."""

GYRO_STEP_RAD_S: Final = 0.05 * DEG
"""A second's mean against the last good ones. A sensor warming up at 3 (deg/h)/s, more than was ever seen, moves by
0.004 deg/s in their mean age of 5 s."""

ACCEL_STEP_M_S2: Final = 5.0 * MG
"""A second's mean against the start of the stretch: a tilt of 0.3 deg. Warming by 10 K moves consumer parts 2 mg."""

GYRO_BIAS_RAD_S: Final = 10.0 * DEG
"""Beyond any turn-on bias that a modern part specifies (typically 0.5 to 3 deg/s)."""

GRAVITY_M_S2: Final = 9.81
GRAVITY_GATE_M_S2: Final = 1.5
"""Uncalibrated parts miss by up to 0.1 g; a mean that is off by more is another unit, a dead axis or a centrifuge."""

TILT_MOTION_DEG: Final = 0.10
TILT_STEP_DEG: Final = 0.10
"""Ten times a field gradienter's noise, and 1.7 mg on a horizontal accelerometer."""

HEADING_MOTION_DEG: Final = 2.0
HEADING_STEP_DEG: Final = 3.0
"""The class of field compasses; 3 deg cost 0.6 deg/h on a horizontal gyro."""

MIN_IMU_SAMPLES: Final = 4
MAX_IMU_GAP_S: Final = 0.5
_NO_END: Final = (60.0 * DEG,) * 3 + (14.0,) * 3
"""No part's range ends below: readings of integers that pile up there are those of a sway that turns back."""
STUCK_SAMPLES: Final = 10
"""Fewer may well be equal by chance on a quiet sensor with coarse steps."""

_TRIADS: Final = (
    ("gyro", slice(0, 3), GYRO_MOTION_RAD_S, GYRO_VIBRATION_RAD_S, DEG, "deg/s"),
    ("accel", slice(3, 6), ACCEL_MOTION_M_S2, ACCEL_VIBRATION_M_S2, MG, "mg"),
)
_LEARN_FROM: Final = 60
_LEARNED_ENOUGH: Final = 3
_RECENT: Final = 10
_REFERENCE: Final = 5
_CHANCE: Final = 3.0
_LOWER_QUARTILE: Final = -0.6745
"""Sigmas."""


class Verdict(msgspec.Struct, frozen=True):
    """What one source's gate says of one second; `words` name the device and are empty when still."""

    still: bool
    words: str = ""
    fault: bool = False
    """Whether it is the device, not the aircraft, that is in the way."""
    what: str = ""
    """Of a movement the same without its figures; of a fault as it is."""


STILL: Final = Verdict(still=True)


def _words(what: str, found: float, allowed: float, unit: str, hint: str = "") -> Verdict:
    """'gyro fc moves 0.31 deg/s, max 0.10' and a hint, with as many digits as it takes to see the difference."""
    for digits in (2, 3, 4):
        left, right = f"{found:.{digits}f}", f"{allowed:.{digits}f}"
        if left != right:
            break
    return Verdict(still=False, words=f"{what} {left} {unit}, max {right}{hint}", what=what)


def _fault(words: str) -> Verdict:
    return Verdict(still=False, words=words, fault=True, what=words)


def _motion(
    variance: list[float], white: list[float], n: int, gate: float, rest: tuple[float, float]
) -> tuple[float, float]:
    """Rms of the slow part over the channels, and what is allowed: the gate, and chance.

    The difference of the two variance estimates of white noise has a variance of about sigma^4 / n a channel; that
    sigma^2 is the batch's own white part within the bounds `rest`, for fast motion looks white in part.
    """
    noise = _mean(white)
    slow = _mean(variance) - noise
    least, most = rest
    chance = _CHANCE * min(max(noise, least), most) / math.sqrt(n * len(white)) if n >= MIN_IMU_SAMPLES else 0.0
    return math.sqrt(max(slow, 0.0)), math.sqrt(gate**2 + chance)


def _mean(values: Sequence[float]) -> float:
    """Over a few channels, for which numpy takes ten times as long."""
    return sum(values) / len(values)


def _beyond(values: list[float], reference: Sequence[list[float]], chance: list[float]) -> float:
    """The largest difference of a channel from a mean, beyond what chance alone may make of it."""
    scatter = math.sqrt(1.0 + 1.0 / len(reference))  # of the difference, over that of one mean
    others = map(_mean, zip(*reference, strict=True))
    return max(abs(value - other) - scatter * alone for value, other, alone in zip(values, others, chance, strict=True))


def _is_within(batch: Batch) -> bool:
    return bool((np.maximum(np.abs(batch.low), np.abs(batch.high)) < _NO_END).all())


class ImuGate:
    """The gate of one IMU: six channels, gyro in rad/s, then accelerometer in m/s^2, in any fixed axes."""

    def __init__(
        self,
        name: str,
        profile: NoiseProfile,
        steps: tuple[float, float] = (0.0, 0.0),
        own: OwnNoise | None = None,
        *,
        sways: bool = False,
    ) -> None:
        self._name, self._sways = name, sways
        self._own = own or OwnNoise((profile.gyro.white, profile.accel.white))
        self._white = np.repeat([profile.gyro.white, profile.accel.white], 3)
        self._steps = Steps([steps[0]] * 3 + [steps[1]] * 3)
        self._learned = Recent(_LEARN_FROM, len(self._white))
        self._noise: Floats | None = None
        self.new_stretch()

    def new_stretch(self) -> None:
        """The still stretch has ended: references start again. The noise stays known."""
        self._recent: deque[list[float]] = deque(maxlen=_RECENT)
        self._start: list[list[float]] = []

    def forget_level(self) -> None:
        """The readings are not comparable with earlier ones: an offset was written, the owner restarted."""
        self._own.clear()
        self.new_stretch()

    def accept(self, batch: Batch) -> None:
        """The second counts as still for all sources."""
        self._recent.append(batch.mean[:3].tolist())
        if len(self._start) < _REFERENCE:
            self._start.append(batch.mean[3:].tolist())

    def judge(self, batch: Batch) -> Verdict:
        """Whether this second was still for this IMU; learns its noise on the way."""
        if (broken := self._broken(batch)) is not None:
            return broken
        self._steps.add(batch)
        self._own.add(batch)
        return self._moving(batch) or self._displaced(batch) or STILL

    def _broken(self, batch: Batch) -> Verdict | None:
        name = self._name
        if batch.n < MIN_IMU_SAMPLES:
            return _fault(f"imu {name} sends {batch.n} Hz, needs {MIN_IMU_SAMPLES}")
        if batch.largest_gap_s > MAX_IMU_GAP_S:
            return _fault(f"imu {name} was silent for {batch.largest_gap_s:.1f} s > {MAX_IMU_GAP_S}")
        if batch.clipped and not (self._sways and _is_within(batch)):
            # Whole numbers pile up at one end too in the second in which it comes to rest.
            ends = self._moving(batch) if _is_within(batch) else None
            return ends or _fault(f"imu {name} hits the end of its range")
        distinct = batch.distinct.tolist()
        if batch.n >= STUCK_SAMPLES and 1 in distinct:
            same = [count == 1 and step == 0.0 for count, step in zip(distinct, self._steps.told, strict=True)]
            for number, (part, triad, *_) in enumerate(_TRIADS):
                if all(same[triad]) and not self._steps.excuse(batch, number):
                    return _fault(f"{part} {name} is stuck: {batch.n} equal readings")
        return None

    def _moving(self, batch: Batch) -> Verdict | None:
        n, name = batch.n, self._name
        # What unfiltered white noise of the profile's density makes of one sample at this rate.
        floor = [noise * noise * n for noise in self._white.tolist()]
        sigma2 = self._sigma2(floor, n)
        self._noise = None if sigma2 is None else np.array(sigma2)
        variance, white = batch.variance.tolist(), batch.white.tolist()
        for number, (part, triad, motion, vibration, unit, unit_name) in enumerate(_TRIADS):
            own = self._own.known[number]
            noise = math.sqrt(floor[triad.start])
            shaking = max(vibration, 1.5 * noise, 0.0 if own is None else 1.5 * own.rms)
            rest = (0.0, shaking**2)
            if sigma2 is not None:
                known = _mean(sigma2[triad])
                rest = (known, GLRT_RATIO * known)
            # A known noisy sensor behind a low-pass looks like slow motion, hence the profile's noise here too.
            found, allowed = _motion(variance[triad], white[triad], n, max(motion, noise), rest)
            if own is not None:
                allowed = math.sqrt(motion**2 + max(own.slow, 0.0) + _CHANCE * own.chance)
            hint = self._own.hint(number)
            if found > allowed:
                return _words(f"{part} {name} moves", found / unit, allowed / unit, unit_name, hint)
            found = math.sqrt(_mean(variance[triad]))
            if found > shaking:
                return _words(f"{part} {name} shakes", found / unit, shaking / unit, unit_name, hint)
        self._learned.append(batch.variance)
        return None if sigma2 is None else self._likelihood(variance, n, sigma2)

    def _sigma2(self, floor: list[float], n: int) -> list[float] | None:
        """Variance of one sample at rest, learned; None until there is enough to learn from."""
        learned: list[float | None] = [None] * len(floor)
        if len(self._learned) >= _LEARNED_ENOUGH:
            ordered = np.sort(self._learned.rows, axis=0)
            below, share = divmod(0.25 * (len(ordered) - 1), 1.0)
            low, high = ordered[int(below)], ordered[int(below) + 1]
            learned[:] = ((low + (high - low) * share) / chi_square_ratio(n - 1, _LOWER_QUARTILE)).tolist()
        for (_, triad, *_), own in zip(_TRIADS, self._own.known, strict=True):
            if own is not None:
                learned[triad] = own.variance
        # A reading that toggles between two steps has up to a quarter of a step squared.
        least = [known + step * step / 4.0 for known, step in zip(floor, self._steps.sizes, strict=True)]
        found = [max(each, bound) for each, bound in zip(learned, least, strict=True) if each is not None]
        return found if len(found) == len(floor) else None

    def _likelihood(self, variance: list[float], n: int, sigma2: list[float]) -> Verdict | None:
        ratio = [found / known for found, known in zip(variance, sigma2, strict=True)]
        freedom = [n if own is None else min(own.freedom, n) for own in self._own.known]
        allowed = GLRT_RATIO * (1.0 + _CHANCE * math.sqrt(sum(2.0 / each for each in freedom) / 12.0))
        # T / (6 (W - 1) / W), the variances having n - 1 in their denominators.
        if _mean(ratio) <= allowed:
            return None
        part, triad, _, _, unit, unit_name = max(_TRIADS, key=lambda each: _mean(ratio[each[1]]))
        found = math.sqrt(_mean(variance[triad])) / unit
        return _words(f"{part} {self._name} moves", found, found * math.sqrt(allowed / _mean(ratio[triad])), unit_name)

    def _displaced(self, batch: Batch) -> Verdict | None:
        name, mean = self._name, batch.mean.tolist()
        rate, force = mean[:3], mean[3:]
        size = math.sqrt(sum(each * each for each in force))
        if not abs(size - GRAVITY_M_S2) <= GRAVITY_GATE_M_S2:
            unit = unit_of_force(size)
            return _fault(f"accel {name} reads {size:.1f} m/s^2, not gravity{f': in {unit}?' if unit else ''}")
        found = max(map(abs, rate))
        if found > MOST_GYRO_RAD_S:
            return _fault(f"gyro {name} reads {found / DEG:.0f} deg/s and nothing moves: deg/s for rad/s?")
        if found > GYRO_BIAS_RAD_S:
            return _words(f"gyro {name} turns or is biased by", found / DEG, GYRO_BIAS_RAD_S / DEG, "deg/s")
        # A few samples say little about their own scatter; what was learned says more.
        noise = batch.variance.tolist()
        if self._noise is not None:
            noise = list(map(max, noise, self._noise.tolist()))
        scatter = [each / batch.n for each in noise]
        for (_, triad, *_), own in zip(_TRIADS, self._own.known, strict=True):
            if own is not None:
                scatter[triad] = map(max, scatter[triad], own.density)
        chance = [_CHANCE * math.sqrt(each) for each in scatter]
        if self._recent:
            found = _beyond(rate, self._recent, chance[:3])
            if found > GYRO_STEP_RAD_S:
                return _words(f"gyro {name} moved by", found / DEG, GYRO_STEP_RAD_S / DEG, "deg/s")
            found = _beyond(force, self._start, chance[3:])
            if found > ACCEL_STEP_M_S2:
                return _words(f"accel {name} tilted by", found / MG, ACCEL_STEP_M_S2 / MG, "mg")
        return None


class PoseGate:
    """The gate of the gradienter (two channels, deg) or of the compass (one channel on the circle, deg)."""

    def __init__(self, name: Literal["gradienter", "compass"]) -> None:
        self._name, self._circle = name, name == "compass"
        tilt, heading = (TILT_MOTION_DEG, TILT_STEP_DEG), (HEADING_MOTION_DEG, HEADING_STEP_DEG)
        self._motion_deg, self._step_deg = heading if self._circle else tilt
        self.new_stretch()

    def new_stretch(self) -> None:
        """The still stretch has ended: the reference pose starts again."""
        self._start: list[Floats] = []

    def accept(self, batch: Batch) -> None:
        """The second counts as still for all sources."""
        if len(self._start) < _REFERENCE:
            self._start.append(batch.mean)

    def judge(self, batch: Batch) -> Verdict:
        """Whether this second was still for this sensor."""
        if batch.n > 1:
            variance, white = batch.variance.tolist(), batch.white.tolist()
            found, allowed = _motion(variance, white, batch.n, self._motion_deg, (0.0, self._motion_deg**2))
            if found > allowed:
                return _words(f"{self._name} moves", found, allowed, "deg")
        if self._start:
            # Against the first good second, so that averaging on the circle needs no care; the others refine it.
            first = self._start[0].tolist()
            turns = [self._deviations(each.tolist(), first) for each in self._start]
            refined = [_mean(of_one) for of_one in zip(*turns, strict=True)]
            turned = self._deviations(batch.mean.tolist(), first)
            off = [
                abs(turn - refined) - _CHANCE * math.sqrt(white / batch.n)
                for turn, refined, white in zip(turned, refined, batch.white.tolist(), strict=True)
            ]
            if max(off) > self._step_deg:
                return _words(f"{self._name} moved by", max(off), self._step_deg, "deg")
        return STILL

    def _deviations(self, values: list[float], first: list[float]) -> list[float]:
        differences = [value - begin for value, begin in zip(values, first, strict=True)]
        return [(each + 180.0) % 360.0 - 180.0 for each in differences] if self._circle else differences
