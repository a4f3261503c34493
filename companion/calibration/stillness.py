"""Is the aircraft still? One verdict a second for every source, in words that name the device.

The detector is the generalised likelihood ratio test of Skog, Haendel, Nilsson and Rantakokko (IEEE Trans. Biomed.
Eng. 57(11), 2010) in its centred form: T = mean(sum((a - abar)^2 / s_a^2 + (w - wbar)^2 / s_w^2)), 6 (W - 1) / W when
at rest, because before a calibration the biases are unknown. What the centred form cannot see, a slow steady turn,
is left to gates on the means. Method section 3.

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
from collections.abc import Collection, Sized
from typing import Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.calibration.allan import NoiseProfile
from companion.calibration.batches import Batch
from companion.physics.units import DEG, MG

Floats = NDArray[np.float64]

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

GYRO_REST_RAD_S: Final = 0.5 * DEG
"""Against the level of the last still stretch: a bias does not move that far within minutes, a steady turn that is
slower needs twelve minutes for a circle."""

REST_HELD_S: Final = 30
"""So long a steady reading off the old level is believed to be a new bias: without this a shock to the sensor
would lock the gate until a restart."""

GYRO_BIAS_RAD_S: Final = 10.0 * DEG
"""With no prior at all: beyond any turn-on bias that a modern part specifies (typically 0.5 to 3 deg/s)."""

GYRO_PRIOR_RAD_S: Final = 1.0 * DEG
"""Against a prior given from outside: the worst common temperature coefficient (0.015 deg/s/K) times 65 K."""

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


class Verdict(msgspec.Struct, frozen=True):
    """What one source's gate says of one second; `words` name the device and are empty when still."""

    still: bool
    words: str = ""
    fault: bool = False
    """Whether it is the device, not the aircraft, that is in the way."""


STILL: Final = Verdict(still=True)


def _words(what: str, found: float, allowed: float, unit: str) -> Verdict:
    """'gyro fc 0.31 deg/s > 0.10', with as many digits as it takes to see the difference."""
    for digits in (2, 3, 4):
        left, right = f"{found:.{digits}f}", f"{allowed:.{digits}f}"
        if left != right:
            break
    return Verdict(still=False, words=f"{what} {left} {unit} > {right}")


def _fault(words: str) -> Verdict:
    return Verdict(still=False, words=words, fault=True)


def _motion(variance: Floats, white: Floats, n: int, gate: float, rest: tuple[float, float]) -> tuple[float, float]:
    """Rms of the slow part over the channels, and what is allowed: the gate, and chance.

    The difference of the two variance estimates of white noise has a variance of about sigma^4 / n a channel; that
    sigma^2 is the batch's own white part within the bounds `rest`, for fast motion looks white in part.
    """
    noise = _over(white)
    slow = _over(variance) - noise
    least, most = rest
    chance = _CHANCE * min(max(noise, least), most) / math.sqrt(n * len(white)) if n >= MIN_IMU_SAMPLES else 0.0
    return math.sqrt(max(slow, 0.0)), math.sqrt(gate**2 + chance)


def _lower_quartile(freedom: int) -> float:
    """Lower quartile of a variance estimate over the variance (Wilson and Hilferty's chi-square)."""
    spread = 2.0 / (9.0 * freedom)
    return (1.0 - spread - 0.6745 * math.sqrt(spread)) ** 3


def lower_quartile(values: Floats) -> Floats:
    """(c,) `np.quantile(values, 0.25, axis=0)` of (n, c) finite ones, to the last bit, at a tenth of its price."""
    ordered = np.sort(values, axis=0)
    place = 0.25 * (len(values) - 1)
    below = int(place)
    share = place - below
    low, high = ordered[below], ordered[min(below + 1, len(values) - 1)]
    step = high - low
    return np.asarray(low + step * share if share < 0.5 else high - step * (1.0 - share))


def _over(values: Floats) -> float:
    """The mean over a few channels; `mean` itself takes ten times as long for the same sum."""
    total = 0.0
    for value in values.tolist():
        total += value
    return total / len(values)


def _rows(values: Collection[Floats]) -> Floats:
    """(n, c) of n arrays (c,); numpy takes ten times as long to find that out by itself."""
    return np.concatenate(tuple(values)).reshape(len(values), -1)


def _mean(values: Collection[Floats] | Floats) -> Floats:
    """(c,) the mean of n arrays (c,) or of (n, c)."""
    rows = values if isinstance(values, np.ndarray) else _rows(values)
    return np.asarray(np.add.reduce(rows, axis=0) / len(rows))


