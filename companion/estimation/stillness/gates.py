"""Gates that detect motion of the aircraft: one verdict per second and sensor, with a text that names the device.

Motion of an aircraft is slow compared with the sampling; sensor noise is mostly white. Half the mean square of
successive differences measures the white part of a second's variance. A gate on the rest of the variance therefore
works for a sensor of any noise, from its first second on. Noise behind a filter is learned (`own_noise`). Every gate is
widened by the chance error for its number of samples. Gates on means, and `turning`, detect a slow steady turn. One
set of constants serves all sensors; none is tuned to a recording.
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
from companion.estimation.stillness.own_noise import OwnNoise, freedom_of, parts_of_second
from companion.estimation.stillness.plausible import MOST_GYRO_RAD_S, unit_of_force
from companion.physics.frames import Floats
from companion.physics.statistics import chi_square_ratio
from companion.physics.units import DEG, MG

GYRO_MOTION_RAD_S: Final = 0.10 * DEG
"""Limit for the rms of slow changes of the gyro rate in one second. 0.1 deg/s over 10 s is an attitude error as large
as the gradienter's own error. Handling and walking cause 10 to 1000 times more; sensors at rest show less than half."""

ACCEL_MOTION_M_S2: Final = 10.0 * MG
"""Limit for the rms of slow changes of specific force in one second: 10 mg is a tilt by half a degree."""

GYRO_VIBRATION_RAD_S: Final = 1.0 * DEG
ACCEL_VIBRATION_M_S2: Final = 50.0 * MG
"""Limit for the total rms of specific force: three times the noisiest common sensor at its full rate. More shows a
running motor. Accelerometers rectify its vibration, so that their mean is wrong. Slow changes have their own limit."""

GYRO_STEP_RAD_S: Final = 0.05 * DEG
"""Limit for the change of a second's mean rate against the last good seconds, whose mean age is 5 s. A warm-up of 3
(deg/h)/s, more than ever observed, changes the rate by 0.004 deg/s in that time."""

ACCEL_STEP_M_S2: Final = 5.0 * MG
"""Limit for the change of mean force in a motionless period: a tilt of 0.3 deg. 10 K of warming cause 2 mg at most."""

GYRO_BIAS_RAD_S: Final = 10.0 * DEG  # Above any turn-on bias specified for a modern part (typically 0.5 to 3 deg/s)

GRAVITY_M_S2: Final = 9.81
GRAVITY_GATE_M_S2: Final = 1.5
"""Limit for the error of measured gravity: uncalibrated sensors have 0.1 g; wrong unit, dead axis, centrifuge more."""

TILT_MOTION_DEG: Final = 0.10
TILT_STEP_DEG: Final = 0.10  # Ten times a field gradienter's noise, and 1.7 mg on a horizontal accelerometer

HEADING_MOTION_DEG: Final = 2.0
HEADING_STEP_DEG: Final = 3.0  # Accuracy class of field compasses; 3 deg cause 0.6 deg/h on a horizontal gyro

MIN_IMU_SAMPLES: Final = 4
MAX_IMU_GAP_S: Final = 0.5
_LEAST_RANGE: Final = (60.0 * DEG,) * 3 + (14.0,) * 3
"""Smallest measuring range of any sensor model. Many equal extremes below it show rest or swaying, not clipping."""
STUCK_SAMPLES: Final = 10  # Least equal samples of a stuck sensor; fewer may be chance on a quiet one with coarse steps
STUCK_S: Final = 60  # Seconds after a change in steps during which a coarse stream may show one value

_TRIADS: Final = (
    ("gyro", slice(0, 3), GYRO_MOTION_RAD_S, GYRO_VIBRATION_RAD_S, DEG, "deg/s"),
    ("accel", slice(3, 6), ACCEL_MOTION_M_S2, ACCEL_VIBRATION_M_S2, MG, "mg"),
)
_FEW_LEVELS: Final = 4  # Most levels in one second of a stream whose noise is of the size of its steps
_TIMES_EACH: Final = 4  # Least readings per level: fewer do not show coarse steps
_COARSE_S: Final = 3  # Seconds of few levels that show a coarse stream
_RECENT: Final = 10
_REFERENCE: Final = 5
_CHANCE: Final = 3.0
_CHANCE_OF_FIVE: Final = 3.5  # The same for the largest of five averaging times
COMMON: Final = (0.045 * DEG, 0.7 * MG)
"""Noise N of the noisiest common gyro and accelerometer (ADIS16405), SI * sqrt(s), accepted from the first second."""
_LEAST_HALVINGS: Final = 4  # Of a second: 1/16 s of three samples or more, from 48 Hz on
_STATIONARY: Final = 2.0  # Largest ratio of noise at rest to its usual variance


