"""An aircraft whose truth comes from a firmware's own physics, as its virtual sensors and a recorder see it.

The firmware's clock runs beside the wall's, a little behind it on a busy machine. Aircraft time is the wall's: states
are put where they arrive, smoothed, and rates are what turns the attitude in that time, so that an IMU on the wall
clock integrates to the attitude there is, however slow the firmware.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sim.aircraft import Pose, Site, Truth, VirtualAircraft
from sim.earth import Array, body_from_ned

BEHIND_S = 0.015
"""So long after an instant it is measured: what is asked for has arrived by then."""
MEAN_S = 0.005
"""Rates and forces are means over so long: the interval of an IMU of 200 Hz."""
_FOLLOWS = 0.02
"""Share of the lateness of a state by which the smoothed clock follows."""
_JUMP_S = 0.5
LATE_S = 0.1
_SLOPE_ROWS = 4
_ROWS = 4096
_KEPT = 1024
_T, _OWN, _ROLL, _PITCH, _YAW, _TURNED, _PUSHED = 0, 1, 2, 3, 4, slice(5, 8), slice(8, 11)
RECORDED_S = 0.02


class State(NamedTuple):
    """What a firmware says of its simulated aircraft; body FRD, navigation NED from the place of the start."""

    own_s: float
    """On the firmware's clock."""
    quaternion: tuple[float, float, float, float]
    """w, x, y, z; from body to NED."""
    rate_rad_s: tuple[float, float, float]
    force_m_s2: tuple[float, float, float]
    position_m: tuple[float, float, float]
    velocity_m_s: tuple[float, float, float]


def angles_of_quaternion(quaternion: tuple[float, float, float, float]) -> tuple[float, float, float]:
    """Roll, pitch, yaw in rad."""
    w, x, y, z = quaternion
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x)))),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


class FlyingAircraft(VirtualAircraft):
    """Follows the states that `take` is given; until the first it stands level on its spot."""

    def __init__(self, site: Site, *, heading_deg: float = 0.0, unix_s: float) -> None:
        super().__init__(Pose(heading_deg=heading_deg), site, unix_s=unix_s)
        self._rows = np.zeros((11, _ROWS))  # a column for each state
        self._count = 0
        self.recorded: list[tuple[float, ...]] = []
        """Every 20 ms of the firmware's clock: own_s, roll, pitch, yaw (rad, not wrapped), position (m), velocity."""
        self.late = 0
        """How often something was asked for that had not arrived."""

    @property
    def own_s(self) -> float:
        """The firmware's clock at the latest state."""
        return float(self._rows[_OWN, self._count - 1]) if self._count else 0.0

    @property
    def has_state(self) -> bool:
        """Whether the firmware has told anything."""
        return self._count > 0

    def restart(self) -> None:
        """The firmware has started anew: its clock begins again."""
        self._count = 0
        self.recorded.clear()

    def take(self, state: State, loop_s: float) -> None:
        """A state that has arrived at this instant of the loop's clock."""
        at_s = self.time_at(loop_s)
        roll, pitch, yaw = angles_of_quaternion(state.quaternion)
        if self._count == _ROWS:
            self._rows[:, :_KEPT] = self._rows[:, _ROWS - _KEPT :]
            self._count = _KEPT
        row = self._rows[:, self._count]
        if not self._count:
            row[:] = (at_s, state.own_s, roll, pitch, yaw, *[0.0] * 6)
        else:
            last = self._rows[:, self._count - 1]
            passed_s = state.own_s - float(last[_OWN])
            if passed_s <= 0.0:
                return
            expected_s = float(last[_T]) + passed_s
            late_s = at_s - expected_s
            step_s = passed_s + (late_s if abs(late_s) > _JUMP_S else max(_FOLLOWS * late_s, -0.5 * passed_s))
            yaw = float(last[_YAW]) + math.remainder(yaw - float(last[_YAW]), math.tau)
            row[:5] = (float(last[_T]) + max(step_s, 1e-6), state.own_s, roll, pitch, yaw)
            row[_TURNED] = last[_TURNED] + np.multiply(state.rate_rad_s, passed_s)
            row[_PUSHED] = last[_PUSHED] + np.multiply(state.force_m_s2, passed_s)
        self._count += 1
        if not self.recorded or state.own_s - self.recorded[-1][0] >= RECORDED_S - 1e-4:
            self.recorded.append((state.own_s, roll, pitch, yaw, *state.position_m, *state.velocity_m_s))

    def still_at(self, t_s: float) -> bool:
        """Never for sure."""
        return False

    def _still_at(self, t_s: float) -> None:
        return None

    def _columns(self, t_s: Array, columns: slice) -> Array:
        """Interpolated at aircraft times, `BEHIND_S` before them; (n, columns).

        What has not arrived yet goes on as it was: else a turn would lose whatever comes late.
        """
        rows = self._rows[:, max(0, self._count - _KEPT) : self._count]
        asked, last = t_s - BEHIND_S, rows[:, -1]
        after = np.clip(np.searchsorted(rows[_T], asked), 1, rows.shape[1] - 1)
        begun, ended = rows[_T, after - 1], rows[_T, after]
        share = np.clip((asked - begun) / np.maximum(ended - begun, 1e-9), 0.0, 1.0)  # of one state alone, itself
        found: Array = (rows[columns, after - 1] * (1.0 - share) + rows[columns, after] * share).T
        late_s = np.clip(asked - last[_T], 0.0, LATE_S)
        if late_s[-1] > 0.0:
            self.late += 1
            before = rows[:, -min(_SLOPE_ROWS, rows.shape[1])]
            found += np.outer(late_s, (last - before)[columns] / max(last[_T] - before[_T], 1e-3))
        return found

    def _euler(self, t_s: Array) -> tuple[Array, Array]:
        if not self._count:
            angles, _ = super()._euler(t_s)
        else:
            angles = self._columns(t_s, slice(_ROLL, _YAW + 1))
        return angles, np.zeros_like(angles)

    def _moving(self, t_s: Array) -> Truth:
        angles, _ = self._euler(t_s)
        turned = np.array([body_from_ned(*row) for row in angles])
        earth, at_rest = turned @ self._earth_rate_ned, -(turned @ self._gravity_ned)
        if self._count < 2:
            return Truth(earth, at_rest)
        both = self._columns(np.concatenate([t_s - MEAN_S, t_s]), slice(_OWN, _PUSHED.stop))
        passed = both[len(t_s) :] - both[: len(t_s)]
        # In the wall's time for rates, in the firmware's own for forces: gravity does not change with its speed.
        # Before the first state after a start nothing has passed.
        forces = np.where(passed[:, :1] > 1e-6, passed[:, 7:10] / np.maximum(passed[:, :1], 1e-6), at_rest)
        return Truth(earth + passed[:, 4:7] / MEAN_S, forces)
