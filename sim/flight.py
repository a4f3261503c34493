"""A moving aircraft: attitude and velocity as smooth functions of time, and the readings of perfect sensors.

A route gives Euler angles and velocity in NED; rates and accelerations are their derivatives by central differences of
the fourth order, exact to 1e-9 for anything an aircraft does. Before its start the aircraft stands as a
`VirtualAircraft` does, so that it can be calibrated first.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from sim.aircraft import DEFAULT_SITE, Pose, Site, Truth, VirtualAircraft
from sim.earth import STANDARD_GRAVITY_M_S2, Array, bodies_from_ned
from sim.motions import Motion

_STEP_S: Final = 2e-3


def smooth(u: Array) -> Array:
    """Return a step from 0 to 1 over u in [0, 1], with three continuous derivatives."""
    u = np.minimum(np.maximum(u, 0.0), 1.0)
    squared = u * u
    result: Array = squared * squared * (35.0 - u * (84.0 - u * (70.0 - 20.0 * u)))
    return result


def smooth_integral(u: Array) -> Array:
    """Return the integral of `smooth` from 0; its slope is 1 after u = 1."""
    v = np.minimum(np.maximum(u, 0.0), 1.0)
    squared = v * v
    inside = squared * squared * v * (7.0 - v * (14.0 - v * (10.0 - 2.5 * v)))
    result: Array = inside + np.maximum(u - 1.0, 0.0)
    return result


@dataclass(frozen=True, slots=True, kw_only=True)
class Route(ABC):
    """A flight from `start_s` on (aircraft time); before, the angles are those of the start and the speed is 0."""

    start_s: float = 0.0

    @abstractmethod
    def angles_rad(self, t_s: Array) -> Array:
        """Return roll, pitch, heading (n, 3) of the vehicle; headings are not wrapped."""

    @abstractmethod
    def velocity_m_s(self, t_s: Array) -> Array:
        """Return the velocity (n, 3) in NED."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BankedCircles(Route):
    """A fixed-wing aircraft in an endless, coordinated turn at constant height, in which levelling by gravity fails.

    It gathers speed over `launch_s`, flies straight for `straight_s`, and rolls into the turn.
    """

    airspeed_m_s: float = 15.0
    bank_deg: float = 35.0
    straight_s: float = 5.0
    entry_s: float = 3.0
    launch_s: float = 5.0

    def _turn(self, t_s: Array) -> tuple[Array, Array]:
        rate = STANDARD_GRAVITY_M_S2 * math.tan(math.radians(self.bank_deg)) / self.airspeed_m_s
        u = (t_s - self.start_s - self.launch_s - self.straight_s) / self.entry_s
        return rate * smooth(u), rate * self.entry_s * smooth_integral(u)

    def angles_rad(self, t_s: Array) -> Array:
        """Return angles with the bank that the turn needs, without pitch."""
        rate, turned = self._turn(t_s)
        bank = np.arctan(rate * self.airspeed_m_s / STANDARD_GRAVITY_M_S2)
        return np.column_stack([bank, np.zeros_like(bank), turned])

    def velocity_m_s(self, t_s: Array) -> Array:
        speed = self.airspeed_m_s * smooth((t_s - self.start_s) / self.launch_s)
        _, turned = self._turn(t_s)
        return np.column_stack([speed * np.cos(turned), speed * np.sin(turned), np.zeros_like(speed)])