class GateVerdict(msgspec.Struct, frozen=True):
    """Verdict of one gate on one second. `words`: reason, with the device's name, why that second shows motion.

    `fault`: the device, not the aircraft, blocks the calibration. `what`: reason without numbers, to count verdicts.
    """

    still: bool
    words: str = ""
    fault: bool = False
    what: str = ""


STILL: Final = GateVerdict(still=True)


def _words(what: str, found: float, allowed: float, unit: str, hint: str = "") -> GateVerdict:
    """Make a verdict with a text as in 'gyro fc moves 0.31 deg/s, max 0.10', in which both numbers look different."""
    for digits in (2, 3, 4):
        left, right = f"{found:.{digits}f}", f"{allowed:.{digits}f}"
        if left != right:
            break
    return GateVerdict(still=False, words=f"{what} {left} {unit}, max {right}{hint}", what=what)


def _fault(words: str) -> GateVerdict:
    return GateVerdict(still=False, words=words, fault=True, what=words)


def _slow_part(batch: Batch, channels: slice, gate: float, bounds: tuple[float, float]) -> tuple[float, float]:
    """Return the rms of slow changes over the channels, and its limit: the gate, widened for chance.

    For white noise, variance minus `Batch.white` has a variance of about sigma^4 / n per channel. For sigma^2 the
    second's own `white` is used, limited to `bounds`, because fast motion looks partly white.
    """
    white = batch.white[channels]
    chance = _CHANCE * float(np.clip(white.mean(), *bounds)) / math.sqrt(batch.n * len(white))
    return math.sqrt(max(batch.variance[channels].mean() - white.mean(), 0.0)), math.hypot(gate, math.sqrt(chance))


def _slow_by_density(batch: Batch, channels: slice, gate: float, density: float) -> tuple[float, float]:
    """Return the rms of slow changes over the channels, and its limit, from Allan variances in the second.

    Density is Allan variance times averaging time. Noise has one density at all averaging times if its filter is above
    some 10 Hz; a lower filter reduces density at short times. Motion adds density at long averaging times.
    """
    parts = parts_of_second(len(batch.allan))
    noise = density * parts
    freedom = (channels.stop - channels.start) * freedom_of(parts)
    allowed = gate**2 + noise * (chi_square_ratio(freedom, _CHANCE_OF_FIVE) - 1.0)
    beyond = float(((batch.allan[:, channels].mean(axis=1) - noise) / allowed).max())
    slow = math.sqrt(max(float((batch.variance - batch.white)[channels].mean()), 0.0))
    return slow, max(gate, slow / math.sqrt(beyond)) if beyond > 0.0 else math.inf


def _shortest_density(batch: Batch) -> Floats:
    """Return the noise density (6,) at the shortest averaging time, which is N^2 unless a filter reduces it."""
    return batch.allan[-1] / 2.0 ** len(batch.allan) if len(batch.allan) >= _LEAST_HALVINGS else batch.white / batch.n


