"""ArduPilot's own multicopter and plane: its physics is the truth, its ground station flies it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import socket
import struct
from pathlib import Path
from typing import Self

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.flying.vehicle import FlyingAircraft, FlyingVehicle, State
from sim.scenario import Scenario
from sim.sitl.ardupilot import AXES, ArduPilot
from sim.sitl.ground import GroundStation
from sim.sitl.process import LOOPBACK, BinaryError, FirmwareProcess, port_free

RIDER_PORT = 9012
"""Fixed port on which a SITL with one slave waits for that slave (SIM_JSON_Master.cpp)."""
SERVO_MAGIC = 18458
_SILENT_S = 0.1
AHEAD = 40
"""Number of steps acknowledged in advance, so that SITL need not wait while we are busy."""
COPTER_MODES = {"guided": 4, "hold": 5}
PLANE_MODES = {"takeoff": 13, "hold": 15}
STICKS_S = 0.2
LOWEST_US, MIDDLE_US = 1000, 1500


def state_of(line: bytes) -> State | None:
    """Decode the JSON object that SITL sends to a slave (SIM_JSON_Master.cpp: send); None if it is invalid."""
    try:
        told = json.loads(line)
        imu = told["imu"]
        return State(
            float(told["timestamp"]), tuple(told["quaternion"]), tuple(imu["gyro"]), tuple(imu["accel_body"]),
            tuple(told["position"]), tuple(told["velocity"]),
        )  # fmt: skip
    except (ValueError, KeyError, TypeError):
        return None


class Rider:
    """A slave of SITL's physics that only listens. An async context manager.

    Args:
        aircraft: follows the physics.
    """

    def __init__(self, aircraft: FlyingAircraft) -> None:
        self._aircraft = aircraft
        self.boots = 0
        self._frame = 0
        self._heard_s = 0.0
        self._socket: socket.socket | None = None
        self._knocking: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        loop = asyncio.get_running_loop()
        self._aircraft.begin(loop.time())
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)  # noqa: FBT003
        self._socket.bind((LOOPBACK, 0))
        loop.add_reader(self._socket.fileno(), self._readable)
        self._knocking = asyncio.create_task(self._knock(), name="rider")
        return self

    async def __aexit__(self, *exc_info: object) -> None:
        assert self._socket is not None
        assert self._knocking is not None
        self._knocking.cancel()
        await asyncio.gather(self._knocking, return_exceptions=True)
        asyncio.get_running_loop().remove_reader(self._socket.fileno())
        self._socket.close()

    async def _knock(self) -> None:
        """Send acknowledgements: SITL waits for one before its first step, and after a lost packet."""
        loop = asyncio.get_running_loop()
        while True:
            if loop.time() - self._heard_s > _SILENT_S:
                self._answer()
            await asyncio.sleep(_SILENT_S)

    def _answer(self) -> None:
        assert self._socket is not None
        self._frame += 1
        packet = struct.pack("<HHI16H", SERVO_MAGIC, 1000, self._frame, *[0] * 16)
        with contextlib.suppress(OSError):  # not there yet, or gone
            self._socket.sendto(packet, (LOOPBACK, RIDER_PORT))

    def _readable(self) -> None:
        assert self._socket is not None
        for _ in range(AHEAD):
            try:
                data = self._socket.recv(4096)
            except OSError:
                return
            self._answer()
            state = state_of(data)
            if state is None:
                continue
            self._heard_s = asyncio.get_running_loop().time()
            if not self._aircraft.has_state or state.own_s < self._aircraft.own_s - 1.0:
                self.boots += 1
                self._aircraft.restart()
                for _ahead in range(AHEAD):
                    self._answer()
            self._aircraft.take(state, self._heard_s)


PLANE = {
    "AIRSPEED_CRUISE": 16.0, "AIRSPEED_MAX": 30.0, "AIRSPEED_MIN": 10.0, "ARSPD_USE": 1.0, "TRIM_THROTTLE": 50.0,
    "PTCH_LIM_MIN_DEG": -20.0, "PTCH_LIM_MAX_DEG": 25.0, "ROLL_LIMIT_DEG": 65.0, "KFF_RDDRMIX": 0.5,
    "SERVO3_MIN": 1000.0, "SERVO3_MAX": 2000.0, "WP_LOITER_RAD": 120.0, "WP_RADIUS": 50.0, "NAVL1_PERIOD": 15.0,
    "RLL2SRV_RMAX": 90.0, "RLL2SRV_TCONST": 0.25, "RLL_RATE_D": 0.01743, "RLL_RATE_FF": 0.237212, "RLL_RATE_I": 0.25,
    "RLL_RATE_P": 0.3, "PTCH2SRV_RMAX_DN": 90.0, "PTCH2SRV_RMAX_UP": 90.0, "PTCH2SRV_TCONST": 0.25,
    "PTCH_RATE_D": 0.007265, "PTCH_RATE_FF": 0.595723, "PTCH_RATE_I": 0.11, "PTCH_RATE_P": 0.15,
    "TKOFF_ALT": 60.0, "THR_FAILSAFE": 0.0, "SIM_WIND_T": 0.0, "SIM_WIND_T_ALT": 40.0,
}  # fmt: skip
"""Tuning of SITL's plane (Tools/autotest/models/plane.parm). The wind grows with the height from zero at the ground:
any wind there would turn the plane on its wheels, which have no friction."""
COPTER = {
    "SIM_WIND_T": 1.0,
    "FRAME_CLASS": 1.0, "FRAME_TYPE": 0.0, "FS_THR_ENABLE": 0.0, "FS_GCS_ENABLE": 0.0, "MOT_THST_HOVER": 0.39,
    "ATC_RAT_YAW_P": 0.3, "ATC_RAT_YAW_I": 0.02, "DISARM_DELAY": 0.0,
}  # fmt: skip


def flying_parameters(scenario: Scenario, wind: tuple[float, float]) -> dict[str, float]:
    """Return default parameters of a calibrated vehicle whose IMUs have the scenario's biases."""
    table = {
        "SIM_RATE_HZ": 800.0,  # twice its loop
        "SIM_WIND_SPD": wind[0],
        "SIM_WIND_DIR": wind[1],
        "SIM_WIND_TURB": 1.0 if wind[0] else 0.0,
        "SIM_DRIFT_SPEED": 0.0,
        "INS_GYR_CAL": 0.0,
        "SCR_ENABLE": 1.0,
        "SERIAL0_PROTOCOL": 2.0,
        "SERIAL1_PROTOCOL": 2.0,
    }
    for number in range(1, 9):
        table |= {f"RC{number}_MIN": 1000.0, f"RC{number}_MAX": 2000.0, f"RC{number}_TRIM": float(MIDDLE_US)}
    for number, model in enumerate(scenario.flight_controller_imus[:2], 1):
        bias, ins = model.true_bias(0.0), "" if number == 1 else "2"
        for k, axis in enumerate(AXES):
            table[f"SIM_GYR{number}_BIAS_{axis}"] = float(bias.gyro_rad_s[k])
            table[f"SIM_ACC{number}_BIAS_{axis}"] = float(bias.accel_m_s2[k])
            # All exactly zero would mean "never calibrated".
            table[f"INS_ACC{ins}OFFS_{axis}"] = 1e-5
            table[f"INS_ACC{ins}SCAL_{axis}"] = 1.0
    return table