def _both(reference: Sized) -> float:
    """Scatter of a difference of one mean and the mean of several, over that of one."""
    return math.sqrt(1.0 + 1.0 / len(reference))


class ImuGate:
    """The gate of one IMU: six channels, gyro in rad/s, then accelerometer in m/s^2, in any fixed axes.

    Args:
        name: as the pilot knows it.
        profile: its noise.
        steps: quantisation of gyro and accelerometer, 0 for floats.
        gyro_prior_rad_s: (3,) bias known from before, in the sensor's axes, where there is one.
    """

    def __init__(
        self,
        name: str,
        profile: NoiseProfile,
        steps: tuple[float, float] = (0.0, 0.0),
        gyro_prior_rad_s: Floats | None = None,
    ) -> None:
        self._name = name
        self._white = np.repeat([profile.gyro.white, profile.accel.white], 3)
        self._steps = np.repeat(np.asarray(steps, dtype=np.float64), 3)
        self._prior = gyro_prior_rad_s
        self._learned: deque[Floats] = deque(maxlen=_LEARN_FROM)
        self._noise: Floats | None = None
        self._rest: Floats | None = None
        self._off_level = 0
        self.new_stretch()

    def new_stretch(self) -> None:
        """The still stretch has ended: references start again. Noise and rest level stay known."""
        self._recent: deque[Floats] = deque(maxlen=_RECENT)
        self._start: list[Floats] = []

    def forget_level(self) -> None:
        """The readings are not comparable with earlier ones: an offset was written, the owner restarted."""
        self._rest = None
        self._off_level = 0
        self.new_stretch()

    def accept(self, batch: Batch, *, settled: bool) -> None:
        """The second counts as still for all sources; `settled` when the stretch is long enough to be believed."""
        self._recent.append(batch.mean[:3])
        if len(self._start) < _REFERENCE:
            self._start.append(batch.mean[3:])
        if settled:
            self._rest = _mean(self._recent)
            self._off_level = 0

    def judge(self, batch: Batch) -> Verdict:
        """Whether this second was still for this IMU; learns its noise on the way."""
        return self._broken(batch) or self._moving(batch) or self._displaced(batch) or STILL

    def _broken(self, batch: Batch) -> Verdict | None:
        name = self._name
        if batch.n < MIN_IMU_SAMPLES:
            return _fault(f"imu {name} sends {batch.n} Hz, needs {MIN_IMU_SAMPLES}")
        if batch.largest_gap_s > MAX_IMU_GAP_S:
            return _fault(f"imu {name} was silent for {batch.largest_gap_s:.1f} s > {MAX_IMU_GAP_S}")
        if batch.clipped:
            return _fault(f"imu {name} hits the end of its range")
        same = (batch.distinct == 1) & (self._steps == 0.0)
        if batch.n >= STUCK_SAMPLES and (bool(same[:3].all()) or bool(same[3:].all())):
            part = "gyro" if same[:3].all() else "accel"
            return _fault(f"{part} {name} is stuck: {batch.n} equal readings")
        return None

    def _moving(self, batch: Batch) -> Verdict | None:
        n, name = batch.n, self._name
        # What unfiltered white noise of the profile's density makes of one sample at this rate.
        floor = np.square(self._white) * n
        sigma2 = self._noise = self._sigma2(floor, n)
        variance, white = batch.variance, batch.white
        for part, triad, motion, vibration, unit, unit_name in _TRIADS:
            noise = math.sqrt(float(floor[triad][0]))
            shaking = max(vibration, 1.5 * noise)
            rest = (0.0, shaking**2)
            if sigma2 is not None:
                known = _over(sigma2[triad])
                rest = (known, GLRT_RATIO * known)
            # A known noisy sensor behind a low-pass looks like slow motion, hence the profile's noise here too.
            found, allowed = _motion(variance[triad], white[triad], n, max(motion, noise), rest)
            if found > allowed:
                return _words(f"{part} {name}", found / unit, allowed / unit, unit_name)
            found = math.sqrt(_over(variance[triad]))
            if found > shaking:
                return _words(f"{part} {name} shakes", found / unit, shaking / unit, unit_name)
        self._learned.append(variance)
        return None if sigma2 is None else self._likelihood(batch, sigma2)

    def _sigma2(self, floor: Floats, n: int) -> Floats | None:
        """Variance of one sample at rest, learned; None until there is enough to learn from."""
        if len(self._learned) < _LEARNED_ENOUGH:
            return None
        quiet = lower_quartile(_rows(self._learned)) / _lower_quartile(n - 1)
        # A truncated reading that toggles between two steps has up to a quarter of a step squared.
        return np.asarray(np.maximum(quiet, floor + np.square(self._steps) / 4.0))

    def _likelihood(self, batch: Batch, sigma2: Floats) -> Verdict | None:
        ratio = batch.variance / sigma2
        allowed = GLRT_RATIO * (1.0 + _CHANCE * math.sqrt(2.0 / (6.0 * batch.n)))
        # T / (6 (W - 1) / W), the variances having n - 1 in their denominators.
        if _over(ratio) <= allowed:
            return None
        gyro, accel = _over(ratio[:3]), _over(ratio[3:])
        if gyro >= accel:
            found = math.sqrt(_over(batch.variance[:3])) / DEG
            return _words(f"gyro {self._name}", found, found * math.sqrt(allowed / gyro), "deg/s")
        found = math.sqrt(_over(batch.variance[3:])) / MG
        return _words(f"accel {self._name}", found, found * math.sqrt(allowed / accel), "mg")

    def _displaced(self, batch: Batch) -> Verdict | None:
        name, rate, force = self._name, batch.mean[:3], batch.mean[3:]
        size = float(np.linalg.norm(force))
        if abs(size - GRAVITY_M_S2) > GRAVITY_GATE_M_S2:
            return _fault(f"accel {name} reads {size:.1f} m/s^2, not gravity")
        level, allowed = (0.0, GYRO_BIAS_RAD_S) if self._prior is None else (self._prior, GYRO_PRIOR_RAD_S)
        found = float(np.abs(rate - level).max())
        if found > allowed:
            return _words(f"gyro {name} turns or is biased by", found / DEG, allowed / DEG, "deg/s")
        # A few samples say little about their own scatter; what was learned says more.
        noise = batch.variance if self._noise is None else np.maximum(batch.variance, self._noise)
        chance = _CHANCE * np.sqrt(noise / batch.n)
        if self._recent:
            off = np.abs(rate - _mean(self._recent)) - chance[:3] * _both(self._recent)
            if float(off.max()) > GYRO_STEP_RAD_S:
                return _words(f"gyro {name} moved by", float(off.max()) / DEG, GYRO_STEP_RAD_S / DEG, "deg/s")
        if self._start:
            off = np.abs(force - _mean(self._start)) - chance[3:] * _both(self._start)
            if float(off.max()) > ACCEL_STEP_M_S2:
                return _words(f"accel {name} tilted by", float(off.max()) / MG, ACCEL_STEP_M_S2 / MG, "mg")
        return self._off_rest(rate)

    def _off_rest(self, rate: Floats) -> Verdict | None:
        if self._rest is None:
            return None
        found = float(np.abs(rate - self._rest).max())
        if found <= GYRO_REST_RAD_S:
            self._off_level = 0
            return None
        self._off_level += 1
        if self._off_level >= REST_HELD_S:
            self._rest = None
            self._off_level = 0
            return None
        return _words(f"gyro {self._name} turns by", found / DEG, GYRO_REST_RAD_S / DEG, "deg/s")


