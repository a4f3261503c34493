"""Level of one IMU's gyros at rest, and how far the gyros are off it now.

A gyro's bias does not jump; a platform that begins to turn does. The mean rate at rest before the current window
therefore bounds the turn within it. The bound depends on the part: white noise of both means, flicker and random walk
in between, and warm-up, from the thermometer or from the slope of the rates.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final, NamedTuple

import numpy as np

from companion.config.sections import AllanModel, NoiseProfile
from companion.estimation.noise.allan import floor_variance
from companion.estimation.noise.slope import FEWEST, Slope, fit_slope, hidden_by_steps
from companion.estimation.seconds.batch import Batch
from companion.estimation.turning.turn import SIGNIFICANT, Turn
from companion.physics.frames import Array, Floats, Matrix
from companion.physics.units import DEG, DEG_H

LEVEL_S: Final = 5
"""Least seconds at rest that make a level."""
RESTED_S: Final = 20
"""Least seconds before a step within a window: just after switching on, a gyro warms up as fast as a step."""
NOISE_KNOWN_S: Final = 20
"""Least seconds that show the white noise of their means; before that, the noise of the last window holds."""
PER_K_RAD_S: Final = 54.0 * DEG_H
"""Bias of a common gyro per kelvin (BMI088, method 2.1)."""
PER_G_RAD_S: Final = 0.1 * DEG
"""Sensitivity of an uncompensated MEMS gyro to gravity: another tilt gives another level."""
EARTH_RAD_S: Final = 15.04 * DEG_H
WARMING_S: Final = 120.0
"""A warm-up that is visible now may have been twice as steep for so long; an invisible one is over after it."""
WARMING_RAD_S2: Final = 0.5 * DEG_H
"""Drift of an older level without thermometer, at most by `WARMED_RAD_S`."""
WARMED_RAD_S: Final = 10.0 * PER_K_RAD_S
RAMP_SIGMAS: Final = 1.5
HINT_SIGMAS: Final = 2.0
"""A smaller step is chance."""
STEP_SIGMAS: Final = 5.0
STEP_CHI_SQUARE: Final = 12.0
"""Gain of a step over a cubic, a warm-up, from which it is sure."""
ACROSS_SHARE: Final = 0.25
"""Share of a turn about the vertical that an error of the vertical, some degrees, shows in the level plane."""


class GyroEvidence(NamedTuple):
    """Evidence of one IMU about a turn of the platform."""

    turn: Turn | None
    """Rate about the vertical above the level at rest; None without a level."""
    has_changed: bool
    """Part of that rate lies in the level plane, as no turn of the ground does: the sensor itself has changed."""
    tilting_rad_s: Array
    """Rotation of the direction of gravity: (3,) horizontal, vehicle FRD."""
    tilting_variance: float
    """Variance of each component."""
    began: int | None
    """First second after a step of the rate that neither the part's noise nor a warm-up explains."""
    step_rad_s: float
    """Error that the likeliest step leaves in the mean of the window; 0 where it is chance."""
    white: float
    """White noise N about the vertical."""


_SLOT: Final = 0
_RATES: Final = slice(1, 4)
_READINGS: Final = slice(1, 7)
"""Rates and forces, vehicle FRD."""
_DEGC: Final = 7
"""NaN without a thermometer."""
_TURNED: Final = 8
"""Variance of the platform's rate by the compass, for seconds of the level; NaN without a compass."""