@dataclass(frozen=True, slots=True, kw_only=True)
class Shuttle(Route):
    """A multirotor that flies to and fro, leaning into each acceleration; its heading swings slowly."""

    lean_deg: float = 12.0
    period_s: float = 8.0
    swing_deg: float = 60.0
    swing_period_s: float = 47.0
    begin_s: float = 3.0

    def velocity_m_s(self, t_s: Array) -> Array:
        """Return the velocity along a line over the ground; the acceleration is a sine."""
        peak = STANDARD_GRAVITY_M_S2 * math.tan(math.radians(self.lean_deg))
        omega = 2.0 * math.pi / self.period_s
        since = t_s - self.start_s
        speed = smooth(since / self.begin_s) * peak / omega * (1.0 - np.cos(omega * since)) * (since > 0.0)
        return np.column_stack([speed * math.cos(0.4), speed * math.sin(0.4), np.zeros_like(speed)])

    def angles_rad(self, t_s: Array) -> Array:
        """Return angles at which the thrust, along -z of the body, gives the acceleration."""
        acceleration = _derivative(self.velocity_m_s, t_s)
        swing = 2.0 * math.pi / self.swing_period_s
        heading = math.radians(self.swing_deg) * smooth((t_s - self.start_s) / 5.0)
        heading = heading * np.sin(swing * (t_s - self.start_s))
        forward = acceleration[:, 0] * np.cos(heading) + acceleration[:, 1] * np.sin(heading)
        right = -acceleration[:, 0] * np.sin(heading) + acceleration[:, 1] * np.cos(heading)
        pitch = np.arctan2(-forward, STANDARD_GRAVITY_M_S2)
        roll = np.arctan2(right * np.cos(pitch), STANDARD_GRAVITY_M_S2)
        return np.column_stack([roll, pitch, heading])


def _derivative(function: object, t_s: Array) -> Array:
    assert callable(function)
    h = _STEP_S
    after, before, long_after, long_before = np.split(
        function(np.concatenate([t_s + h, t_s - h, t_s + 2.0 * h, t_s - 2.0 * h])), 4
    )
    result: Array = (8.0 * (after - before) - (long_after - long_before)) / (12.0 * h)
    return result


class MovingAircraft(VirtualAircraft):
    """A `VirtualAircraft` that stands until its route begins.

    The route's angles are added to the pose's heading; the pose's roll and pitch are the mounting of the box of sensors
    in the vehicle. "Body" is that box, for the truth and for every sensor on it.
    """

    def __init__(
        self,
        route: Route,
        pose: Pose = Pose(),  # noqa: B008 - immutable
        site: Site = DEFAULT_SITE,
        *,
        motions: Sequence[Motion] = (),
    ) -> None:
        super().__init__(pose, site, motions=motions)
        self.route = route
        self._stands_until_s = route.start_s - 2.0 * _STEP_S
        self._box = bodies_from_ned(np.radians([[pose.roll_deg, pose.pitch_deg, 0.0]]))[0]
        self._coriolis = 2.0 * np.cross(self._earth_rate_ned, np.eye(3))
        """Coriolis acceleration (3, 3) for each component of the velocity, north, east, down."""

    def matrices(self, t_s: Array) -> Array:
        angles = self.route.angles_rad(t_s) + np.array([0.0, 0.0, math.radians(self.pose.heading_deg)])
        vehicle: Array = self._box @ bodies_from_ned(angles)
        return vehicle

    def angles_over(self, t_s: Array) -> Array:
        c = self.matrices(t_s).transpose(1, 2, 0)
        pitch = -np.arcsin(np.clip(c[0, 2], -1.0, 1.0))
        return np.column_stack([np.arctan2(c[1, 2], c[2, 2]), pitch, np.arctan2(c[0, 1], c[0, 0])])

    def _moving(self, t_s: Array) -> Truth:
        turn = self.matrices(t_s)
        # [w x] = -C' C^T for C from NED to body.
        turning = -_derivative(lambda t: self.matrices(t).reshape(len(t), 9), t_s).reshape(-1, 3, 3)
        cross = np.einsum("nij,nkj->nik", turning, turn)
        rate = np.column_stack([cross[:, 2, 1], cross[:, 0, 2], cross[:, 1, 0]])
        velocity = self._velocity(t_s)
        acceleration = _derivative(self._velocity, t_s) + velocity @ self._coriolis
        force = np.einsum("nij,nj->ni", turn, acceleration - self._gravity_ned)
        rate = rate + np.einsum("nij,j->ni", turn, self._earth_rate_ned)
        for motion in self._motions:
            acting = (t_s >= motion.start_s) & (t_s < motion.end_s)
            if acting.any():
                if (shaking := motion.acceleration_m_s2(t_s[acting])) is not None:
                    force[acting] += shaking
                rate[acting] += motion.euler_rad(t_s[acting])[1]
        return Truth(rate, force)

    def _velocity(self, t_s: Array) -> Array:
        heading = math.radians(self.pose.heading_deg)
        c, s = math.cos(heading), math.sin(heading)
        result: Array = self.route.velocity_m_s(t_s) @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return result