class PoseGate:
    """The gate of the gradienter (two channels, deg) or of the compass (one channel on the circle, deg)."""

    def __init__(self, name: str, motion_deg: float, step_deg: float, *, circle: bool = False) -> None:
        self._name = name
        self._motion_deg = motion_deg
        self._step_deg = step_deg
        self._circle = circle
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
            found, allowed = _motion(batch.variance, batch.white, batch.n, self._motion_deg, (0.0, self._motion_deg**2))
            if found > allowed:
                return _words(self._name, found, allowed, "deg")
        if self._start:
            # Against the first good second, so that averaging on the circle needs no care; the others refine it.
            turn = self._deviation(batch.mean - self._start[0])
            turn = turn - _mean(self._deviation(_rows(self._start) - self._start[0]))
            off = np.abs(turn) - _CHANCE * np.sqrt(batch.white / batch.n)
            if float(off.max()) > self._step_deg:
                return _words(f"{self._name} moved by", float(off.max()), self._step_deg, "deg")
        return STILL

    def _deviation(self, difference: Floats) -> Floats:
        return np.asarray(np.mod(difference + 180.0, 360.0) - 180.0) if self._circle else difference


def gradienter_gate() -> PoseGate:
    """The gate of the gradienter."""
    return PoseGate("gradienter", TILT_MOTION_DEG, TILT_STEP_DEG)


def compass_gate() -> PoseGate:
    """The gate of the compass."""
    return PoseGate("compass", HEADING_MOTION_DEG, HEADING_STEP_DEG, circle=True)
