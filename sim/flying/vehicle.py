"""A firmware that flies by its own physics, and the aircraft whose truth comes from it.

The firmware's clock runs beside the wall's, a little behind it on a busy machine. Aircraft time is the wall's: states
are dated at their arrival and smoothed, and rates are the turn of the attitude in that time. An IMU on the wall clock
therefore integrates to the true attitude, however slow the firmware.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import math
from abc import abstractmethod
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import Pose, Site, Truth, VirtualAircraft
from sim.earth import Array, body_from_ned
from sim.flying.verdict import Event
from sim.imu_model import Bias
from sim.scenario import Scenario
from sim.sitl.ground import GroundStation
from sim.sitl.vehicle import FirmwareVehicle

BEHIND_S = 0.015
"""Delay with which measurements are read: by then, the states for an instant have arrived."""
MEAN_S = 0.005
"""Averaging time of rates and forces, equal to the interval of an IMU at 200 Hz."""
_FOLLOWS = 0.02
"""Share of a state's lateness by which the smoothed clock is corrected."""
_JUMP_S = 0.5
LATE_S = 0.1
_SLOPE_ROWS = 4
_ROWS = 4096
_KEPT = 1024
_T, _OWN, _ROLL, _PITCH, _YAW, _TURNED, _PUSHED = 0, 1, 2, 3, 4, slice(5, 8), slice(8, 11)
RECORDED_S = 0.02


class State(NamedTuple):
    """State of a firmware's simulated aircraft; body FRD, navigation NED from the place of the start."""

    own_s: float
    """Time by the firmware's clock."""
    quaternion: tuple[float, float, float, float]
    """Quaternion from body to NED: w, x, y, z."""
    rate_rad_s: tuple[float, float, float]
    force_m_s2: tuple[float, float, float]
    position_m: tuple[float, float, float]
    velocity_m_s: tuple[float, float, float]


def angles_of_quaternion(quaternion: tuple[float, float, float, float]) -> tuple[float, float, float]:
    """Return roll, pitch, yaw in rad of a quaternion."""
    w, x, y, z = quaternion
    return (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x)))),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )


class FlyingAircraft(VirtualAircraft):
    """Follows the states given to `take`; before the first state, it stands level on its spot."""

    def __init__(self, site: Site, *, heading_deg: float = 0.0, unix_s: float) -> None:
        super().__init__(Pose(heading_deg=heading_deg), site, unix_s=unix_s)
        self._rows = np.zeros((11, _ROWS))  # a column for each state
        self._count = 0
        self.recorded: list[tuple[float, ...]] = []
        """States every 20 ms (firmware's clock): own_s, roll, pitch, yaw (rad, unwrapped), position (m), velocity."""

    @property
    def own_s(self) -> float:
        """Return the firmware's clock at the latest state."""
        return float(self._rows[_OWN, self._count - 1]) if self._count else 0.0

    @property
    def has_state(self) -> bool:
        return self._count > 0

    def restart(self) -> None:
        """Handle a restart of the firmware, whose clock begins again."""
        self._count = 0
        self.recorded.clear()

    def take(self, state: State, loop_s: float) -> None:
        """Add a state that arrived at this instant of the loop's clock."""
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
        """Return False: the aircraft can move at any time."""
        return False

    def _still_at(self, t_s: float) -> None:
        return None

    def _columns(self, t_s: Array, columns: slice) -> Array:
        """Interpolate states at aircraft times, `BEHIND_S` earlier; return (n, columns).

        If a state is late, the last ones are extrapolated: otherwise a turn would miss it.
        """
        rows = self._rows[:, max(0, self._count - _KEPT) : self._count]
        asked, last = t_s - BEHIND_S, rows[:, -1]
        after = np.clip(np.searchsorted(rows[_T], asked), 1, rows.shape[1] - 1)
        begun, ended = rows[_T, after - 1], rows[_T, after]
        share = np.clip((asked - begun) / np.maximum(ended - begun, 1e-9), 0.0, 1.0)  # of one state alone, itself
        found: Array = (rows[columns, after - 1] * (1.0 - share) + rows[columns, after] * share).T
        late_s = np.clip(asked - last[_T], 0.0, LATE_S)
        if late_s[-1] > 0.0:
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


ARM_WITHIN_S = 60.0
MODE_WITHIN_S = 30.0
YAW_STICK_US = 250
TURNED_WITHIN_S = 8.0