class ImuLevel:
    """Seconds of one IMU: those of the current window, and those at rest before it, which are its level.

    `rotation`: sensor to vehicle FRD; `steps`: resolution of its stream, rad/s and m/s^2, 0 for floats.
    """

    def __init__(self, rotation: Matrix, profile: NoiseProfile, steps: tuple[float, float], span: int) -> None:
        self._gyro, self._steps, self._span = profile.gyro, steps, span
        self._turned = np.asarray(rotation, dtype=np.float64)
        self._least = np.repeat([[m.white, m.flicker, m.walk] for m in (profile.gyro, profile.accel)], 3, axis=0).T
        """N, B and K of its six channels."""
        self._white = np.zeros(6)
        """White noise of the last window that was long enough to show it; only that of the gyros is kept."""
        self._window: deque[list[float]] = deque()
        self._level: deque[list[float]] = deque(maxlen=2 * span)

    def forget_level(self) -> None:
        """Begin a new level."""
        self._level.clear()

    def forget(self) -> None:
        """Drop all: readings are not comparable with earlier ones."""
        self._window.clear()
        self._level.clear()

    def add(self, slot: int, batch: Batch, turned: float | None) -> None:
        """Add a still second; one that leaves the window joins the level, with `turned` as in `new_stretch`."""
        degc = math.nan if batch.temperature_degc is None else batch.temperature_degc
        rates, forces = (self._turned @ batch.mean[:3]).tolist(), (self._turned @ batch.mean[3:]).tolist()
        self._window.append([float(slot), *rates, *forces, degc])
        self._variance = np.array(batch.variance)
        self._keep(self._span, turned)

    def new_stretch(self, turned: float | None) -> None:
        """End the window; its seconds join the level.

        `turned`: variance of the platform's rate by the compass, NaN without; None: it turns, and they do not join.
        """
        self._keep(0, turned if self._level or len(self._window) >= LEVEL_S else None)

    def split(self, slot: int) -> None:
        """Make the seconds before a step the level; drop those after it."""
        turned = self._usual()
        self._level.clear()
        while self._window and self._window[-1][_SLOT] >= slot:
            self._window.pop()
        self._keep(0, turned)

    def _keep(self, latest: int, turned: float | None) -> None:
        while len(self._window) > latest:
            second = self._window.popleft()
            if turned is None:
                continue
            usual = self._usual()
            if math.isnan(usual) and not math.isnan(turned):
                self._level.clear()
            self._level.append([*second, usual if math.isnan(turned) else turned])

    def _usual(self) -> float:
        """Variance of the platform's rate during the level."""
        return sum(second[_TURNED] for second in self._level) / len(self._level) if self._level else math.nan

    def evidence(self) -> GyroEvidence | None:
        """Compare the window with the level, if there is one, and with gravity; None while it is too short."""
        if len(self._window) < FEWEST:
            return None
        window = np.array(self._window)
        slots, rows = window[:, _SLOT].astype(np.int64), window[:, _READINGS]
        # The vertical by its accelerometers, (3,) vehicle FRD; good to some degrees, which is enough here.
        force = rows[:, 3:].mean(axis=0)
        down = np.asarray(-force / _length(force))
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
        white = float(np.sqrt(np.square(down) @ np.square(slope.white[:3])))
        began, step_rad_s = None, 0.0
        if self._steps[0] == 0.0 and len(window) >= RESTED_S + LEVEL_S:
            began, step_rad_s = _step(window[:, _SLOT], window[:, _RATES] @ down, white, self._gyro)
        turn, has_changed = self._turn(window, slope, down)
        up, moves = -down, slope.per_s[3:] / _length(force)
        # d up / dt = -rate x up, so that the level part of the rate is (d up / dt) x up.
        tilting = np.cross(moves - up * (up @ moves), up)
        tilting_variance = float(slope.variance[3:].max()) / _length(force) ** 2
        return GyroEvidence(turn, has_changed, tilting, tilting_variance, began, step_rad_s, white)

    def _turn(self, window: Floats, slope: Slope, down: Array) -> tuple[Turn | None, bool]:
        """Return the rate above the level about the vertical, and whether another part is above it too."""
        count, weight = len(window), len(self._level)
        if weight < LEVEL_S:
            return None, False
        level = np.array(self._level).mean(axis=0)
        now = window.mean(axis=0)
        off = now[_RATES] - level[_RATES]
        unseen = float(np.nan_to_num(level[_TURNED]))
        age_s = float(now[_SLOT] - level[_SLOT])
        gap_s = max(age_s - (count + weight) / 2.0, 0.0)
        noise = np.square(slope.white[:3]) * (1.0 / count + 1.0 / weight)
        noise = noise + floor_variance(self._gyro.flicker, self._gyro.walk, weight, count + 2.0 * gap_s)
        # Warm-up: as fast as the rates show, or as the thermometer says.
        ramp = np.abs(slope.per_s[:3])
        ramp = np.where(ramp > RAMP_SIGMAS * np.sqrt(slope.variance[:3]), ramp, 0.0)
        if math.isfinite(now[_DEGC] - level[_DEGC]):
            warmed = PER_K_RAD_S * float(now[_DEGC] - level[_DEGC])
        else:
            warmed = min(WARMING_RAD_S2 * max(age_s - WARMING_S, 0.0), WARMED_RAD_S)
        # Integers of the stream hide up to half a step each time.
        hidden = 0.5 * self._steps[0]
        leaned = _length(down + level[4:7] / _length(level[4:7]))
        felt = (PER_G_RAD_S + EARTH_RAD_S) * leaned
        variance = noise + np.square(2.0 * ramp * min(age_s, WARMING_S)) + warmed**2 + hidden**2 + felt**2
        along = float(off @ down)
        across = np.abs(off - along * down)
        # The heading may be another one: the Earth's rate then points elsewhere in the level plane.
        limit = SIGNIFICANT * np.sqrt(variance + EARTH_RAD_S**2) + ACROSS_SHARE * abs(along)
        turn = Turn(
            rate_rad_s=along,
            sigma_rad_s=math.sqrt(np.square(down) @ variance + unseen),
            noise_rad_s=math.sqrt(np.square(down) @ noise + unseen),
            by="gyros",
            is_vouched=math.isfinite(level[_TURNED]),
        )
        return turn, bool((across > limit).any())


def _length(vector: Floats) -> float:
    return math.sqrt(vector @ vector)


def _step(slots: Floats, values: Floats, white: float, model: AllanModel) -> tuple[int | None, float]:
    """Find the likeliest step in (m,) means of a second, m >= `RESTED_S` + `LEVEL_S`; for `GyroEvidence`."""
    count = len(values)
    values = values - values.mean()
    before = np.arange(RESTED_S, count - LEVEL_S + 1)
    after = count - before
    jump = -np.cumsum(values)[before - 1] * (1.0 / after + 1.0 / before)
    chance = white**2 * (1.0 / before + 1.0 / after)
    best = int(np.argmax(np.square(jump) / chance))
    first, last = float(before[best]), float(after[best])
    sigma = math.sqrt(chance[best] + floor_variance(model.flicker, model.walk, first, last))
    if abs(jump[best]) <= HINT_SIGMAS * sigma:
        return None, 0.0
    time = (slots - slots[0]) / (slots[-1] - slots[0])
    basis, _ = np.linalg.qr(np.vander(time, 4))
    better = jump[best] ** 2 / chance[best] - np.square(values @ basis).sum() / white**2
    is_sure = abs(jump[best]) > STEP_SIGMAS * sigma and better > STEP_CHI_SQUARE
    return int(slots[before[best]]) if is_sure else None, abs(float(jump[best])) * last / count
