"""Motions of a standing aircraft: turned, handled, shaken, and swayed on a boat in waves.

A motion adds to the Euler angles of the aircraft at rest, and to the acceleration. Each one gives its angles and their
exact derivatives, so the true body rate needs no numerical differentiation. Times are seconds of the aircraft's own
clock.

Every wave is a narrow band: components of equal size, spread around its frequency, with random phases, so that it comes
in groups as real waves do. Roll and pitch have components of their own. The boat is pushed along its slopes too: in
long waves a raft is normal to the apparent vertical, and a gradienter on a raft measures little of the raft's tilt.
"""

from __future__ import annotations

import functools
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Final

import numpy as np

from sim.earth import STANDARD_GRAVITY_M_S2, Array


def smooth_step(u: Array) -> tuple[Array, Array]:
    """Return a step from 0 to 1 over u in [0, 1] with continuous second derivative, and its derivative in u."""
    u = np.minimum(np.maximum(u, 0.0), 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u**2), 30.0 * u**2 * (1.0 - u) ** 2


@dataclass(frozen=True, kw_only=True)
class Motion(ABC):
    """A motion from `start_s` for `duration_s`."""

    start_s: float
    duration_s: float

    @property
    def end_s(self) -> float:
        """End of the motion; a change of the angles can remain after it."""
        return self.start_s + self.duration_s

    @abstractmethod
    def euler_rad(self, t_s: Array) -> tuple[Array, Array]:
        """Return the added roll, pitch, heading (n, 3) in rad, and their derivatives in rad/s."""

    def acceleration_m_s2(self, t_s: Array) -> Array | None:
        """Return the added acceleration (n, 3) of the IMU in body axes; None: this motion never has any."""
        del t_s
        return None

    def level_acceleration_m_s2(self, t_s: Array) -> Array | None:
        """Return the added acceleration (n, 3) of the whole aircraft: along the heading, to its right, and down."""
        del t_s
        return None

    @functools.cached_property
    def leaves_rad(self) -> Array:
        """Return the change of the angles that remains after the motion (3)."""
        result: Array = self.euler_rad(np.array([self.end_s]))[0][0]
        return result


@dataclass(frozen=True, kw_only=True)
class Turn(Motion):
    """A smooth change of pose that stays, as when a person sets the aircraft down differently."""

    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    heading_deg: float = 0.0

    def euler_rad(self, t_s: Array) -> tuple[Array, Array]:
        step, slope = smooth_step((t_s - self.start_s) / self.duration_s)
        change = np.radians([self.roll_deg, self.pitch_deg, self.heading_deg])
        return step[:, None] * change, slope[:, None] * change / self.duration_s


@dataclass(frozen=True, kw_only=True)
class SlowTurn(Motion):
    """A steady turn of the heading, which the spread of the readings does not show."""

    rate_deg_s: float = 1.0
    ramp_s: float = 1.0

    def euler_rad(self, t_s: Array) -> tuple[Array, Array]:
        """Return added angles and rates: the rate rises smoothly over `ramp_s`, is constant, and falls like this."""
        ramp = min(self.ramp_s, self.duration_s / 2.0)
        since, until = t_s - self.start_s, self.end_s - t_s
        near = np.minimum(since, until)  # to the beginning or to the end: it ends as it has begun
        u = np.minimum(np.maximum(near / ramp, 0.0), 1.0)
        turned = ramp * (u**3 - u**4 / 2.0) + np.maximum(near - ramp, 0.0)
        angles, rates = np.zeros((2, len(t_s), 3))
        rate_rad_s = math.radians(self.rate_deg_s)
        angles[:, 2] = rate_rad_s * np.where(since <= until, turned, self.duration_s - ramp - turned)
        rates[:, 2] = rate_rad_s * u**2 * (3.0 - 2.0 * u)
        return angles, rates