class ImuGate:
    """Gate on the motion of one IMU. Its six channels are gyro, rad/s, then accelerometer, m/s^2, in any fixed axes.

    `steps`: resolution of a stream of integers, 0 for floats. `own`: learned noise of this IMU, if any.
    """

    def __init__(
        self,
        name: str,
        profile: NoiseProfile,
        steps: tuple[float, float] = (0.0, 0.0),
        own: OwnNoise | None = None,
    ) -> None:
        self._name = name
        self._own = own or OwnNoise((profile.gyro.white, profile.accel.white))
        self._white = profile.gyro.white, profile.accel.white
        self._is_float = np.repeat(steps, 3) == 0.0
        self._few_levels_s = np.zeros(6, dtype=np.int64)
        """Number of seconds (6,) with few distinct readings, counted since the last second with many."""
        self._coarse_slot = [-math.inf, -math.inf]
        """Slots of the latest seconds in which the gyro, and the accelerometer, changed in coarse steps."""
        self._densities: deque[Floats] = deque(maxlen=_RECENT)  # Noise densities of seconds without motion
        self._density = np.zeros(6)
        """Noise density N^2, median of the latest seconds without motion; zero before the first of them."""
        self.new_stretch()

    def new_stretch(self) -> None:
        """End the motionless period: drop the readings with which later ones are compared, not the learned noise."""
        self._recent: deque[Floats] = deque(maxlen=_RECENT)
        self._start: list[Floats] = []

    def forget_level(self) -> None:
        """Drop all readings after a write of offsets or a restart, which can change all later readings."""
        self._own.clear()
        self.new_stretch()

    def accept(self, batch: Batch) -> None:
        self._recent.append(batch.mean[:3])
        if len(self._start) < _REFERENCE:
            self._start.append(batch.mean[3:])

    def judge(self, batch: Batch) -> GateVerdict:
        if (broken := self._broken(batch)) is not None:
            return broken
        self._watch_steps(batch)
        self._own.add(batch)
        return self._moving(batch) or self._displaced(batch) or STILL

    def _broken(self, batch: Batch) -> GateVerdict | None:
        name = self._name
        if batch.n < MIN_IMU_SAMPLES:
            return _fault(f"imu {name} sends {batch.n} Hz, needs {MIN_IMU_SAMPLES}")
        if batch.largest_gap_s > MAX_IMU_GAP_S:
            return _fault(f"imu {name} was silent for {batch.largest_gap_s:.1f} s > {MAX_IMU_GAP_S}")
        if batch.clipped and (np.maximum(np.abs(batch.low), np.abs(batch.high)) >= _LEAST_RANGE).any():
            return _fault(f"imu {name} hits the end of its range")
        if batch.n >= STUCK_SAMPLES:
            constant = (batch.distinct == 1) & self._is_float
            for (part, triad, *_), coarse_slot in zip(_TRIADS, self._coarse_slot, strict=True):
                if constant[triad].all() and not 0 <= batch.slot - coarse_slot <= STUCK_S:
                    return _fault(f"{part} {name} is stuck: {batch.n} equal readings")
        return None

    def _watch_steps(self, batch: Batch) -> None:
        """Detect a stream of floats with coarse steps: some logs are rounded, and some parts have few digits.

        If the noise is smaller than a step, a motionless sensor shows one value or toggles between two. A second with
        few values can come from a frozen sensor; several such seconds show coarse steps.
        """
        levels = batch.distinct
        few = (levels >= 2) & (levels <= _FEW_LEVELS) & (levels * _TIMES_EACH <= batch.n)
        self._few_levels_s = np.where(levels > _FEW_LEVELS, 0, self._few_levels_s + few)
        for number, (_, triad, *_) in enumerate(_TRIADS):
            if (few & (self._few_levels_s >= _COARSE_S))[triad].any():
                self._coarse_slot[number] = batch.slot

    def _moving(self, batch: Batch) -> GateVerdict | None:
        shortest = _shortest_density(batch)
        for number, (part, triad, motion, vibration, unit, unit_name) in enumerate(_TRIADS):
            # Noise of one sample at this rate, if the profile's white noise is unfiltered.
            own, noise = self._own.known[number], self._white[number] * math.sqrt(batch.n)
            shaking = max(vibration, 1.5 * noise, 0.0 if own is None else 1.5 * math.sqrt(own.variance.mean()))
            known = float(self._density[triad].mean())
            if len(batch.allan) >= _LEAST_HALVINGS:
                # Noise between neighbouring samples is white whatever its size; fast motion looks white in part.
                white = min(float(batch.white[triad].mean()), vibration**2) / batch.n
                most = max(COMMON[number] ** 2, self._white[number] ** 2, white)
                most = min(most, _STATIONARY * known) if known > 0.0 else most
                density = min(float(shortest[triad].mean()), most) if own is None else float(own.density.mean())
                found, allowed = _slow_by_density(batch, triad, motion, density)
            else:
                bounds = (known * batch.n, _STATIONARY * known * batch.n if known > 0.0 else shaking**2)
                # A known noisy sensor behind a low-pass looks like slow motion, hence the profile's noise here too.
                found, allowed = _slow_part(batch, triad, max(motion, noise), bounds)
                if own is not None:
                    allowed = math.sqrt(
                        motion**2 + max(float((own.variance - own.white).mean()), 0.0) + _CHANCE * own.chance
                    )
            hint = self._own.hint(number)
            if found > allowed:
                return _words(f"{part} {self._name} moves", found / unit, allowed / unit, unit_name, hint)
            found = math.sqrt(batch.variance[triad].mean())
            if found > shaking:
                return _words(f"{part} {self._name} shakes", found / unit, shaking / unit, unit_name, hint)
        self._densities.append(shortest)
        self._density = np.median(self._densities, axis=0)
        return None

    def _displaced(self, batch: Batch) -> GateVerdict | None:
        name, rate, force = self._name, batch.mean[:3], batch.mean[3:]
        size, turns = math.sqrt(force @ force), float(np.abs(rate).max())
        if not abs(size - GRAVITY_M_S2) <= GRAVITY_GATE_M_S2:
            unit = unit_of_force(size)
            return _fault(f"accel {name} reads {size:.1f} m/s^2, not gravity{f': in {unit}?' if unit else ''}")
        if turns > MOST_GYRO_RAD_S:
            return _fault(f"gyro {name} reads {turns / DEG:.0f} deg/s and nothing moves: deg/s for rad/s?")
        if turns > GYRO_BIAS_RAD_S:
            return _words(f"gyro {name} turns or is biased by", turns / DEG, GYRO_BIAS_RAD_S / DEG, "deg/s")
        if not self._recent:
            return None
        # A few samples hardly show their own scatter; the learned noise does.
        scatter = np.maximum(batch.variance / batch.n, self._density)
        for (_, triad, *_), own in zip(_TRIADS, self._own.known, strict=True):
            if own is not None:
                scatter[triad] = np.maximum(scatter[triad], own.density)
        chance = _CHANCE * np.sqrt(scatter)
        found = _beyond(rate, self._recent, chance[:3])
        if found > GYRO_STEP_RAD_S:
            return _words(f"gyro {name} moved by", found / DEG, GYRO_STEP_RAD_S / DEG, "deg/s")
        found = _beyond(force, self._start, chance[3:])
        if found > ACCEL_STEP_M_S2:
            return _words(f"accel {name} tilted by", found / MG, ACCEL_STEP_M_S2 / MG, "mg")
        return None