class FlyingArduPilot(ArduPilot, FlyingVehicle):
    """An `arducopter` or `arduplane` (by the binary's name) with its own physics.

    Args:
        binary: the firmware.
        scenario: its aircraft is a `FlyingAircraft`.
        folder: folder for the binary's files.
        companion: address to which SERIAL1 sends.
        wind: speed in m/s and direction of origin in degrees.
    """

    backend: Rider

    def __init__(
        self, binary: Path, scenario: Scenario, folder: Path, *, companion: tuple[str, int], wind: tuple[float, float]
    ) -> None:
        self.is_plane = "plane" in binary.name
        parameters = flying_parameters(scenario, wind) | (PLANE if self.is_plane else COPTER)
        super().__init__(binary, scenario, folder, parameters=parameters, companion=companion)
        self.modes = PLANE_MODES if self.is_plane else COPTER_MODES
        self.backend = Rider(self.truth)
        self.sticks_us = [MIDDLE_US, MIDDLE_US, LOWEST_US, MIDDLE_US]

    async def _open(self, stack: contextlib.AsyncExitStack) -> FirmwareProcess:
        if not port_free(RIDER_PORT, socket.SOCK_DGRAM):
            raise BinaryError(f"UDP port {RIDER_PORT} is taken, by another flight? One at a time")
        await stack.enter_async_context(self.backend)
        return self._process_of("--model", "plane" if self.is_plane else "quad", "--slave", "1")

    async def take_off(self, ground: GroundStation, height_m: float) -> None:
        """Arm as pilots do, with all checks, and take off."""
        await self.mode(ground, "takeoff" if self.is_plane else "guided")
        await self.arm(ground)
        if not self.is_plane:
            await ground.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, height_m)
        await ground.wait_for(lambda: self.height_m > 0.95 * height_m, 40.0, "take-off")
        self.sticks_us[2] = MIDDLE_US
        await asyncio.sleep(2.0 * STICKS_S)

    async def lie_with_own_compass(self, ground: GroundStation) -> None:
        """Turn all the vehicle's own compasses by 45 deg from now on."""
        await ground.put_all({f"SIM_MAG{number}_ORIENT": 1.0 for number in (1, 2, 3)})  # ROTATION_YAW_45

    async def hold(self, ground: GroundStation) -> None:
        """Hold the place in Loiter with centred sticks; a plane circles clockwise from here (Guided)."""
        if not self.is_plane:
            await self.mode(ground, "hold")
            return
        *_, north_m, east_m, down_m, v_north, v_east, _ = self.truth.recorded[-1]
        to_the_right = PLANE["WP_LOITER_RAD"] / math.hypot(v_north, v_east)
        north_m, east_m = north_m - to_the_right * v_east, east_m + to_the_right * v_north
        self.circle = north_m, east_m, PLANE["WP_LOITER_RAD"]
        latitude_deg, longitude_deg = self.aircraft.site.place_deg(north_m, east_m)
        ground.send(
            mavlink.MAVLink_command_int_message(
                self.system_id, 1, mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, mavlink.MAV_CMD_DO_REPOSITION, 0, 0,
                -1.0, mavlink.MAV_DO_REPOSITION_FLAGS_CHANGE_MODE, 0.0, 0.0,
                round(1e7 * latitude_deg), round(1e7 * longitude_deg), -down_m,
            )
        )  # fmt: skip
        await self.until_mode(ground, "hold")

    async def steer(self, ground: GroundStation) -> None:
        """Send stick positions until cancelled."""
        while True:
            ground.send(mavlink.MAVLink_rc_channels_override_message(self.system_id, 1, *self.sticks_us, *[0] * 4))
            await asyncio.sleep(STICKS_S)
