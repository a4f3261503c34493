"""The level of one IMU's gyros at rest, and by how much they are off it now.

A gyro's bias does not jump; a platform that begins to turn does. So what the gyros have read at rest in this power-up
bounds what they read more now. How well it does is a matter of the part: white noise of both means, flicker and random
walk in between, and what warming up does, by the thermometer or by the slope of the readings themselves.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import msgspec
import numpy as np

from companion.config.sections import AllanModel, NoiseProfile
from companion.estimation.noise.allan import floor_variance
from companion.estimation.noise.slope import FEWEST, Slope, fit_slope, hidden_by_steps
from companion.estimation.seconds.batch import Batch
from companion.estimation.seconds.recent import Recent
from companion.physics.frames import Array, Floats, Matrix
from companion.physics.units import DEG, DEG_H

LEVEL_S: Final = 5
"""So many seconds at rest make a level."""
RESTED_S: Final = 20
"""So many before a step within a stretch: in its first seconds after switching on a gyro warms up as fast as a step."""
TELLS_NOISE_S: Final = 20
"""So many seconds tell the white noise of their means; fewer are taken for as noisy as the stretch before."""
PER_K_RAD_S: Final = 54.0 * DEG_H
"""Of a common gyro's bias (BMI088, method 2.1)."""
PER_G_RAD_S: Final = 0.1 * DEG
"""By how much an uncompensated MEMS gyro feels gravity: its level is another one at another tilt."""
EARTH_RAD_S: Final = 15.04 * DEG_H
_WARMING_S: Final = 120.0
"""A warm-up that is seen now has gone on for so long, up to twice as steeply; one that is not seen is over."""
_WARMING_RAD_S2: Final = 0.5 * DEG_H
_WARMED_RAD_S: Final = 10.0 * PER_K_RAD_S
"""What an older level allows for where no thermometer tells, and at most."""
_RAMP_SIGMAS: Final = 1.5
_REMEMBERED: Final = 2
"""Windows before the latest in which a turn may have begun."""
HINT_SIGMAS: Final = 2.0
"""A step of no more than that is chance."""
ACROSS_SIGMAS: Final = 4.0
ACROSS_SHARE: Final = 0.25
"""A turn about the vertical shows across it by the error of the vertical only, some degrees."""


class Change(msgspec.Struct, frozen=True, kw_only=True):
    """What the gyros read more than at rest."""

    down_rad_s: float
    """About the vertical, clockwise seen from above."""
    variance: float
    noise: float
    """The part of it that is no warm-up, and was not before."""
    is_vouched: bool
    """Somebody else has seen that nothing turned when the level was measured."""
    is_across: bool
    """It has a part across the vertical that no turn of the ground has: the sensor has changed."""
    largest_rad_s: float
    """Of any axis."""


class Common(NamedTuple):
    """What all gyros show alike about the vertical."""

    rate: float
    variance: float
    noise: float
    is_vouched: bool


class Step(msgspec.Struct, frozen=True, kw_only=True):
    """Where within the stretch the rate about the vertical has most likely changed at once."""

    first: int
    """Second from which it has another mean."""
    sigmas: float
    """Of that difference, by the part's own noise."""
    beats_drift_by: float
    """Chi square by which a step fits better than a cubic does, a warm-up."""
    jump_rad_s: float
    off_rad_s: float
    """By how much the mean of the latest window is then off what was before."""


class Look(msgspec.Struct, frozen=True, kw_only=True):
    """What one IMU shows."""

    change: Change | None
    tilting_rad_s: Array
    """How fast the direction of gravity moves: (3,) horizontal, vehicle FRD."""
    tilting_variance: float
    """Of a component."""
    step: Step | None
    white: float
    """N about the vertical."""


_SLOT: Final = 0
_RATES: Final = slice(1, 4)
_READINGS: Final = slice(1, 7)
"""Rates and forces, vehicle FRD."""
_DEGC: Final = 7
_COLUMNS: Final = 8
"""Of a second at rest; NaN where no thermometer told."""


class _Level(msgspec.Struct):
    """A mean that forgets: the weight is bounded."""

    rows: Floats
    slot: float
    weight: float
    degc: float
    """NaN: not all of it is known."""
    turn_variance: float | None
    """What was not known of the platform's own turn at the time; None: nobody but the level itself told."""