def _beyond(values: Floats, reference: Sequence[Floats], chance: Floats) -> float:
    """Return the largest difference of a channel from its mean in earlier seconds, minus the difference by chance."""
    scatter = math.sqrt(1.0 + 1.0 / len(reference))  # sigma of the difference over that of one mean
    return float((np.abs(values - np.mean(reference, axis=0)) - scatter * chance).max())


class PoseGate:
    """Gate on the motion of the gradienter (two channels, deg) or of the compass (one channel, deg, modulo 360)."""

    def __init__(self, name: Literal["gradienter", "compass"]) -> None:
        self._name = name
        tilt, heading = (TILT_MOTION_DEG, TILT_STEP_DEG), (HEADING_MOTION_DEG, HEADING_STEP_DEG)
        self._motion_deg, self._step_deg = heading if name == "compass" else tilt
        self.new_stretch()

    def new_stretch(self) -> None:
        self._start: list[Floats] = []

    def accept(self, batch: Batch) -> None:
        if len(self._start) < _REFERENCE:
            self._start.append(batch.mean)

    def judge(self, batch: Batch) -> GateVerdict:
        every = slice(None)
        found, allowed = _slow_part(batch, every, self._motion_deg, (0.0, self._motion_deg**2))
        if found > allowed:
            return _words(f"{self._name} moves", found, allowed, "deg")
        if self._start:
            # Relative to the first second, so that averaging on the circle needs no care.
            first = self._start[0]
            refined = _wrapped(np.array(self._start) - first).mean(axis=0)
            off = np.abs(_wrapped(batch.mean - first) - refined) - _CHANCE * np.sqrt(batch.white / batch.n)
            if off.max() > self._step_deg:
                return _words(f"{self._name} moved by", float(off.max()), self._step_deg, "deg")
        return STILL


def _wrapped(angles_deg: Floats) -> Floats:
    return np.asarray(np.mod(angles_deg + 180.0, 360.0) - 180.0)
