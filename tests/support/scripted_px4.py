"""A small scripted autopilot with PX4's manners: slots, integers byte by byte, exact types, the 0.01 rule.

Independent of the code under test (autopilots 4, 7.5, 9.2, 9.3.2); pymavlink is only its codec.
"""

from __future__ import annotations

import asyncio
import math
import struct
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.support.scripted_autopilot import IMU_OF, ScriptedAutopilot, f32

INT32, REAL32 = mavlink.MAV_PARAM_TYPE_INT32, mavlink.MAV_PARAM_TYPE_REAL32
G = 9.80665
ICM = 2752514  # an ICM-42688-P on SPI 1: bus type 2
WHOLE = ("_ID", "_PRIO", "_ROT", "_CAL_EN", "_AUTOCAL", "_CONFIG", "_FORWARD")


def px4_parameters(*device_ids: int) -> dict[str, float]:
    """Parameters of an autopilot whose slots hold these devices, gyro and accelerometer alike."""
    found: dict[str, float] = {"SENS_BOARD_ROT": 0, "IMU_GYRO_CAL_EN": 0, "SENS_IMU_AUTOCAL": 0}
    found |= {f"SENS_BOARD_{axis}_OFF": 0.0 for axis in "XYZ"}
    for n in range(4):
        for prefix in (f"CAL_GYRO{n}", f"CAL_ACC{n}"):
            found |= {f"{prefix}_ID": device_ids[n] if n < len(device_ids) else 0}
            found |= {f"{prefix}_PRIO": -1, f"{prefix}_ROT": -1}
            found |= {f"{prefix}_{axis}OFF": 0.0 for axis in "XYZ"}
        found |= {f"CAL_ACC{n}_{axis}SCALE": 1.0 for axis in "XYZ"}
    return found


class ScriptedPx4(ScriptedAutopilot):
    """`devices`: the device ids of its IMUs by instance, 1 first; `raw`: what each shows without any offset."""

    def __init__(
        self,
        *,
        devices: tuple[int, ...] = (ICM,),
        parameters: dict[str, float] | None = None,
        capabilities: int = 2 | 16,
        **others: Any,
    ) -> None:
        super().__init__(autopilot=mavlink.MAV_AUTOPILOT_PX4, **others)
        self.parameters = {
            name: value if name.endswith(WHOLE) else f32(value)
            for name, value in (px4_parameters(*devices) | (parameters or {})).items()
        }
        self.devices, self.capabilities = devices, capabilities
        self.raw = [(np.array([0.001, -0.0006, 0.0015]), np.array([0.1, -0.2, -9.8])) for _ in devices]
        self.used: dict[tuple[str, int], np.ndarray] = {}
        self.noise: tuple[float, float] = (0.0004, 0.005)
        self.wrong_types: list[str] = []
        self._random = np.random.default_rng(5)
        self._pending = False
        self.load(boot=True)

    # --- parameters

    def value(self, name: str) -> None:
        value = self.parameters[name]
        carried, kind = (
            (struct.unpack("<f", struct.pack("<i", int(value)))[0], INT32) if name.endswith(WHOLE) else (value, REAL32)
        )
        self.send(mavlink.MAVLink_param_value_message(name.encode(), carried, kind, 920, 65535))

    def _handle(self, message: Any) -> None:
        kind = message.get_type()
        if kind == "PARAM_REQUEST_READ" and message.param_index < 0 and message.param_id in self.parameters:
            self.value(message.param_id)
        elif kind == "COMMAND_LONG" and message.command == 512 and int(message.param1) == 0:
            self.beat()
            super()._handle(message)
        elif kind == "COMMAND_LONG" and message.command == 512 and int(message.param1) == 148:
            version = int.from_bytes(bytes([1, 18, 0, 0]), "big")
            self.send(
                mavlink.MAVLink_autopilot_version_message(
                    self.capabilities, version, 0, 0, 0, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0
                )
            )
            who = (message.get_srcSystem(), message.get_srcComponent())
            self.send(mavlink.MAVLink_command_ack_message(message.command, 0, 0, 0, *who))
        else:
            super()._handle(message)

    def _set(self, message: Any) -> None:
        name = message.param_id
        if name not in self.parameters:
            self._answer_error(message, mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST)
            return
        whole = name.endswith(WHOLE)
        if message.param_type != (INT32 if whole else REAL32):
            self.wrong_types.append(name)
            self._answer_error(message, 7)
            return
        value = float(message.param_value)
        if whole:
            value = struct.unpack("<i", bytes(message.get_msgbuf()[10:14]).ljust(4, b"\0"))[0]
        self.sets.append((name, value, self.armed))
        taken = self.on_set(name, value)
        if taken is None:
            return
        self.parameters[name] = taken if whole else f32(taken)
        self.changed()
        self.value(name)

    def _answer_error(self, message: Any, code: int) -> None:
        if self.param_errors:
            self._refuse(message, code)

    # --- what it does with them

    def changed(self) -> None:
        """Consumers look 4 ms after a change, but at most once a second."""
        if not self._pending:
            self._pending = True
            loop = asyncio.get_running_loop()
            due_s = max(loop.time() + 0.004, self._looked_s + 1.0)
            loop.call_at(due_s, self._look)

    def _look(self) -> None:
        self._pending = False
        self._looked_s = asyncio.get_running_loop().time()
        self.load()

    _looked_s = -math.inf

    def load(self, *, boot: bool = False) -> None:
        """Take parameters into use as PX4 does: a vector within 0.01 of the one in use is ignored."""
        if boot:
            self.used.clear()
        for sensor in ("GYRO", "ACC"):
            for device in self.devices:
                key = (sensor, device)
                slot = next((n for n in range(4) if self.parameters[f"CAL_{sensor}{n}_ID"] == device), None)
                if slot is None:
                    self.used.pop(key, None)
                    continue
                wanted = np.array([self.parameters[f"CAL_{sensor}{slot}_{axis}OFF"] for axis in "XYZ"])
                now = self.used.get(key)
                first = now is None
                now = np.zeros(3) if now is None else now
                if np.linalg.norm(wanted - now) > 0.01 or (first and sensor == "GYRO"):
                    now = wanted
                self.used[key] = now

    def rotation(self) -> np.ndarray:
        return np.eye(3)

    def output(self, instance: int) -> tuple[np.ndarray, np.ndarray]:
        device = self.devices[instance - 1]
        gyro, accel = self.raw[instance - 1]
        zero = np.zeros(3)
        return (
            self.rotation() @ (gyro - self.used.get(("GYRO", device), zero)),
            self.rotation() @ (accel - self.used.get(("ACC", device), zero)),
        )

    def _stream(self, message_id: int) -> None:
        instance = IMU_OF.get(message_id, 0)
        if not instance:
            super()._stream(message_id)
            return
        if message_id in (mavlink.MAVLINK_MSG_ID_RAW_IMU, mavlink.MAVLINK_MSG_ID_HIGHRES_IMU):
            return
        if instance > len(self.devices):
            return
        gyro, accel = self.output(instance)
        gyro = gyro + self._random.normal(0.0, self.noise[0], 3)
        accel = accel + self._random.normal(0.0, self.noise[1], 3)
        counts = [int(value) for value in (*(accel * 1000 / G), *(gyro * 1000))]
        integers: Any = mavlink.mavlink_map[message_id]
        self.send(integers(int(self.uptime_s() * 1e3), *counts, 0, 0, 0, 2715))

    async def reboot(self, down_s: float = 3.0) -> None:
        await super().reboot(down_s)
        self.load(boot=True)