class ImuLevel:
    """One IMU: its seconds of the stretch under way, and its level at rest from before them.

    `rotation`: sensor to vehicle FRD; `steps`: those of its stream, rad/s and m/s^2, 0 for floats.
    """

    def __init__(self, rotation: Matrix, profile: NoiseProfile, steps: tuple[float, float], span: int) -> None:
        self._gyro, self._steps = profile.gyro, steps
        self._memory = _REMEMBERED * span
        self._turned = np.asarray(rotation, dtype=np.float64)
        self._least = np.repeat([[m.white, m.flicker, m.walk] for m in (profile.gyro, profile.accel)], 3, axis=0).T
        """N, B and K of its six channels."""
        self._white = 0.0
        self._spread = np.zeros(6)
        """Variance of one reading."""
        self._seconds = Recent(span + self._memory, _COLUMNS)
        self.held = 0
        """Seconds for which it has been off its level by itself."""
        self.forget()

    def forget(self) -> None:
        """Its readings are not comparable with earlier ones."""
        self._clear()
        self._level: _Level | None = None
        self.held = 0

    def _clear(self) -> None:
        self._seconds.clear()
        self._measured = 0
        """Of those seconds, the latest, the others being older, but of the same stretch."""

    def add(self, slot: int, batch: Batch) -> None:
        """A still second."""
        mean, degc = batch.mean, batch.temperature_degc
        rates, forces = (self._turned @ mean[:3]).tolist(), (self._turned @ mean[3:]).tolist()
        self._seconds.append([slot, *rates, *forces, math.nan if degc is None else degc])
        self._measured += 1
        self._spread = np.array(batch.variance)

    def keep(self, least: int, *, trusted: bool, turn_variance: float | None) -> None:
        """Make all but the latest `least` seconds part of the level if they can be trusted.

        `turn_variance` is what was not known of the platform's own turn; None: nobody but the level itself tells.
        """
        if trusted and self._measured > least:
            rows = self._seconds.rows[-self._measured :]
            for second in rows[: self._measured - least]:
                self._level = self._with(second, turn_variance)
        self._measured = min(self._measured, least)

    def new_stretch(self, *, trusted: bool, turn_variance: float | None) -> None:
        """What was measured is over, and makes part of the level if it can be trusted."""
        enough = self._level is not None or self._measured >= LEVEL_S
        self.keep(0, trusted=trusted and enough, turn_variance=turn_variance)
        self._clear()

    def split(self, slot: int, *, turn_variance: float | None) -> None:
        """From that second on it is something new: the seconds before it are the level."""
        known = None if self._level is None else self._level.turn_variance
        self._level = None
        for second in self._seconds.rows:
            if second[_SLOT] < slot:
                self._level = self._with(second, known if turn_variance is None else turn_variance)
        self._clear()

    def adopt(self) -> None:
        """What it reads now is its level."""
        self._level = None
        self.held = 0

    def _with(self, second: Floats, turn_variance: float | None) -> _Level:
        level, readings, slot, degc = self._level, second[_READINGS], float(second[_SLOT]), float(second[_DEGC])
        if level is None or (level.turn_variance is None and turn_variance is not None):
            return _Level(readings.copy(), slot, 1.0, degc, turn_variance)
        level.weight = min(level.weight, self._memory / _REMEMBERED - 1.0) + 1.0
        share = 1.0 / level.weight
        level.rows = level.rows + share * (readings - level.rows)
        level.slot += share * (slot - level.slot)
        if turn_variance is not None and level.turn_variance is not None:
            level.turn_variance += share * (turn_variance - level.turn_variance)
        level.degc += share * (degc - level.degc)
        return level

    def look(self) -> Look | None:
        """Against its level, if there is one, and against gravity, over the seconds of this stretch."""
        if self._measured < FEWEST:
            return None
        seconds = self._seconds.rows
        latest = seconds[-self._measured :]
        slots, rows = latest[:, _SLOT].astype(np.int64), latest[:, _READINGS]
        # The vertical by its accelerometers, (3,) vehicle FRD; good to some degrees, and enough here.
        force = rows[:, 3:].mean(axis=0)
        down = np.asarray(-force / _length(force))
        hidden = [hidden_by_steps(self._steps[k // 3], float(self._spread[k])) for k in range(6)]
        own = len(slots) >= TELLS_NOISE_S
        slope = fit_slope(
            slots,
            rows,
            white=self._least[0] if own else np.maximum(self._least[0], [self._white] * 3 + [0.0] * 3),
            flicker=self._least[1],
            walk=self._least[2],
            hidden=np.array(hidden),
        )
        change = self._change(latest, slope, down)
        if own:
            self._white = float(slope.white[:3].max())
        white = float(np.sqrt(np.square(down) @ np.square(slope.white[:3])))
        step = None
        if self._steps[0] == 0.0 and len(seconds) >= RESTED_S + LEVEL_S:
            step = _step(seconds[:, _SLOT], seconds[:, _RATES] @ down, white, self._gyro, len(slots))
        up, moves = -down, slope.per_s[3:] / _length(force)
        return Look(
            change=change,
            # d up / dt = -rate x up, so that the level part of the rate is (d up / dt) x up.
            tilting_rad_s=np.cross(moves - up * (up @ moves), up),
            tilting_variance=float(slope.variance[3:].max()) / _length(force) ** 2,
            step=step,
            white=white,
        )

    def _change(self, latest: Floats, slope: Slope, down: Array) -> Change | None:
        level, white = self._level, slope.white[:3]
        if level is None or level.weight < LEVEL_S:
            return None
        count = len(latest)
        off = latest[:, _RATES].mean(axis=0) - level.rows[:3]
        middle = float(latest[:, _SLOT].mean()) - level.slot
        gap_s = max(middle - (count + level.weight) / 2.0, 0.0)
        variance = np.square(white) * (1.0 / count + 1.0 / level.weight)
        variance = variance + floor_variance(self._gyro.flicker, self._gyro.walk, level.weight, count + 2.0 * gap_s)
        unseen = level.turn_variance or 0.0
        noise = float(np.square(down) @ variance) + unseen
        # Warming up: as fast as the readings show, or as the thermometer says.
        ramp = np.abs(slope.per_s[:3])
        ramp = np.where(ramp > _RAMP_SIGMAS * np.sqrt(slope.variance[:3]), ramp, 0.0)
        variance = variance + np.square(2.0 * ramp * min(middle, _WARMING_S))
        told = latest[:, _DEGC]
        told = told[np.isfinite(told)]
        if len(told) and math.isfinite(level.degc):
            warmed = PER_K_RAD_S * (float(told.mean()) - level.degc)
        else:
            warmed = min(_WARMING_RAD_S2 * max(middle - _WARMING_S, 0.0), _WARMED_RAD_S)
        # Integers of the stream hide up to half a step each time.
        hidden = 0.5 * self._steps[0]
        was = level.rows[3:] / _length(level.rows[3:])
        leaned = _length(down + was)
        felt = (PER_G_RAD_S + EARTH_RAD_S) * leaned
        variance = variance + warmed**2 + hidden**2 + felt**2
        along = float(off @ down)
        of_down = float(np.square(down) @ variance) + unseen
        across = off - along * down
        # The heading may be another one: the Earth's rate is somewhere else in the level plane.
        limit = ACROSS_SIGMAS * np.sqrt(variance + EARTH_RAD_S**2) + ACROSS_SHARE * abs(along)
        return Change(
            down_rad_s=along,
            variance=of_down,
            noise=noise,
            is_vouched=level.turn_variance is not None,
            is_across=bool((np.abs(across) > limit).any()),
            largest_rad_s=float(np.abs(off).max()),
        )


def _length(vector: Floats) -> float:
    return math.sqrt(vector @ vector)


def _step(slots: Floats, values: Floats, white: float, model: AllanModel, window: int) -> Step | None:
    """The likeliest step in (m,) means of a second, m >= `RESTED_S` + `LEVEL_S`; the last `window` are measured.

    None where it is no more than chance.
    """
    count = len(values)
    values = values - values.mean()
    before = np.arange(RESTED_S, count - LEVEL_S + 1)
    after = count - before
    sums = np.cumsum(values)[before - 1]
    jump = -sums * (1.0 / after + 1.0 / before)
    chance = white**2 * (1.0 / before + 1.0 / after)
    best = int(np.argmax(np.square(jump) / chance))
    first, last = float(before[best]), float(after[best])
    sigma = math.sqrt(chance[best] + floor_variance(model.flicker, model.walk, first, last))
    if abs(jump[best]) <= HINT_SIGMAS * sigma:
        return None
    time = (slots - slots[0]) / (slots[-1] - slots[0])
    basis, _ = np.linalg.qr(np.vander(time, 4))
    drift = float(np.square(values @ basis).sum())
    return Step(
        first=int(slots[before[best]]),
        sigmas=float(abs(jump[best]) / sigma),
        beats_drift_by=float(jump[best] ** 2 / chance[best]) - drift / white**2,
        jump_rad_s=float(jump[best]),
        off_rad_s=float(jump[best]) * min(last / window, 1.0),
    )


def common_change(changes: list[Change]) -> Common | None:
    """What all gyros show alike about the vertical; None: nobody says.

    Of several that do not agree those that are at their level speak for the platform, and the others of themselves.
    """
    believed = [change for change in changes if not change.is_across]
    at_level = [one for one in believed if abs(one.down_rad_s) <= ACROSS_SIGMAS * math.sqrt(one.variance)]
    for group in (believed, at_level):
        if not group:
            continue
        weight = sum(1.0 / one.variance for one in group)
        rate = sum(one.down_rad_s / one.variance for one in group) / weight
        if all(abs(one.down_rad_s - rate) <= ACROSS_SIGMAS * math.sqrt(one.variance) for one in group):
            noise = 1.0 / sum(1.0 / one.noise for one in group)
            return Common(rate, 1.0 / weight, noise, any(one.is_vouched for one in group))
    return None
