"""A PX4 double, a companion and a ground station, each on its own wire, on virtual time."""

from __future__ import annotations

import asyncio
import struct
from typing import Any, Self

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.aircraft import Pose, VirtualAircraft
from sim.imu_model import DEG_H, MG, ImuModel
from sim.px4.double import PX4Double
from sim.station import Station
from tests.support.wire import Wire

POSE = Pose(5.0, -3.0, 40.0)
GYRO_BIAS = np.array([100.0, -60.0, 170.0]) * DEG_H
ACCEL_BIAS = np.array([1.0, -2.0, 3.0]) * MG
INT32 = mavlink.MAV_PARAM_TYPE_INT32
REAL32 = mavlink.MAV_PARAM_TYPE_REAL32
CALIBRATE = mavlink.MAV_CMD_PREFLIGHT_CALIBRATION
ARM = mavlink.MAV_CMD_COMPONENT_ARM_DISARM
INTERVAL = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
REQUEST = mavlink.MAV_CMD_REQUEST_MESSAGE
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED, IN_PROGRESS = range(6)
LATEST_S = 1.2
"""After this every consumer has looked at a change."""


def now_s() -> float:
    return asyncio.get_running_loop().time()


class PX4Stage:
    """The companion is 1/191 on TELEM2, the ground station 255/190 on TELEM1. Rivals are off unless asked for."""

    def __init__(self, *, rivals: bool = False, **options: Any) -> None:
        self.aircraft: VirtualAircraft = options.pop("aircraft", None) or VirtualAircraft(POSE)
        spec, count = options.pop("spec", "perfect"), options.pop("imus", 1)
        gyro, accel = options.pop("gyro_bias", GYRO_BIAS), options.pop("accel_bias", ACCEL_BIAS)
        imus = [
            ImuModel(self.aircraft, spec, seed=n, gyro_bias_rad_s=gyro, accel_bias_m_s2=accel) for n in range(count)
        ]
        usual = {} if rivals else {"IMU_GYRO_CAL_EN": 0, "SENS_IMU_AUTOCAL": 0}
        parameters = {**usual, **options.pop("parameters", {})}
        options = {"default_streams": False, **options}
        self.double = PX4Double(self.aircraft, options.pop("models", imus), parameters=parameters, **options)
        self.companion, self.ground = Station(1, 191), Station(255, 190)
        Wire(self.companion, self.double, seed=1)
        Wire(self.ground, self.double.ground, seed=2)
        self._tasks: list[asyncio.Task[None]] = []

    async def __aenter__(self) -> Self:
        self._tasks = [asyncio.create_task(self.double.run()), asyncio.create_task(self._heartbeats())]
        await asyncio.sleep(0.05)
        return self

    async def __aexit__(self, *_: object) -> None:
        for task in self._tasks:
            task.cancel()
        for result in await asyncio.gather(*self._tasks, return_exceptions=True):
            if isinstance(result, Exception):
                raise result

    async def _heartbeats(self) -> None:
        while True:
            self.companion.heartbeat()
            self.ground.heartbeat(mavlink.MAV_TYPE_GCS)
            await asyncio.sleep(1.0)

    async def set(self, name: str, value: float) -> None:
        """Write as a correct companion does, in the parameter's own type; nothing is waited for."""
        if self.double.parameters.is_int(name):
            packed = struct.unpack("<f", struct.pack("<i", int(value)))[0]
            self.companion.send(mavlink.MAVLink_param_set_message(1, 1, name.encode(), packed, INT32))
        else:
            self.companion.send(mavlink.MAVLink_param_set_message(1, 1, name.encode(), value, REAL32))
        await asyncio.sleep(0.01)

    async def set_vector(
        self, slot: int, kind: str, vector: tuple[float, float, float], *, settle: bool = True
    ) -> None:
        """CAL_<kind><slot>_{X,Y,Z}OFF, one after the other; `settle`: wait until everybody has looked."""
        for axis, value in zip("XYZ", vector, strict=True):
            await self.set(f"CAL_{kind}{slot}_{axis}OFF", value)
        if settle:
            await asyncio.sleep(2.0 * LATEST_S)

    def values(self, name: str, *, station: Station | None = None, since_s: float = 0.0) -> list[float]:
        """PARAM_VALUEs of a name that a station has heard; integers decoded."""
        found = (station or self.companion).all(mavlink.MAVLink_param_value_message, since_s=since_s)
        return [decoded(message) for message in found if message.param_id == name]

    def errors(self) -> list[tuple[str, int]]:
        """PARAM_ERRORs that the companion has heard."""
        return [(e.param_id, e.error) for e in self.companion.all(mavlink.MAVLink_param_error_message)]

    def acks(self, command: int, station: Station | None = None) -> list[int]:
        found = (station or self.companion).all(mavlink.MAVLink_command_ack_message)
        return [ack.result for ack in found if ack.command == command]


def decoded(message: mavlink.MAVLink_param_value_message) -> float:
    """The value in a PARAM_VALUE by PX4's rule."""
    if message.param_type == INT32:
        return float(struct.unpack("<i", struct.pack("<f", message.param_value))[0])
    return float(message.param_value)
