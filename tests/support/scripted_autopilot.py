"""A small scripted autopilot for the tests of companion.autopilot: it does as ArduPilot does, and as it is told.

Independent of the code under test; pymavlink is only its codec. (The simulator's double is another, fuller one.)
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import struct
from collections.abc import AsyncIterator, Callable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.links.mavlink.link import MavlinkLink
from tests.support.wire import Wire

IMU_OF = {
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: 1,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: 1,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU: 1,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU2: 2,
    mavlink.MAVLINK_MSG_ID_SCALED_IMU3: 3,
}


def f32(value: float) -> float:
    return struct.unpack("<f", struct.pack("<f", value))[0]  # type: ignore[no-any-return]


class ScriptedAutopilot:
    def __init__(
        self,
        *,
        system: int = 1,
        component: int = 1,
        autopilot: int = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        kind: int = mavlink.MAV_TYPE_QUADROTOR,
        parameters: dict[str, float] | None = None,
        param_errors: bool = True,
    ) -> None:
        self.autopilot, self.kind = autopilot, kind
        self.parameters = {name: f32(value) for name, value in (parameters or {}).items()}
        self.heartbeat_s = 1.0
        self.param_errors = param_errors
        self.armed = False
        self.beating = True
        self.booting = False
        self.acks = True
        self.requests: list[Any] = []
        self.sets: list[tuple[str, float, bool]] = []
        """Every PARAM_SET that arrived: name, value, whether armed then."""
        self.on_message: Callable[[Any], bool] = lambda message: True
        """Called first with every message; False: do as if it had not come."""
        self.on_set: Callable[[str, float], float | None] = lambda name, value: value
        """Maps a set value to the stored one; None: no answer at all."""
        self.result_of: Callable[[Any], int] = lambda message: int(mavlink.MAV_RESULT_ACCEPTED)
        self.imu: dict[int, tuple[tuple[float, ...], tuple[float, ...]]] = {
            1: ((0.001, -0.002, 0.003), (0.1, -0.2, -9.8)),
            2: ((0.0101, -0.0202, 0.0303), (0.11, -0.22, -9.8)),
            3: ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        }
        self.imu_temperature_cdegc = 2715
        self.highres_id = 0
        self.intervals: dict[int, float] = {}
        self._boot_s = 0.0
        self._codec = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self._codec.robust_parsing = True
        self._transmit: Callable[[bytes], None] | None = None
        self._due: dict[int, float] = {}

    def attach(self, transmit: Callable[[bytes], None] | None) -> None:
        self._transmit = transmit

    def send(self, message: Any) -> None:
        data = message.pack(self._codec)
        self._codec.seq = (self._codec.seq + 1) % 256
        if self._transmit is not None:
            self._transmit(data)

    def uptime_s(self) -> float:
        return asyncio.get_running_loop().time() - self._boot_s

    async def run(self, uptime_s: float = 100.0) -> None:
        loop = asyncio.get_running_loop()
        self._boot_s = loop.time() - uptime_s
        next_beat_s = loop.time()
        while True:
            now_s = loop.time()
            if now_s >= next_beat_s - 1e-9:
                next_beat_s = now_s + self.heartbeat_s
                if self.beating and not self.booting:
                    self.beat()
            if not self.booting:
                for message_id, interval_s in self.intervals.items():
                    if now_s >= self._due.get(message_id, 0.0) - 1e-9:
                        self._due[message_id] = now_s + interval_s
                        self._stream(message_id)
            due = [next_beat_s, *(self._due[i] for i in self.intervals)]
            await asyncio.sleep(max(min(min(due) - loop.time(), 0.1), 1e-3))

    def beat(self) -> None:
        mode = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0)
        self.send(mavlink.MAVLink_heartbeat_message(self.kind, self.autopilot, mode, 0, mavlink.MAV_STATE_STANDBY, 3))

    async def reboot(self, down_s: float = 3.0) -> None:
        """Restart: streams are forgotten; parameters persist."""
        self.booting = True
        self.armed = False
        self.intervals.clear()
        await asyncio.sleep(down_s)
        self._boot_s = asyncio.get_running_loop().time() - 0.5
        self.booting = False
        self.beat()

    def _stream(self, message_id: int) -> None:
        ms, us = int(self.uptime_s() * 1e3), int(self.uptime_s() * 1e6)
        if message_id == mavlink.MAVLINK_MSG_ID_SYSTEM_TIME:
            self.send(mavlink.MAVLink_system_time_message(1_800_000_000_000_000 + us, ms))
        elif message_id == mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT:
            self.send(mavlink.MAVLink_global_position_int_message(ms, 400000000, 1160000000, 50000, 0, 0, 0, 0, 0))
        elif message_id in IMU_OF:
            gyro, accel = self.imu[IMU_OF[message_id]]
            if message_id == mavlink.MAVLINK_MSG_ID_HIGHRES_IMU:
                floats = [*accel, *gyro, *[0.0] * 6, 55.5]  # the temperature is the barometer's
                highres: Any = mavlink.MAVLink_highres_imu_message
                self.send(highres(us, *floats, 8191, self.highres_id))
                return
            values = [a * 1000 / 9.80665 for a in accel] + [g * 1000 for g in gyro] + [0.0, 0.0, 0.0]
            counts = [int(value) if math.isfinite(value) else 0 for value in values]  # cut toward zero
            integers: Any = mavlink.mavlink_map[message_id]
            if message_id == mavlink.MAVLINK_MSG_ID_RAW_IMU:
                self.send(integers(us, *counts, 0, self.imu_temperature_cdegc))
            else:
                self.send(integers(ms, *counts, self.imu_temperature_cdegc))

    def value(self, name: str) -> None:
        kind = mavlink.MAV_PARAM_TYPE_REAL32
        self.send(mavlink.MAVLink_param_value_message(name.encode(), self.parameters[name], kind, 1362, 65535))

    def receive(self, data: bytes, t_s: float) -> None:
        for message in self._codec.parse_buffer(data) or ():
            if message.get_type() != "BAD_DATA" and not self.booting:
                self.requests.append(message)
                if self.on_message(message):
                    self._handle(message)

    def _handle(self, message: Any) -> None:
        if getattr(message, "target_system", 0) not in (0, self._codec.srcSystem):
            return
        if message.get_type() == "PARAM_REQUEST_READ":
            name = message.param_id if message.param_index < 0 else next(iter(self.parameters))
            if name in self.parameters:
                kind, index = mavlink.MAV_PARAM_TYPE_REAL32, 0 if message.param_index == 0 else 65535
                value = self.parameters[name]
                self.send(mavlink.MAVLink_param_value_message(name.encode(), value, kind, 1362, index))
            elif self.param_errors:
                self._refuse(message, mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST)
        elif message.get_type() == "PARAM_SET":
            self._set(message)
        elif message.get_type() == "COMMAND_LONG":
            self._command(message)
        elif message.get_type() == "TIMESYNC" and message.tc1 == 0:
            self.send(mavlink.MAVLink_timesync_message(int(self.uptime_s() * 1e9), message.ts1))

    def _refuse(self, message: Any, code: int) -> None:
        who = (message.get_srcSystem(), message.get_srcComponent())
        self.send(mavlink.MAVLink_param_error_message(*who, message.param_id.encode(), -1, code))

    def _set(self, message: Any) -> None:
        name = message.param_id
        self.sets.append((name, message.param_value, self.armed))
        if name not in self.parameters:
            if self.param_errors:
                self._refuse(message, mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST)
            return
        value = self.on_set(name, message.param_value)
        if value is None:
            return
        self.parameters[name] = f32(value)
        # ArduPilot: writing X of a vector emits X, Y and Z.
        names = [name[:-1] + axis for axis in "XYZ"] if name.endswith("_X") else [name]
        for each in names:
            if each in self.parameters:
                self.value(each)

    def _command(self, message: Any) -> None:
        result = self.result_of(message)
        if result == mavlink.MAV_RESULT_ACCEPTED and message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            self.intervals[int(message.param1)] = message.param2 * 1e-6
            if message.param2 == 0:  # back to the default: not sent
                del self.intervals[int(message.param1)]
            if int(message.param1) == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
                self.heartbeat_s = message.param2 * 1e-6
        if message.command == mavlink.MAV_CMD_REQUEST_MESSAGE and int(message.param1) == 0 and self.beating:
            self.beat()
        if message.command == mavlink.MAV_CMD_REQUEST_MESSAGE and int(message.param1) == 148:
            version = bytes([4, 8, 0, 0])
            self.send(
                mavlink.MAVLink_autopilot_version_message(
                    2, int.from_bytes(version, "big"), 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0
                )
            )
        if message.command == mavlink.MAV_CMD_REQUEST_MESSAGE and int(message.param1) == 2:
            self._stream(mavlink.MAVLINK_MSG_ID_SYSTEM_TIME)
        if self.acks:
            who = (message.get_srcSystem(), message.get_srcComponent())
            self.send(mavlink.MAVLink_command_ack_message(message.command, result, 0, 0, *who))


@contextlib.asynccontextmanager
async def flying_on(
    link: MavlinkLink, *autopilots: ScriptedAutopilot, seed: int = 0, loss: float = 0.0, duplicate: float = 0.0
) -> AsyncIterator[Wire]:
    """Run the (first) autopilot at the other end of a wire."""
    wire = Wire(link, autopilots[0], seed=seed, loss=loss, duplicate=duplicate)
    tasks = [asyncio.create_task(autopilot.run()) for autopilot in autopilots]
    try:
        yield wire
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
