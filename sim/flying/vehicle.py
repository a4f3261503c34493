"""A firmware that flies by its own physics: what a flight needs of it."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import math
from abc import abstractmethod
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.flying.truth import FlyingAircraft
from sim.flying.verdict import Event
from sim.imu_model import Bias
from sim.scenario import Scenario
from sim.sitl.ground import GroundStation
from sim.sitl.vehicle import FirmwareVehicle

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
    """A firmware with physics of its own, which the scenario's aircraft follows."""

    sticks_us: list[int]
    """Roll, pitch, throttle, yaw."""
    is_plane = False
    circle: tuple[float, float, float] | None = None
    """What a plane that holds is to fly, in m: north and east of the start, and the radius."""
    modes: Mapping[str, int]
    """Custom modes by what they are for."""

    def __init__(self, scenario: Scenario, folder: Path) -> None:
        super().__init__(scenario, folder)
        assert isinstance(scenario.aircraft, FlyingAircraft)
        self.truth: FlyingAircraft = scenario.aircraft

    @property
    def physics_s(self) -> float:
        """The firmware's clock."""
        return self.truth.own_s

    @property
    def height_m(self) -> float:
        """True height above the place of the start."""
        return -self.truth.recorded[-1][6] if self.truth.recorded else 0.0

    def true_bias(self, instance: int, t_s: float) -> Bias:
        """What it was told at its start."""
        return self.scenario.flight_controller_imus[instance - 1].true_bias(0.0)

    async def ask_streams(self, ground: GroundStation) -> None:
        """ATTITUDE and LOCAL_POSITION_NED at 25 Hz, for the record."""
        for number in (mavlink.MAVLINK_MSG_ID_ATTITUDE, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED):
            await ground.stream(number, 25.0)

    async def arm(self, ground: GroundStation) -> None:
        """Ask until it arms, with all its checks."""
        await _until_accepted(ground, lambda: ground.arm(wait_s=2.0), ARM_WITHIN_S, "it does not arm")

    @abstractmethod
    async def take_off(self, ground: GroundStation, height_m: float) -> None:
        """Arm, with all its checks, and climb."""

    async def mode(self, ground: GroundStation, name: str) -> None:
        """Ask until it changes its mode."""
        words = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, *self.mode_parameters(self.modes[name])
        ask = functools.partial(ground.command, mavlink.MAV_CMD_DO_SET_MODE, *words)
        await _until_accepted(ground, ask, MODE_WITHIN_S, f"no mode {name}")
        await self.until_mode(ground, name)

    async def until_mode(self, ground: GroundStation, name: str) -> None:
        """Wait until it says that it is in a mode."""
        since_s = asyncio.get_running_loop().time()
        await ground.wait_for(
            lambda: any(beat.custom_mode == self.modes[name] for beat in ground.vehicle_heartbeats(since_s)),
            MODE_WITHIN_S, f"mode {name}",
        )  # fmt: skip

    def mode_parameters(self, number: int) -> tuple[float, ...]:
        """A custom mode in the parameters of MAV_CMD_DO_SET_MODE."""
        return (number,)

    def source_changes(self) -> list[Event]:
        """What heading its estimator used, and since when, where it does not say so in words."""
        return []

    @abstractmethod
    async def lie_with_own_compass(self, ground: GroundStation) -> None:
        """Its own compasses are turned by 45 deg as of now."""

    @abstractmethod
    async def hold(self, ground: GroundStation) -> None:
        """Stay over the spot, or about it, until told otherwise."""

    async def turn(self, ground: GroundStation, degrees: float) -> None:
        """Turned clockwise by the yaw stick, by the truth; a plane turns anyway."""
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
