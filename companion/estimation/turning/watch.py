"""Detection of a turn of the ground, second by second, from compass and gyros.

The compass shows a turn as a slope of the heading since the last movement. The gyros show it as a change
from their rest rates, the mean rates at rest. If the heading turns but the gyros stay at their rest rates, the magnetic
field changes. If the gyros leave their rest rates but the heading is constant, their bias has changed. One gyro without
a compass cannot distinguish a turn from a new bias.

A gyro's bias does not jump; the rate of a platform that begins to turn does. The rest rate before the current window
limits the turn within the window. The limit depends on white noise of rest rate and window mean, on flicker and random
walk in between, and on warm-up (by the thermometer or by the slope of the rates).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Final

import msgspec
import numpy as np

from companion.config.sections import AllanModel, NoiseProfile
from companion.estimation.noise.allan import columns, floor_variance
from companion.estimation.noise.lines import FEWEST, Slope, fit_slope, hidden_by_steps
from companion.estimation.seconds.batch import Batch
from companion.estimation.turning.turn import CHANCE_SIGMAS, SIGNIFICANT, Turn, by_both, by_compass, by_gyros
from companion.physics.frames import Array, Floats, Matrix, vector
from companion.physics.units import DEG, DEG_H

LEVEL_S: Final = 5  # Least seconds at rest for a rest rate
RESTED_S: Final = 20
"""Least number of seconds in a window before a step of the rate: just after power-up, a warm-up looks like a step."""
NOISE_KNOWN_S: Final = 20
"""Least number of seconds in a window that show its white noise; a shorter window uses that of the last long one."""
PER_K_RAD_S: Final = 54.0 * DEG_H  # Bias of a common gyro per kelvin (BMI088, method.md section 2.1)
PER_G_RAD_S: Final = 0.1 * DEG  # Sensitivity of an uncompensated MEMS gyro to gravity: the rest rate depends on tilt
EARTH_RAD_S: Final = 15.04 * DEG_H
WARMING_S: Final = 120.0
"""Assumed duration of a warm-up, s. A visible warm-up was at most twice as steep before; an invisible one has ended."""
WARMING_RAD_S2: Final = 0.5 * DEG_H  # Drift of an older rest rate without thermometer, up to `WARMED_RAD_S`
WARMED_RAD_S: Final = 10.0 * PER_K_RAD_S
RAMP_SIGMAS: Final = 1.5
STEP_SIGMAS: Final = 5.0
STEP_CHI_SQUARE: Final = 12.0  # Threshold of chi-square by which a step fits better than a cubic (a warm-up)
ACROSS_SHARE: Final = 0.25
"""Share of a turn about the vertical that appears on horizontal axes if the assumed vertical is some degrees off."""
STEADY_SIGMAS: Final = 2.5  # Seconds farther off do not count as rest, else a slow turn would become the rest rate
CLEARED_S: Final = 10  # Seconds at the rest rate after which the latest movement has not started a turn
SMOOTHED_OVER: Final = 5  # Headings in one value of the wander, so that noise does not look like wander
BLIND_S: Final = 5  # Longest pause, for example while offsets are written, after which headings still belong together

# Columns of a second; rates and forces in vehicle FRD.
_SLOT: Final = 0
_RATES: Final = slice(1, 4)
_FORCES: Final = slice(4, 7)
_READINGS: Final = slice(1, 7)  # Rates and forces, vehicle FRD
_DEGC: Final = 7  # NaN without a thermometer
_TURNED: Final = 8  # Variance of the platform's rate by the compass, for seconds at rest; NaN without a compass


class ImuLevel:
    """Comparison of one IMU's rates in the current window with the rest rate: the mean over the seconds at rest before.

    `rotation`: from sensor to vehicle FRD. `steps`: resolution of an integer stream, rad/s and m/s^2; 0 for floats.

    `look` computes the results. `turn`: rate about the vertical, minus the rest rate; None without a rest.
    `has_changed`: the sensor has changed, because a rate about horizontal axes changed, as no turn does.
    `tilting_rad_s` (3,): rate at which gravity's direction tilts, vehicle FRD. `began`: first second after a step of
    the rate that neither noise nor warm-up explains. `step_rad_s`: error of the window's mean from the likeliest step;
    0 if chance explains that step. `white`: white noise N about the vertical.
    """

    def __init__(self, rotation: Matrix, profile: NoiseProfile, steps: tuple[float, float], span: int) -> None:
        self._gyro, self._steps, self._span = profile.gyro, steps, span
        self._rotation = np.kron(np.eye(2), rotation)
        self._least = columns(profile)  # N, B and K of its six channels
        self._white = np.zeros(6)
        """White noise N (6,) in the last window that was long enough to show it; zero for the accelerometers."""
        self.window: deque[Floats] = deque()
        self.rest: deque[Floats] = deque(maxlen=2 * span)
        self.turn: Turn | None = None
        self.has_changed = False
        self.tilting_rad_s: Array = np.zeros(3)
        self.tilting_variance = 0.0  # Variance of each component
        self.began: int | None = None
        self.step_rad_s = 0.0
        self.white = 0.0

    def add(self, slot: int, batch: Batch, turned: float | None) -> None:
        """Add a motionless second to the window; the one that leaves it joins `rest`. `turned`: see `end_window`."""
        degc = math.nan if batch.temperature_degc is None else batch.temperature_degc
        self.window.append(np.array([slot, *self._rotation @ batch.mean, degc, math.nan]))
        self._variance = batch.variance
        self.end_window(turned, self._span)

    def end_window(self, turned: float | None, kept: int = 0) -> None:
        """End the window, except for its latest `kept` seconds; the earlier seconds join the seconds at rest.

        `turned`: variance of the platform's rate by compass, NaN without a compass; None: drop the earlier seconds.
        """
        while len(self.window) > kept:
            second = self.window.popleft()
            if turned is None:
                continue
            usual = self._usual()
            if math.isnan(usual) and not math.isnan(turned):
                self.rest.clear()
            second[_TURNED] = usual if math.isnan(turned) else turned
            self.rest.append(second)

    def split(self, slot: int) -> None:
        """Make the window's seconds before a step at `slot` the new seconds at rest; drop those after the step."""
        turned = self._usual()
        self.rest.clear()
        while self.window and self.window[-1][_SLOT] >= slot:
            self.window.pop()
        self.end_window(turned)

    def _usual(self) -> float:
        return sum(float(second[_TURNED]) for second in self.rest) / len(self.rest) if self.rest else math.nan

    def look(self) -> bool:
        """Compute the results from the window and the seconds at rest; return false while the window is too short."""
        if len(self.window) < FEWEST:
            return False
        window = np.array(self.window)
        slots, rows = window[:, _SLOT].astype(np.int64), window[:, _READINGS]
        # Vertical from the accelerometers, (3,) vehicle FRD; its error of some degrees does not matter here.
        force = window[:, _FORCES].mean(axis=0)
        size = float(np.linalg.norm(force))
        down = np.asarray(-force / size)
        shows_noise = len(slots) >= NOISE_KNOWN_S
        slope = fit_slope(
            slots,
            rows,
            white=self._least[0] if shows_noise else np.maximum(self._least[0], self._white),
            flicker=self._least[1],
            walk=self._least[2],
            hidden=np.array([hidden_by_steps(self._steps[k // 3], float(self._variance[k])) for k in range(6)]),
        )
        if shows_noise:
            self._white[:3] = slope.white[:3].max()
        self.white = float(np.sqrt(np.square(down) @ np.square(slope.white[:3])))
        self.began, self.step_rad_s = None, 0.0
        if self._steps[0] == 0.0 and len(window) >= RESTED_S + LEVEL_S:
            self.began, self.step_rad_s = _step(window[:, _SLOT], window[:, _RATES] @ down, self.white, self._gyro)
        self.turn, self.has_changed = None, False
        if len(self.rest) >= LEVEL_S:
            self.turn, self.has_changed = self._above_level(window, slope, down)
        up, moves = -down, slope.per_s[3:] / size
        # d up / dt = -rate x up, so that the horizontal part of the rate is (d up / dt) x up.
        self.tilting_rad_s = np.cross(moves - up * (up @ moves), up)
        self.tilting_variance = float(slope.variance[3:].max()) / size**2
        return True

    def _above_level(self, window: Floats, slope: Slope, down: Array) -> tuple[Turn, bool]:
        """Return the turn relative to the rest rate, and true if rates about horizontal axes changed significantly."""
        count, weight = len(window), len(self.rest)
        level, now = np.array(self.rest).mean(axis=0), window.mean(axis=0)
        off = now[_RATES] - level[_RATES]
        unseen = float(np.nan_to_num(level[_TURNED]))
        age_s = float(now[_SLOT] - level[_SLOT])
        gap_s = max(age_s - (count + weight) / 2.0, 0.0)
        noise = np.square(slope.white[:3]) * (1.0 / count + 1.0 / weight)
        noise = noise + floor_variance(self._gyro.flicker, self._gyro.walk, weight, count + 2.0 * gap_s)
        # Warm-up: from the slope of the rates, or from the thermometer.
        ramp = np.abs(slope.per_s[:3])
        ramp = np.where(ramp > RAMP_SIGMAS * np.sqrt(slope.variance[:3]), ramp, 0.0)
        if math.isfinite(now[_DEGC] - level[_DEGC]):
            warmed = PER_K_RAD_S * float(now[_DEGC] - level[_DEGC])
        else:
            warmed = min(WARMING_RAD_S2 * max(age_s - WARMING_S, 0.0), WARMED_RAD_S)
        # An integer stream hides up to half a step in each mean.
        hidden = 0.5 * self._steps[0]
        leaned = float(np.linalg.norm(down + level[_FORCES] / np.linalg.norm(level[_FORCES])))
        felt = (PER_G_RAD_S + EARTH_RAD_S) * leaned
        variance = noise + np.square(2.0 * ramp * min(age_s, WARMING_S)) + warmed**2 + hidden**2 + felt**2
        along = float(off @ down)
        across = np.abs(off - along * down)
        # The heading may have changed: the Earth's rate then has another direction in the horizontal plane.
        limit = SIGNIFICANT * np.sqrt(variance + EARTH_RAD_S**2) + ACROSS_SHARE * abs(along)
        turn = Turn(
            rate_rad_s=along,
            sigma_rad_s=math.sqrt(np.square(down) @ variance + unseen),
            noise_rad_s=math.sqrt(np.square(down) @ noise + unseen),
            by="gyros",
            is_vouched=math.isfinite(level[_TURNED]),
        )
        return turn, bool((across > limit).any())


def _step(slots: Floats, values: Floats, white: float, model: AllanModel) -> tuple[int | None, float]:
    """Find the likeliest step in one-second means (m,), m >= `RESTED_S` + `LEVEL_S`; return `began`, `step_rad_s`."""
    count = len(values)
    values = values - values.mean()
    before = np.arange(RESTED_S, count - LEVEL_S + 1)
    after = count - before
    jump = -np.cumsum(values)[before - 1] * (1.0 / after + 1.0 / before)
    chance = white**2 * (1.0 / before + 1.0 / after)
    best = int(np.argmax(np.square(jump) / chance))
    first, last = float(before[best]), float(after[best])
    sigma = math.sqrt(chance[best] + floor_variance(model.flicker, model.walk, first, last))
    if abs(jump[best]) <= CHANCE_SIGMAS * sigma:
        return None, 0.0
    time = (slots - slots[0]) / (slots[-1] - slots[0])
    basis, _ = np.linalg.qr(np.vander(time, 4))
    better = jump[best] ** 2 / chance[best] - np.square(values @ basis).sum() / white**2
    is_sure = abs(jump[best]) > STEP_SIGMAS * sigma and better > STEP_CHI_SQUARE
    return int(slots[before[best]]) if is_sure else None, abs(float(jump[best])) * last / count


class TurnWatch:
    """Estimator of the platform's rate from seconds of gyros and compass; `span`: length of the longest window, s."""

    def __init__(self, span: int) -> None:
        self._span = span
        self._levels: dict[str, ImuLevel] = {}
        self._headings: deque[tuple[bool, Batch]] = deque(maxlen=span)
        """Compass seconds since the last movement, each with a flag: true if it belongs to the motionless period."""
        self._last_slot = 0
        self._start: int | None = None  # First second of the motionless period
        self._is_suspect = False
        """True after a movement or a step, when changed gyro rates can show a turn; otherwise they count as drift."""
        self.turn = Turn()  # Rate as of the last second
        self.words = ""
        """Reason, for the pilot, why a turn prevents a calibration; empty: no turn."""

    def set_imu(self, name: str, rotation: Matrix, profile: NoiseProfile, steps: tuple[float, float]) -> None:
        self._levels[name] = ImuLevel(rotation, profile, steps, self._span)

    def forget(self, imu: str | None) -> None:
        for name, level in self._levels.items():
            if imu is None or name == imu:
                level.window.clear()
                level.rest.clear()

    def new_stretch(self) -> None:
        """End the motionless period; its seconds become seconds at rest of each IMU."""
        turned = self._turned()
        for level in self._levels.values():
            level.end_window(turned if level.rest or len(level.window) >= LEVEL_S else None)
        self._headings = deque(((False, batch) for _, batch in self._headings), maxlen=self._span)
        self._start = None
        self.turn = Turn()

    def moved(self) -> None:
        self._headings.clear()
        self._is_suspect = True
        self.words = ""

    @property
    def wander_deg(self) -> float | None:
        """Range of the heading, deg, since the last movement, at most over the longest window; None: too short."""
        turned = np.unwrap([float(batch.mean[0]) for _, batch in self._headings], period=360.0)
        if len(turned) < SMOOTHED_OVER:
            return None
        return float(np.ptp(np.convolve(turned, np.full(SMOOTHED_OVER, 1.0 / SMOOTHED_OVER), "valid")))

    def add_second(self, slot: int, imus: Mapping[str, Batch], heading: Batch | None, *, good: bool) -> bool:
        """Add a second in which at most the compass moved; return false if the second ends the motionless period.

        `slot` must ascend. `heading`: None without a compass, or while the compass settles after a movement. `good`:
        the second belongs to a motionless period.
        """
        if slot - self._last_slot > BLIND_S:
            self._headings.clear()
        self._last_slot = slot
        if heading is not None:
            self._headings.append((good, heading))
        if good:
            self._start = slot if self._start is None else self._start
            turned = self._turned()
            for name, level in self._levels.items():
                if name in imus:
                    level.add(slot, imus[name], turned)
        return self._judge(slot)

    def _turned(self) -> float | None:
        """Return the variance of the platform's rate by compass, NaN without one; None: no second counts as rest."""
        turn = self.turn
        # With gyros alone, a gradual change counts as drift, and the rest rate follows it.
        drifts = turn.by == "gyros" and not self._is_suspect
        if self.words or (not drifts and abs(turn.rate_rad_s) > STEADY_SIGMAS * turn.sigma_rad_s):
            return None
        return turn.variance if turn.by in ("compass", "compass and gyros") else math.nan

    def _judge(self, slot: int) -> bool:
        found = [level for level in self._levels.values() if level.look()]
        # All gyros see a turn; the one with the least noise shows its beginning best.
        quietest = min(found, key=lambda one: one.white, default=None)
        if quietest is not None and quietest.began is not None:
            for level in self._levels.values():
                level.split(quietest.began)
            self._is_suspect = True
            return False
        turn = self._combined(found)
        if quietest is not None:
            surest = min(found, key=lambda one: one.tilting_variance)
            turn = msgspec.structs.replace(
                turn,
                tilting_rad_s=vector(surest.tilting_rad_s),
                tilting_sigma_rad_s=math.sqrt(surest.tilting_variance),
                step_rad_s=0.0 if turn.is_told else quietest.step_rad_s,
            )
        self.turn = turn
        noise = turn.noise_rad_s if turn.by == "gyros" else turn.sigma_rad_s
        is_long = self._start is not None and slot - self._start >= CLEARED_S
        if is_long and abs(turn.rate_rad_s) <= STEADY_SIGMAS * noise:
            self._is_suspect = False
        self.words = self._blocking_reason()
        return True

    def _combined(self, found: list[ImuLevel]) -> Turn:
        """Combine gyros and compass; an IMU that contradicts the result has changed and loses its seconds at rest."""
        gyros = by_gyros([one.turn for one in found if one.turn is not None and not one.has_changed])
        seen = by_compass([batch for _, batch in self._headings])
        if seen is None or not seen.is_significant:
            # A jump of the compass may lie before the motionless period.
            seen = by_compass([batch for good, batch in self._headings if good])
        turn = by_both(gyros, seen)
        others = gyros or turn if turn.is_significant else turn
        for one in found:
            if one.turn is not None and (one.has_changed or one.turn.contradicts(others)):
                one.rest.clear()
        return turn

    def _blocking_reason(self) -> str:
        turn = self.turn
        if not turn.is_significant or (turn.by == "gyros" and not self._is_suspect):
            return ""
        words = f"the aircraft {turn.in_words}"
        if turn.by == "compass and gyros":
            words += ": gyros and compass turn together"
        elif turn.by == "gyros" and len(self._levels) == 1:
            words += f", or gyro {next(iter(self._levels))} has changed: if it stands still, restart the companion"
        return words