@dataclass(frozen=True, kw_only=True)
class Handling(Motion):
    """A person holds the aircraft: irregular turning and shaking, which ends in the initial pose."""

    angle_deg: float = 4.0
    acceleration: float = 0.7
    """Approximate largest acceleration, in m/s^2."""
    seed: int = 0

    @functools.cached_property
    def _waves(self) -> tuple[Array, Array]:
        """Return angular frequencies (3 axes, 4 waves) in rad/s, and phases in rad."""
        generator = np.random.default_rng([self.seed, 17])
        return 2.0 * math.pi * generator.uniform(0.3, 1.7, (3, 4)), generator.uniform(0.0, 2.0 * math.pi, (3, 4))

    def _window(self, t_s: Array) -> tuple[Array, Array]:
        """Return a window that is zero, with zero slope, at both ends, and its derivative in 1/s."""
        u = np.clip((t_s - self.start_s) / self.duration_s, 0.0, 1.0)
        return np.sin(math.pi * u) ** 2, math.pi / self.duration_s * np.sin(2.0 * math.pi * u)

    def euler_rad(self, t_s: Array) -> tuple[Array, Array]:
        frequencies, phases = self._waves
        window, window_slope = self._window(t_s)
        arguments = frequencies[None] * (t_s - self.start_s)[:, None, None] + phases[None]
        scale = math.radians(self.angle_deg) / 2.0
        wave = scale * np.sin(arguments).sum(axis=2)
        slope = scale * (frequencies[None] * np.cos(arguments)).sum(axis=2)
        return window[:, None] * wave, window_slope[:, None] * wave + window[:, None] * slope

    def acceleration_m_s2(self, t_s: Array) -> Array:
        frequencies, phases = self._waves
        window, _ = self._window(t_s)
        arguments = 2.3 * frequencies[None] * (t_s - self.start_s)[:, None, None] - phases[None]
        result: Array = self.acceleration / 2.0 * window[:, None] * np.sin(arguments).sum(axis=2)
        return result


@dataclass(frozen=True, kw_only=True)
class Vibration(Motion):
    """A running motor or generator near the aircraft: no turning, a steady vibration."""

    frequency_hz: float = 87.0
    amplitude_m_s2: float = 1.0
    rocking_deg_s: float = 0.5

    def _gate(self, t_s: Array) -> Array:
        return ((t_s >= self.start_s) & (t_s < self.end_s)).astype(np.float64)

    def euler_rad(self, t_s: Array) -> tuple[Array, Array]:
        """Return rocking angles about roll and pitch at the vibration's frequency, and their rates."""
        omega = 2.0 * math.pi * self.frequency_hz
        phase = omega * (t_s - self.start_s)
        peak = math.radians(self.rocking_deg_s)
        share = np.array([1.0, 0.7, 0.0])
        gate = self._gate(t_s)[:, None]
        return gate * (peak / omega) * np.sin(phase)[:, None] * share, gate * peak * np.cos(phase)[:, None] * share

    def acceleration_m_s2(self, t_s: Array) -> Array:
        """Return the vibration in body axes, strongest along z."""
        phase = 2.0 * math.pi * self.frequency_hz * (t_s - self.start_s)
        waves = np.column_stack([np.sin(phase), np.sin(phase + 1.0), np.sin(phase + 2.0)])
        result: Array = self._gate(t_s)[:, None] * self.amplitude_m_s2 * waves * np.array([0.4, 0.4, 1.0])
        return result

    @functools.cached_property
    def leaves_rad(self) -> Array:
        return np.zeros(3)


COMPONENTS: Final = 16
"""Number of components of one wave about one axis."""
DAY_S: Final = 86400.0
SURGE: Final = 0.3


@dataclass(frozen=True, slots=True)
class Wave:
    """One narrow band; `sway_deg` is the amplitude of a pure sine with the same energy."""

    frequency_hz: float
    sway_deg: float
    spread: float = 0.1
    """Standard deviation of the components' frequencies, relative to the wave's frequency."""


SWELL: Final = (Wave(0.2, 5.0), Wave(0.05, 1.0))
"""A small boat at its mooring, with some swell."""


