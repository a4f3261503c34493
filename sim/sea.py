"""A boat in waves: what an aircraft on its deck goes through.

Every wave is a narrow band: components of equal size, spread around its frequency, with random phases, so that it comes
in groups as real waves do. Roll and pitch have components of their own. The boat is pushed along its slopes too: in
long waves a raft lies across the apparent vertical, and a fluid level on it feels little of its tilt.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from sim.earth import STANDARD_GRAVITY_M_S2, Array
from sim.motions import Motion, SlowTurn, Vibration, smooth_step

COMPONENTS: Final = 16
"""Of one wave about one axis."""
DAY_S: Final = 86400.0
SURGE: Final = 0.3


@dataclass(frozen=True, slots=True)
class Wave:
    """One narrow band; of a pure sine with the same energy, `sway_deg` is the amplitude."""

    frequency_hz: float
    sway_deg: float
    spread: float = 0.1
    """Standard deviation of the components' frequencies over the frequency itself."""


SWELL: Final = (Wave(0.2, 5.0), Wave(0.05, 1.0))
"""A small boat at its mooring, with some swell."""


@dataclass(frozen=True, kw_only=True)
class Sea(Motion):
    """Roll and pitch by waves, with the accelerations that belong to them."""

    start_s: float = 0.0
    duration_s: float = DAY_S
    waves: tuple[Wave, ...] = SWELL
    surge: float = SURGE
    """Sideways acceleration over g times the slope; 1: a raft, on which no tilt is felt."""
    surge_lead_rad: float = 0.5
    """By how much that is ahead of the slope."""
    heave: float = 0.3
    """Vertical acceleration likewise, a quarter of a wave behind, as water goes round in circles."""
    rise_s: float = 5.0
    """How long it takes to come up and to die away."""
    seed: int = 0

    def _height(self, t_s: Array) -> tuple[Array, Array]:
        """How far it has come up, 0 to 1, and the derivative in 1/s."""
        rise_s = min(self.rise_s, self.duration_s / 2.0)
        up, up_slope = smooth_step((t_s - self.start_s) / rise_s)
        down, down_slope = smooth_step((self.end_s - t_s) / rise_s)
        return up * down, (up_slope * down - up * down_slope) / rise_s

    def _sums(self, t_s: Array) -> tuple[Array, Array, Array]:
        """Roll and pitch (n, 2), what they are a quarter of a wave later, and their derivatives."""
        frequencies, amplitudes, phases = _components(self.waves, self.seed)
        angles, later, slopes = np.empty((3, len(t_s), 2))
        for axis in range(2):
            argument = np.outer(t_s - self.start_s, frequencies[axis]) + phases[axis]
            cosines = np.cos(argument)
            angles[:, axis] = np.sin(argument) @ amplitudes[axis]
            later[:, axis] = cosines @ amplitudes[axis]
            slopes[:, axis] = cosines @ (amplitudes[axis] * frequencies[axis])
        return angles, later, slopes

    def euler_rad(self, t_s: Array) -> tuple[Array, Array]:
        """Added angles and rates."""
        angles, _, slopes = self._sums(t_s)
        height, rising = self._height(t_s)
        turned, rates = np.zeros((2, len(t_s), 3))
        turned[:, :2] = height[:, None] * angles
        rates[:, :2] = height[:, None] * slopes + rising[:, None] * angles
        return turned, rates

    def level_acceleration_m_s2(self, t_s: Array) -> Array:
        """Surge, sway and heave: down the slope, and round."""
        angles, later, _ = self._sums(t_s)
        slope = math.cos(self.surge_lead_rad) * angles + math.sin(self.surge_lead_rad) * later
        height, _ = self._height(t_s)
        forward, right = -self.surge * slope[:, 1], self.surge * slope[:, 0]
        down = -self.heave * later.sum(axis=1)
        result: Array = STANDARD_GRAVITY_M_S2 * height[:, None] * np.array([forward, right, down]).T
        return result

    @functools.cached_property
    def leaves_rad(self) -> Array:
        """Nothing."""
        return np.zeros(3)


@functools.lru_cache(maxsize=16)
def _components(waves: tuple[Wave, ...], seed: int) -> tuple[Array, Array, Array]:
    """Angular frequencies in rad/s, amplitudes in rad, phases in rad; (2, components), roll and pitch."""
    random = np.random.default_rng([seed, 41])
    shape = (2, COMPONENTS)
    frequencies = [wave.frequency_hz * (1.0 + wave.spread * random.standard_normal(shape)) for wave in waves]
    amplitudes = [np.full(shape, math.radians(wave.sway_deg) / math.sqrt(COMPONENTS)) for wave in waves]
    phases = random.uniform(0.0, 2.0 * math.pi, (2, COMPONENTS * len(waves)))
    return 2.0 * math.pi * np.abs(np.hstack(frequencies)), np.hstack(amplitudes), phases


TURN_DEG_S: Final = 0.3
MOTIONS: Final = ("still", "turn", "sea", "engine")


def motions_of(name: str, *, seed: int = 0, turn_deg_s: float = TURN_DEG_S) -> tuple[Motion, ...]:
    """What happens all day long, by its name: `MOTIONS`."""
    turn = SlowTurn(start_s=0.0, duration_s=DAY_S, rate_deg_s=turn_deg_s)
    engine = Vibration(start_s=0.0, duration_s=DAY_S)
    known: dict[str, tuple[Motion, ...]] = {
        "still": (),
        "turn": (turn,),
        "sea": (Sea(seed=seed), turn),
        "engine": (Sea(seed=seed), turn, engine),
    }
    return known[name]
