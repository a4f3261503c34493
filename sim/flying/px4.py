"""PX4's own quadrotor (SIH, `sihsim_quadx`): its ground truth is the truth; it takes off and holds by itself."""

from __future__ import annotations

import asyncio
import contextlib
import math
import random
import re
from collections import deque
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from scipy.spatial.transform import Rotation

from sim.aircraft import Site
from sim.earth import STANDARD_GRAVITY_M_S2
from sim.flying.vehicle import FlyingAircraft, FlyingVehicle, State
from sim.flying.verdict import Event
from sim.imu_model import Bias
from sim.scenario import Scenario
from sim.sitl.ground import GroundStation
from sim.sitl.process import LOOPBACK, BinaryError, FirmwareProcess
from sim.sitl.px4 import Px4
from sim.station import Station, open_udp

MAGNETOMETER = {"cs_mag_hdg", "cs_mag_3d"}
AUTO, LOITER = 4, 3
"""Main mode and sub mode of a PX4 that holds its place."""
_UDP_TRUTH = 19410
TRUTH_HZ = 250.0
ASKED_EVERY_S = 1.0
GUST_EVERY_S = 5.0
"""Interval of gusts. A parameter that changes while PX4 stores another one stops its simulated time."""
GUST_SHARE = 0.1
"""Ratio of gusts to the mean wind; this aircraft has a drag of 1 N for 1 m/s at 1 kg, ten times that of others."""
TURNED_S = 4.0
FORCE_OVER = 25
"""Number of steps between compared velocities, which are sent in whole cm/s."""


class GroundTruth(Station):
    """Feeds HIL_STATE_QUATERNION of SIH to an aircraft: rates from attitudes, forces from velocities."""

    def __init__(self, aircraft: FlyingAircraft, system_id: int) -> None:
        super().__init__(system_id, mavlink.MAV_COMP_ID_USER2)
        self.boots = 0
        self._aircraft, self._system_id = aircraft, system_id
        self._asked_s = -math.inf
        self._before: tuple[float, Rotation] | None = None
        self._velocities: deque[tuple[float, float, float, float]] = deque(maxlen=FORCE_OVER)
        self._start: tuple[float, float, float] | None = None

    def receive(self, data: bytes, t_s: float) -> None:
        """Handle bytes without keeping messages; renew the request for a higher rate now and then."""
        super().receive(data, t_s)
        for _, message in self.heard:
            if isinstance(message, mavlink.MAVLink_hil_state_quaternion_message):
                state = self.state(message)
                if state is not None:
                    self._aircraft.take(state, t_s)
        self.heard.clear()
        if t_s - self._asked_s > ASKED_EVERY_S:
            self._asked_s = t_s
            number, rate = mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION, 1e6 / TRUTH_HZ
            self.send(
                mavlink.MAVLink_command_long_message(
                    self._system_id, 1, mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 0, number, rate, *[0.0] * 5
                )
            )

    def state(self, told: mavlink.MAVLink_hil_state_quaternion_message) -> State | None:
        """Return the next state; None for the first message after a start, and for a message out of order."""
        w, x, y, z = told.attitude_quaternion
        own_s, turn = told.time_usec * 1e-6, Rotation.from_quat((x, y, z, w))
        before = self._before
        if before is not None and before[0] - 1.0 < own_s <= before[0]:
            return None
        self._before = own_s, turn
        if before is None or own_s < before[0]:
            self._velocities.clear()
            self._aircraft.restart()
            self.boots += 1
            return None
        rate = (before[1].inv() * turn).as_rotvec() / (own_s - before[0])
        velocity = (told.vx * 1e-2, told.vy * 1e-2, told.vz * 1e-2)
        self._velocities.append((own_s, *velocity))
        first, last = np.array(self._velocities[0]), np.array(self._velocities[-1])
        pushed = (last - first)[1:] / max(last[0] - first[0], 1e-3) - (0.0, 0.0, STANDARD_GRAVITY_M_S2)
        here = told.lat * 1e-7, told.lon * 1e-7, told.alt * 1e-3
        self._start = start = self._start or here
        north, east = Site(*start).north_east_m(*here[:2])
        return State(
            own_s, (w, x, y, z), tuple(rate), tuple(turn.inv().apply(pushed)),
            (north, east, start[2] - here[2]), velocity,
        )  # fmt: skip


def source_changes(flags: str) -> list[Event]:
    """Parse `listener estimator_status_flags`: changes between "1", our pushed heading, and "2", the magnetometer."""
    found, source = list[Event](), ""
    for printed in flags.split("TOPIC:")[1:]:
        own_s = re.search(r"timestamp: (\d+)", printed)
        on = set(re.findall(r"(cs_\w+): True", printed))
        now = "1" if "cs_ev_yaw" in on else "2" if on & MAGNETOMETER else ""
        if own_s is None or not now or now == source:
            continue
        if source:
            found.append(Event(int(own_s[1]) * 1e-6, "set", now))
        source = now
    return found


