"""PX4's console over MAVLink (SERIAL_CONTROL, device SHELL): `listener` of the topics with the EKF's bias.

As in the real one (1.19-alpha1): the input is echoed, then the answer and a prompt, 70 bytes a message; unknown topics
and topics without publisher are reported as such. PX4 `mavlink_shell.cpp`, `topic_listener`,
`orb_print_message_internal` (five decimals).
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.firmware.channel import Channel
from sim.px4.board import PX4Board

_BYTES = 70
_PROMPT = "pxh> "
_STEP_S = 0.01
"""Pause of a port's loop, which sends one message each time if the line has room."""
_PACKET = 93
STATUS_S = 0.1
"""Period of `vehicle_imu_status`."""


class Shell:
    """A console that answers on every port; `typed` contains the received lines."""

    def __init__(self, double: PX4Board) -> None:
        self._double = double
        self.typed: list[str] = []
        self._waiting: dict[int, bytearray] = {}

    def restart(self) -> None:
        self._waiting.clear()

    def take(self, port: Channel, message: mavlink.MAVLink_serial_control_message, loop_s: float) -> None:
        if message.device != mavlink.SERIAL_CONTROL_DEV_SHELL or message.flags & mavlink.SERIAL_CONTROL_FLAG_REPLY:
            return
        text = ""
        for line in bytes(message.data[: message.count]).decode("ascii").splitlines():
            self.typed.append(line)
            text += f"{line}\n{self._run(line.split(), loop_s)}{_PROMPT}"
        waiting = self._waiting.setdefault(id(port), bytearray())
        if not waiting:
            self._double.later(_STEP_S, lambda: self._send(port, waiting))
        waiting += text.encode()

    def _send(self, port: Channel, waiting: bytearray) -> None:
        if port.has_room(_PACKET):
            part, waiting[:] = bytes(waiting[:_BYTES]), waiting[_BYTES:]
            reply = mavlink.MAVLink_serial_control_message(
                mavlink.SERIAL_CONTROL_DEV_SHELL, mavlink.SERIAL_CONTROL_FLAG_REPLY, 0, 0, len(part),
                [*part.ljust(_BYTES, b"\0")],
            )  # fmt: skip
            self._double.answer(port, reply)
        if waiting:
            self._double.later(_STEP_S, lambda: self._send(port, waiting))

    def _run(self, words: list[str], loop_s: float) -> str:
        if not words:
            return ""
        if words[0] != "listener" or not self._double.console:
            return f"Invalid command: {words[0]}\ntype 'help' for a list of commands\n"
        topic, *more = words[1:]
        self._double.update_estimators(loop_s)
        instances = {
            "estimator_selector_status": self._selector,
            "estimator_sensor_bias": self._biases,
            "vehicle_imu": self._imus,
            "vehicle_imu_status": self._statuses,
        }.get(topic)
        if instances is None:
            return f"Topic {topic} did not match any known topics\nCommand 'listener' failed, returned -1.\n"
        printed = [f" {topic}\n" + "".join(f"    {line}\n" for line in each) + "\n" for each in instances(loop_s)]
        if more[:1] == ["-i"]:
            number = int(more[1])
            if number >= len(printed):
                return "never published\n"
            return f"\nTOPIC: {topic} instance {number} #1\n{printed[number]}"
        if len(printed) < 2:
            return f"\nTOPIC: {topic}\n{printed[0]}" if printed else "never published\n"
        parts = [f"\nInstance {number}:\n{each}\n" for number, each in enumerate(printed)]
        return f"\nTOPIC: {topic} {len(parts)} instances\n{''.join(parts)}"

    def _selector(self, loop_s: float) -> list[list[str]]:
        double = self._double
        own = double.vehicle_imus[double.primary_imu].device_id
        if len(double.imus) == 1:
            return []  # a single EKF has none to choose
        return [
            [
                *_stamp(double.boot_us(loop_s)),
                "last_instance_change: 508000",
                "instance_changed_count: 1",
                *(f"{kind}_device_id: {_device(own)}" for kind in ("accel", "baro", "gyro", "mag")),
                "combined_test_ratio: [0.00248, 0.00233, nan, nan, nan, nan, nan, nan, nan]",
                f"primary_instance: {double.primary_imu}",
                f"instances_available: {len(double.imus)}",
                "healthy: [True, True, False, False, False, False, False, False, False]",
            ]
        ]

    def _biases(self, loop_s: float) -> list[list[str]]:
        return [
            [
                *_stamp(self._double.boot_us(loop_s)),
                f"timestamp_sample: {self._double.boot_us(loop_s)} (152000 us before timestamp)",
                *_bias("gyro", imu.device_id, imu.estimator.published[:3]),
                *_bias("accel", imu.device_id, imu.estimator.published[3:]),
                "gyro_bias_valid: True",
                "accel_bias_valid: True",
            ]
            for imu in self._double.vehicle_imus
        ]

    def _imus(self, loop_s: float) -> list[list[str]]:
        return [
            [
                *_stamp(self._double.boot_us(loop_s)),
                f"timestamp_sample: {self._double.boot_us(loop_s)} (800 us before timestamp)",
                f"accel_device_id: {_device(imu.device_id)}",
                f"gyro_device_id: {_device(imu.device_id)}",
                "delta_angle: [0.00001, -0.00001, 0.00002]",
            ]
            for imu in self._double.vehicle_imus
        ]

    def _statuses(self, loop_s: float) -> list[list[str]]:
        """Return means over 0.1 s of raw readings in vehicle axes; constant until the next mean is published."""
        t_s = math.floor(self._double.aircraft.time_at(loop_s) / STATUS_S) * STATUS_S
        found = []
        for imu in self._double.vehicle_imus:
            gyro, accel = np.split(imu.raw_mean(t_s, STATUS_S), 2)
            degc = imu.model.temperature_degc(t_s)
            found.append(
                [
                    *_stamp(self._double.boot_us(loop_s) - round((self._double.aircraft.time_at(loop_s) - t_s) * 1e6)),
                    f"accel_device_id: {_device(imu.device_id)}",
                    f"gyro_device_id: {_device(imu.device_id)}",
                    *(f"{kind}_clipping: [0, 0, 0]" for kind in ("accel", "gyro")),
                    *(f"{kind}_error_count: 0" for kind in ("accel", "gyro")),
                    *(f"{kind}_rate_hz: 250.00000" for kind in ("accel", "gyro", "accel_raw", "gyro_raw")),
                    "accel_vibration_metric: 0.00656",
                    "gyro_vibration_metric: 0.00049",
                    "delta_angle_coning_metric: 0.00000",
                    f"mean_accel: {_vector(accel)}",
                    f"mean_gyro: {_vector(gyro)}",
                    "var_accel: [0.00002, 0.00004, 0.00002]",
                    "var_gyro: [0.00000, 0.00000, 0.00000]",
                    f"temperature_accel: {degc:.5f}",
                    f"temperature_gyro: {degc:.5f}",
                ]
            )
        return found


def _vector(values: Iterable[float]) -> str:
    return f"[{', '.join(f'{value:.5f}' for value in values)}]"


def _stamp(boot_us: int) -> Iterable[str]:
    return (f"timestamp: {boot_us} (0.196000 seconds ago)",)


def _device(number: int) -> str:
    return f"{number} (Type: 0x14, SIMULATION:1 (0x01))"


def _bias(kind: str, device_id: int, bias: Iterable[float]) -> Iterable[str]:
    return (
        f"{kind}_device_id: {_device(device_id)}",
        f"{kind}_bias: {_vector(bias)}",
        f"{kind}_bias_limit: 0.15000",
        f"{kind}_bias_variance: [0.00000, 0.00000, 0.00000]",
    )