@dataclass(frozen=True, kw_only=True)
class Sea(Motion):
    """Roll and pitch by waves, with the accelerations that belong to them."""

    start_s: float = 0.0
    duration_s: float = DAY_S
    waves: tuple[Wave, ...] = SWELL
    surge: float = SURGE
    """Ratio of sideways acceleration to g times the slope; 1: a raft, on which no tilt is felt."""
    surge_lead_rad: float = 0.5
    """Phase by which the sideways acceleration leads the slope."""
    heave: float = 0.3
    """Ratio of vertical acceleration to g times the slope; it lags by a quarter wave, as water moves in circles."""
    rise_s: float = 5.0
    """Time in which the waves build up at the start and die away at the end."""
    seed: int = 0

    def _height(self, t_s: Array) -> tuple[Array, Array]:
        """Return the amplitude of the waves while they build up or die away, 0 to 1, and its derivative in 1/s."""
        rise_s = min(self.rise_s, self.duration_s / 2.0)
        up, up_slope = smooth_step((t_s - self.start_s) / rise_s)
        down, down_slope = smooth_step((self.end_s - t_s) / rise_s)
        return up * down, (up_slope * down - up * down_slope) / rise_s

    def _sums(self, t_s: Array) -> tuple[Array, Array, Array]:
        """Return roll and pitch (n, 2), both a quarter of a wave later, and the derivatives."""
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
        angles, _, slopes = self._sums(t_s)
        height, rising = self._height(t_s)
        turned, rates = np.zeros((2, len(t_s), 3))
        turned[:, :2] = height[:, None] * angles
        rates[:, :2] = height[:, None] * slopes + rising[:, None] * angles
        return turned, rates

    def level_acceleration_m_s2(self, t_s: Array) -> Array:
        """Return surge, sway and heave: acceleration down the slope, and on the circles of the water."""
        angles, later, _ = self._sums(t_s)
        slope = math.cos(self.surge_lead_rad) * angles + math.sin(self.surge_lead_rad) * later
        height, _ = self._height(t_s)
        forward, right = -self.surge * slope[:, 1], self.surge * slope[:, 0]
        down = -self.heave * later.sum(axis=1)
        result: Array = STANDARD_GRAVITY_M_S2 * height[:, None] * np.array([forward, right, down]).T
        return result

    @functools.cached_property
    def leaves_rad(self) -> Array:
        return np.zeros(3)


@functools.lru_cache(maxsize=16)
def _components(waves: tuple[Wave, ...], seed: int) -> tuple[Array, Array, Array]:
    """Return angular frequencies in rad/s, amplitudes in rad, phases in rad: (2, components) for roll and pitch."""
    random = np.random.default_rng([seed, 41])
    shape = (2, COMPONENTS)
    frequencies = [wave.frequency_hz * (1.0 + wave.spread * random.standard_normal(shape)) for wave in waves]
    amplitudes = [np.full(shape, math.radians(wave.sway_deg) / math.sqrt(COMPONENTS)) for wave in waves]
    phases = random.uniform(0.0, 2.0 * math.pi, (2, COMPONENTS * len(waves)))
    return 2.0 * math.pi * np.abs(np.hstack(frequencies)), np.hstack(amplitudes), phases


TURN_DEG_S: Final = 0.3
MOTIONS: Final = ("still", "turn", "sea", "engine")


def motions_of(name: str, *, seed: int = 0, turn_deg_s: float = TURN_DEG_S) -> tuple[Motion, ...]:
    """Return the motions with a name in `MOTIONS`, for a whole day."""
    turn = SlowTurn(start_s=0.0, duration_s=DAY_S, rate_deg_s=turn_deg_s)
    engine = Vibration(start_s=0.0, duration_s=DAY_S)
    known: dict[str, tuple[Motion, ...]] = {
        "still": (),
        "turn": (turn,),
        "sea": (Sea(seed=seed), turn),
        "engine": (Sea(seed=seed), turn, engine),
    }
    return known[name]