async def _until_accepted(
    ground: GroundStation, ask: Callable[[], Awaitable[int]], within_s: float, otherwise: str
) -> None:
    since_s = asyncio.get_running_loop().time()
    try:
        async with asyncio.timeout(within_s):
            while await ask() != mavlink.MAV_RESULT_ACCEPTED:
                await asyncio.sleep(1.0)
    except TimeoutError:
        raise TimeoutError(f"{otherwise}: {ground.texts_since(since_s)[-400:]}") from None


class FlyingVehicle(FirmwareVehicle):
    """A firmware with its own physics, which the scenario's aircraft follows."""

    sticks_us: list[int]
    """Stick positions in us: roll, pitch, throttle, yaw."""
    is_plane = False
    circle: tuple[float, float, float] | None = None
    """Circle of a plane that holds, in m: position north and east of the start, and radius."""
    modes: Mapping[str, int]
    """Custom mode numbers by purpose."""

    def __init__(self, scenario: Scenario, folder: Path) -> None:
        super().__init__(scenario, folder)
        assert isinstance(scenario.aircraft, FlyingAircraft)
        self.truth: FlyingAircraft = scenario.aircraft

    @property
    def physics_s(self) -> float:
        return self.truth.own_s

    @property
    def height_m(self) -> float:
        return -self.truth.recorded[-1][6] if self.truth.recorded else 0.0

    def true_bias(self, instance: int, t_s: float) -> Bias:
        """Return the bias that the IMU had at the start."""
        return self.scenario.flight_controller_imus[instance - 1].true_bias(0.0)

    async def ask_streams(self, ground: GroundStation) -> None:
        """Request ATTITUDE and LOCAL_POSITION_NED at 25 Hz, for the record."""
        for number in (mavlink.MAVLINK_MSG_ID_ATTITUDE, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED):
            await ground.stream(number, 25.0)

    async def arm(self, ground: GroundStation) -> None:
        """Request arming, with all checks, until the vehicle arms."""
        await _until_accepted(ground, lambda: ground.arm(wait_s=2.0), ARM_WITHIN_S, "it does not arm")

    @abstractmethod
    async def take_off(self, ground: GroundStation, height_m: float) -> None:
        """Arm with all checks, and climb."""

    async def mode(self, ground: GroundStation, name: str) -> None:
        """Request a flight mode until it changes."""
        words = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, *self.mode_parameters(self.modes[name])
        ask = functools.partial(ground.command, mavlink.MAV_CMD_DO_SET_MODE, *words)
        await _until_accepted(ground, ask, MODE_WITHIN_S, f"no mode {name}")
        await self.until_mode(ground, name)

    async def until_mode(self, ground: GroundStation, name: str) -> None:
        since_s = asyncio.get_running_loop().time()
        await ground.wait_for(
            lambda: any(beat.custom_mode == self.modes[name] for beat in ground.vehicle_heartbeats(since_s)),
            MODE_WITHIN_S, f"mode {name}",
        )  # fmt: skip

    def mode_parameters(self, number: int) -> tuple[float, ...]:
        """Return the parameters of MAV_CMD_DO_SET_MODE for a custom mode."""
        return (number,)

    def source_changes(self) -> list[Event]:
        """Return changes of the estimator's heading source with times, if the firmware does not send them as text."""
        return []

    @abstractmethod
    async def lie_with_own_compass(self, ground: GroundStation) -> None:
        """Turn the vehicle's own compasses by 45 deg from now on."""

    @abstractmethod
    async def hold(self, ground: GroundStation) -> None:
        """Hold the spot, or circle about it, until another command."""

    async def turn(self, ground: GroundStation, degrees: float) -> None:
        """Turn clockwise by the yaw stick, measured by the truth; do nothing for a plane, which turns anyway."""
        if self.is_plane:
            return
        middle, begun_rad = self.sticks_us[3], self.truth.recorded[-1][3]
        self.sticks_us[3] = middle + YAW_STICK_US
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(TURNED_WITHIN_S):
                while self.truth.recorded[-1][3] - begun_rad < math.radians(degrees):
                    await asyncio.sleep(0.02)
        self.sticks_us[3] = middle

    @abstractmethod
    async def steer(self, ground: GroundStation) -> None:
        """Send `sticks_us` until cancelled."""
