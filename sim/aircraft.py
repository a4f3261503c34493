"""The virtual aircraft: place, pose, motion, temperature. Everything else in the simulator measures this truth.

Frames: navigation NED, body FRD. Angles: heading clockwise from true north, pitch nose up +, roll right side down +
(method 1.1). Time is the aircraft's own, in seconds from 0; `begin` ties it to an event loop's clock.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from sim.earth import Array, angles_of, bodies_from_ned, earth_rate_ned_rad_s, normal_gravity_m_s2
from sim.motions import Motion

_EARTH_M_PER_DEG = 111_320.0


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of the aircraft, degrees; heading from true north."""

    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    heading_deg: float = 0.0


@dataclass(frozen=True)
class Site:
    """Place of the aircraft; the height above the ellipsoid serves as the height above sea level too."""

    latitude_deg: float = 40.0
    longitude_deg: float = 116.0
    height_m: float = 50.0
    declination_deg: float = 0.0
    """Declination, east of true north +: magnetic heading = true heading - declination."""
    inclination_deg: float = 58.1
    """Inclination of the magnetic field, down +; `scenario.site_at` computes it by a model."""
    field_gauss: float = 0.53

    @functools.cached_property
    def field_ned_gauss(self) -> Array:
        """Return the Earth's magnetic field (3,): north, east, down."""
        declination, inclination = math.radians(self.declination_deg), math.radians(self.inclination_deg)
        across = math.cos(inclination)
        return self.field_gauss * np.array(
            [across * math.cos(declination), across * math.sin(declination), math.sin(inclination)]
        )

    @property
    def gravity_m_s2(self) -> float:
        return normal_gravity_m_s2(self.latitude_deg, self.height_m)

    def north_east_m(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """Return how far north and east, in metres, a place at some hundred metres lies."""
        east_deg = (longitude_deg - self.longitude_deg) * math.cos(math.radians(self.latitude_deg))
        return (latitude_deg - self.latitude_deg) * _EARTH_M_PER_DEG, east_deg * _EARTH_M_PER_DEG

    def place_deg(self, north_m: float, east_m: float) -> tuple[float, float]:
        """Return latitude and longitude of a place some hundred metres to the north and east."""
        east_deg = east_m / _EARTH_M_PER_DEG / math.cos(math.radians(self.latitude_deg))
        return self.latitude_deg + north_m / _EARTH_M_PER_DEG, self.longitude_deg + east_deg


@dataclass(frozen=True)
class Iron:
    """Disturbances of the magnetic field at the compass."""

    body_gauss: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Hard iron: field of magnets in the aircraft, in its axes (forward, right, down)."""
    dipole_a_m2: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Moment of a magnet on the ground, north, east, down: a car is some 100 to 300 A m^2."""
    dipole_at_m: tuple[float, float, float] = (0.0, 1.0, 0.0)
    """Position of this magnet relative to the compass, north, east, down."""

    @functools.cached_property
    def ground_ned_gauss(self) -> Array:
        """Return the ground magnet's field at the compass (3,): mu0 / 4 pi (3 (m r) r - m) / |r|^3, 1 T = 1e4 gauss."""
        moment, place = np.array(self.dipole_a_m2), np.array(self.dipole_at_m)
        distance = float(np.linalg.norm(place))
        towards = place / distance
        field: Array = 1e-3 * (3.0 * (moment @ towards) * towards - moment) / distance**3
        return field


LEVEL = Pose()
DEFAULT_SITE = Site()


class Truth(NamedTuple):
    """Ideal readings in body axes at n times."""

    rate_rad_s: Array
    """Angular rate relative to inertial space (n, 3), which includes the Earth's rotation."""
    force_m_s2: Array
    """Specific force (n, 3): (0, 0, -g) for a horizontal aircraft at rest."""


class VirtualAircraft:
    """The true pose, place, motion and temperature.

    Args:
        pose: pose while no motion acts.
        site: place.
        motions: motions in aircraft time; `add` appends more.
        temperature_degc: a number, or a function of aircraft time.
        unix_s: date at aircraft time 0, for messages that carry the date.
    """

    def __init__(
        self,
        pose: Pose = LEVEL,
        site: Site = DEFAULT_SITE,
        *,
        motions: Sequence[Motion] = (),
        temperature_degc: float | Callable[[float], float] = 25.0,
        unix_s: float = 1_795_219_200.0,
    ) -> None:
        self.pose, self.site, self.unix_s = pose, site, unix_s
        self._motions = list(motions)
        self._temperature = temperature_degc
        self._gravity_ned = np.array([0.0, 0.0, site.gravity_m_s2])
        self._earth_rate_ned = earth_rate_ned_rad_s(site.latitude_deg)
        self.iron = Iron()
        """Magnetic disturbances; can be changed at any time."""
        self._epoch_s: float | None = None
        self._still: tuple[float, float, Array, Truth] | None = None
        self._stands_until_s = math.inf
        self._pose_rad = np.radians([pose.roll_deg, pose.pitch_deg, pose.heading_deg])
        # What was asked last, while it moves: IMUs and compass ask for the same times, one after another.
        self._posed: tuple[float, Array] | None = None
        self._moved: tuple[bytes, Truth] | None = None

    def begin(self, loop_s: float) -> None:
        """Set aircraft time 0 to this instant of the loop's clock, unless aircraft time has begun already."""
        if self._epoch_s is None:
            self._epoch_s = loop_s

    def time_at(self, loop_s: float) -> float:
        """Return the aircraft time of an instant of the loop's clock; start the aircraft's time if it has not begun."""
        self.begin(loop_s)
        assert self._epoch_s is not None
        return loop_s - self._epoch_s

    def loop_time_of(self, t_s: float) -> float:
        if self._epoch_s is None:
            raise ValueError("the aircraft's time has not begun: nothing serves it on a loop yet")
        return self._epoch_s + t_s

    def add(self, motion: Motion) -> None:
        """Add a motion; its `start_s` is aircraft time and should not lie in the past."""
        self._motions.append(motion)
        self._still = self._posed = self._moved = None

    def still_at(self, t_s: float) -> bool:
        return t_s < self._stands_until_s and all(not motion.start_s <= t_s < motion.end_s for motion in self._motions)

    def temperature_degc(self, t_s: float) -> float:
        return self._temperature(t_s) if callable(self._temperature) else self._temperature

    def temperatures_degc(self, t_s: Array) -> Array:
        if not callable(self._temperature):
            return np.full(len(t_s), self._temperature)
        return np.array([self._temperature(t) for t in t_s.tolist()])

    def angles_rad(self, t_s: float) -> tuple[float, float, float]:
        """Return true roll, pitch and heading at a time; the heading is not wrapped."""
        roll, pitch, heading = self.angles_over(np.array([t_s]))[0].tolist()
        return roll, pitch, heading

    def angles_over(self, t_s: Array) -> Array:
        """Return true roll, pitch, heading (n, 3) at ascending times (n)."""
        return self._euler(t_s)[0]

    def pose_at(self, t_s: float) -> Pose:
        """Return the true pose at a time, with the heading in [0, 360)."""
        roll, pitch, heading = self.angles_rad(t_s)
        return Pose(math.degrees(pitch), math.degrees(roll), math.degrees(heading) % 360.0)

    def matrices(self, t_s: Array) -> Array:
        """Return the rotations from NED to body (n, 3, 3) at ascending times (n)."""
        return bodies_from_ned(self.angles_over(t_s))

    def body_from_ned(self, t_s: float) -> Array:
        still = self._still_at(t_s)
        if still is not None:
            return still[2]
        if self._posed is None or self._posed[0] != t_s:
            self._posed = (t_s, self.matrices(np.array([t_s]))[0])
        return self._posed[1]

    def field_gauss(self, t_s: float) -> Array:
        """Return the magnetic field at the compass (3,) in body axes, disturbances included."""
        ned = self.site.field_ned_gauss + self.iron.ground_ned_gauss
        field: Array = self.body_from_ned(t_s) @ ned + np.array(self.iron.body_gauss)
        return field

    def declination_rad(self, t_s: float) -> float:
        """Return the declination that a perfect compass would need: that of the place plus the effect of iron."""
        north, east, _ = self.body_from_ned(t_s).T @ self.field_gauss(t_s)
        return math.atan2(east, north)

    def mounted_angles_rad(self, t_s: float, mounting: Array) -> tuple[float, float, float]:
        """Return roll, pitch and heading of a device mounted with this sensor-to-vehicle matrix."""
        return angles_of(mounting.T @ self.body_from_ned(t_s))

    def truth(self, t_s: Array) -> Truth:
        """Return rates and specific forces in body axes at times (n). Do not change the arrays: they are cached."""
        count = len(t_s)
        if count:
            still = self._still_at(float(t_s[0]))
            if still is not None and t_s[-1] < still[1]:
                return Truth(still[3].rate_rad_s[None].repeat(count, 0), still[3].force_m_s2[None].repeat(count, 0))
        key = t_s.tobytes()
        if self._moved is None or self._moved[0] != key:
            self._moved = (key, self._moving(t_s))
        return self._moved[1]

    def truth_at(self, t_s: float) -> Truth:
        """Return rates and specific forces (3,) at one time. Do not change the arrays: they are cached."""
        still = self._still_at(t_s)
        if still is not None:
            return still[3]
        rate, force = self.truth(np.array([t_s]))
        return Truth(rate[0], force[0])

    def _still_at(self, t_s: float) -> tuple[float, float, Array, Truth] | None:
        """Return start, end, attitude and truth of the motionless time around `t_s`; None: something moves."""
        if self._still is not None and self._still[0] <= t_s < self._still[1]:
            return self._still
        if not self.still_at(t_s):
            return None
        since = max((motion.end_s for motion in self._motions if motion.end_s <= t_s), default=-math.inf)
        until = min((motion.start_s for motion in self._motions if motion.start_s > t_s), default=math.inf)
        until = min(until, self._stands_until_s)
        rate, force = self._moving(np.array([t_s]))
        self._still = (since, until, self.matrices(np.array([t_s]))[0], Truth(rate[0], force[0]))
        return self._still

    def _euler(self, t_s: Array) -> tuple[Array, Array]:
        """Return roll, pitch, heading (n, 3) in rad, and their derivatives."""
        angles = self._pose_rad[None].repeat(len(t_s), 0)
        rates = np.zeros_like(angles)
        for motion in self._motions:
            if len(t_s) == 0 or t_s[-1] < motion.start_s:
                continue
            if t_s[0] >= motion.end_s:
                angles += motion.leaves_rad
                continue
            if motion.start_s <= t_s[0] and t_s[-1] < motion.end_s:
                added, slopes = motion.euler_rad(t_s)
                angles += added
                rates += slopes
                continue
            added, slopes = motion.euler_rad(np.clip(t_s, motion.start_s, motion.end_s))
            acting = (t_s >= motion.start_s) & (t_s < motion.end_s)
            over = t_s >= motion.end_s
            angles += np.where(over[:, None], motion.leaves_rad, np.where(acting[:, None], added, 0.0))
            rates += np.where(acting[:, None], slopes, 0.0)
        return angles, rates

    def _moving(self, t_s: Array) -> Truth:
        angles, slopes = self._euler(t_s)
        to_body = bodies_from_ned(angles)
        rolling, pitching, yawing = slopes.T
        # The turn about the vertical, seen from the body, and that about its own axes.
        turning = to_body[:, :, 2] * yawing[:, None]
        turning[:, 0] += rolling
        turning[:, 1] += np.cos(angles[:, 0]) * pitching
        turning[:, 2] -= np.sin(angles[:, 0]) * pitching
        force = -(to_body @ self._gravity_ned)
        for motion in self._motions:
            acting = (t_s >= motion.start_s) & (t_s < motion.end_s)
            if not acting.any():
                continue
            if (shaking := motion.acceleration_m_s2(t_s[acting])) is not None:
                force[acting] += shaking
            if (level := motion.level_acceleration_m_s2(t_s[acting])) is not None:
                c, s = np.cos(angles[acting, 2]), np.sin(angles[acting, 2])
                forward, right, down = level.T
                ned = np.array([c * forward - s * right, s * forward + c * right, down]).T
                force[acting] += np.einsum("nij,nj->ni", to_body[acting], ned)
        return Truth(turning + to_body @ self._earth_rate_ned, force)