class FlyingPx4(Px4, FlyingVehicle):
    """A `px4` of SITL that simulates itself, in wind with gusts.

    Args:
        binary: the firmware; its `etc` lies beside its folder.
        scenario: its aircraft is a `FlyingAircraft`.
        folder: folder for the binary's files.
        wind: speed in m/s and direction of origin in degrees.
        seed: seed of the gusts.
    """

    model = "sihsim_quadx"
    backend: GroundTruth

    def __init__(
        self, binary: Path, scenario: Scenario, folder: Path, *, wind: tuple[float, float], seed: int = 0
    ) -> None:
        from_rad = math.radians(wind[1])
        self._wind = {"SIH_WIND_N": -wind[0] * math.cos(from_rad), "SIH_WIND_E": -wind[0] * math.sin(from_rad)}
        parameters = self._wind | {"SDLOG_BACKEND": 0.0, "COM_LOW_BAT_ACT": 0.0}
        super().__init__(binary, scenario, folder, parameters=parameters)
        site = self.aircraft.site
        self._environment |= {
            "PX4_HOME_LAT": f"{site.latitude_deg}",
            "PX4_HOME_LON": f"{site.longitude_deg}",
            "PX4_HOME_ALT": f"{site.height_m}",
            "PX4_HOME_YAW": f"{math.remainder(self.aircraft.angles_rad(0.0)[2], math.tau):.4f}",  # SIH_LOC_YAW0, in rad
        }
        self.modes = {"hold": AUTO << 16 | LOITER << 24}
        self._gust_m_s, self._dice = GUST_SHARE * wind[0], random.Random(seed)
        self.backend = GroundTruth(self.truth, self.system_id)
        self._flags = self.folder / "flags.txt"
        self.sticks_us = []

    def true_bias(self, instance: int, t_s: float) -> Bias:
        """Return zero: SIH's IMU has noise, and no bias."""
        return Bias(np.zeros(3), np.zeros(3))

    async def _open(self, stack: contextlib.AsyncExitStack) -> FirmwareProcess:
        self.truth.begin(asyncio.get_running_loop().time())
        end = await open_udp(self.backend, listen=(LOOPBACK, _UDP_TRUTH + self.instance))
        stack.callback(end.close)
        return self._process_of()

    async def take_off(self, ground: GroundStation, height_m: float) -> None:
        """Arm with all checks, and climb to MIS_TAKEOFF_ALT."""
        await ground.put("MIS_TAKEOFF_ALT", height_m)
        await ground.command(mavlink.MAV_CMD_NAV_TAKEOFF, *[0.0] * 3, *[math.nan] * 4)
        await self.arm(ground)
        await ground.wait_for(lambda: self.height_m > 0.9 * height_m, 60.0, "take-off")

    def mode_parameters(self, number: int) -> tuple[float, ...]:
        """Return main and sub mode."""
        return number >> 16 & 0xFF, number >> 24

    async def ask_streams(self, ground: GroundStation) -> None:
        """Request the streams, and on the console the estimator's flags: each change with its time."""
        await super().ask_streams(ground)
        with self._flags.open("wb") as flags:
            listener = await asyncio.create_subprocess_exec(
                str(self._binary.with_name("px4-listener")), "--instance", str(self.instance),
                "estimator_status_flags", "-i", "0", "-n", "1000000",
                stdin=asyncio.subprocess.DEVNULL, stdout=flags,
            )  # fmt: skip

        async def end() -> None:
            with contextlib.suppress(ProcessLookupError):
                listener.terminate()
            await listener.wait()

        self._stack.push_async_callback(end)

    def source_changes(self) -> list[Event]:
        """Return the changes by the estimator's flags: "1" is our pushed heading, "2" its magnetometer."""
        return source_changes(self._flags.read_text(errors="replace"))

    async def hold(self, ground: GroundStation) -> None:
        """Do nothing: after take-off, this aircraft holds its place by itself."""
        await self.until_mode(ground, "hold")

    async def turn(self, ground: GroundStation, degrees: float) -> None:
        """Command a clockwise turn on the spot."""
        yaw_rad = math.remainder(self.truth.recorded[-1][3] + math.radians(degrees), math.tau)
        await ground.command(mavlink.MAV_CMD_DO_REPOSITION, -1.0, 0.0, 0.0, yaw_rad, *[math.nan] * 3)
        await self.sleep(TURNED_S)

    async def steer(self, ground: GroundStation) -> None:
        """Make gusts until cancelled: there are no sticks."""
        while True:
            for name, mean in self._wind.items():
                ground.send_put(name, mean + self._dice.gauss(0.0, self._gust_m_s), mavlink.MAV_PARAM_TYPE_REAL32)
            await asyncio.sleep(GUST_EVERY_S)

    async def lie_with_own_compass(self, ground: GroundStation) -> None:
        """Raise an error: SIH's compass cannot be turned."""
        raise BinaryError("the compass of PX4's simulation cannot be turned")
