"""Floats of PX4's IMUs, read at its console over MAVLink (SERIAL_CONTROL), as by a ground station's "MAVLink console".

HIGHRES_IMU carries floats of the IMU used for flight, minus the bias estimate of its EKF. No message carries that
estimate, so `EkfBias` reads it at the console. PX4 publishes it once a second and after a change by 0.001 rad/s or
m/s^2; the estimate wanders slowly.

`ImuStatus` reads `vehicle_imu_status` of the other IMUs: means over 0.1 s of raw readings, in the vehicle's axes,
without any correction (`VehicleIMU.cpp`). A few means a second show a bias below the resolution of SCALED_IMU's
integers. The integers show whether the aircraft was motionless in between.

The command `listener` prints topics with five decimals, which resolve 2 deg/h and 1 micro-g. No other command is sent,
and `listener` only while surely disarmed. Each MAVLink port has its own console (docs/reference/autopilots 10.3).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import re
from collections.abc import Callable, Collection, Iterator
from typing import Final

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.autopilot.firmware.imu_messages import EkfBiasReading
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle, VehicleEvent
from companion.links.mavlink.link import MavlinkLink
from companion.links.system.events import Listeners, comes
from companion.samples import ImuSample

logger = logging.getLogger(__name__)

_ID: Final = r"(\d+)[^\n]*\n\s*"  # a device id, to the start of the next line
_VECTOR: Final = r"\[(-?\d+\.\d+), (-?\d+\.\d+), (-?\d+\.\d+)\]\s*"
_ANSWER_S: Final = 4.0
_BYTES: Final = 70
_SHELL: Final = mavlink.SERIAL_CONTROL_DEV_SHELL
_ASKING: Final = mavlink.SERIAL_CONTROL_FLAG_RESPOND | mavlink.SERIAL_CONTROL_FLAG_EXCLUSIVE
_LONGEST: Final = 8192
_PROMPT: Final = re.compile("(nsh|pxh)> ")


class Px4Console:
    """Sends `listener` commands to PX4's console and collects the printed text."""

    def __init__(self, link: MavlinkLink, vehicle: Vehicle) -> None:
        self.text = ""
        self._link, self._vehicle = link, vehicle
        self._asked, self._number = "", -1
        self._answered, self._lock = asyncio.Event(), asyncio.Lock()
        link.subscribe(mavlink.MAVLink_serial_control_message, self._on_text)

    async def listener(self, topic: str, pattern: re.Pattern[str], *which: str) -> re.Match[str] | None:
        """Let PX4 print a topic and match the text to `pattern`; None: no answer in time, or no match."""
        async with self._lock:
            self.text, self._asked = "", topic
            self._answered.clear()
            line = " ".join(("listener", topic, *which, "\n")).encode()
            self._link.send(
                mavlink.MAVLink_serial_control_message(_SHELL, _ASKING, 0, 0, len(line), [*line.ljust(_BYTES, b"\0")])
            )
            await comes(self._answered, _ANSWER_S)
            self._asked = ""
            return pattern.search(self.text)

    def _on_text(self, message: mavlink.MAVLink_serial_control_message, _t_s: float) -> None:
        number, before = message.get_seq(), self._number
        if self._asked and message.device == _SHELL and self._vehicle.sent(message) and number != before:
            self._number = number  # a message with the same number is a copy
            text = bytes(message.data[: message.count]).decode("ascii", "replace")
            self.text = (self.text + text)[-_LONGEST:]
            if _PROMPT.search(self.text, max(self.text.find(self._asked), 0)) and self._asked in self.text:
                self._answered.set()


LOOK_EVERY_S: Final = 5.0  # time between reads of the bias and of the EKF in use: 1300 bytes, 4.5 % of 57600 baud
_AT_FIRST_S: Final = 1.0
MISSES: Final = 10
_AGAIN_S: Final = 60.0  # pause after `MISSES` answers in a row that were missing or not understood
_TURN_S: Final = 0.5
_OLD_S: Final = 45.0
_CALM_S: Final = 60.0
"""Wait after new offsets, which disturb the EKF's bias estimate for some seconds. On a ship's deck, the effect of new
offsets is checked for 40 s on integer messages; floats that return earlier would restart the check."""
_UNITS: Final = np.repeat([1e-3, 1e-2], 3)
_JUMP: Final = 0.5 * _UNITS  # largest change between two reads of a bias in use: 100 deg/h, 0.5 mg
_STEADY: Final = 0.02 * _UNITS  # largest change within a second before the bias is used: 4 deg/h, 0.02 mg

# The patterns include each value's neighbours, so a text that lost a message of 70 bytes cannot match wrongly.
_PRIMARY: Final = re.compile(r"primary_instance: (\d+)\s|estimator_selector_status[^>]*never published")
_BIAS: Final = re.compile(
    rf"gyro_device_id: {_ID}gyro_bias: {_VECTOR}gyro_bias_limit.*"
    rf"accel_device_id: {_ID}accel_bias: {_VECTOR}accel_bias_limit",
    re.DOTALL,
)
_IMU: Final = re.compile(
    r"(?:Instance (\d+):|TOPIC: vehicle_imu)\s+vehicle_imu\s+timestamp: [^\n]*\n\s*timestamp_sample: [^\n]*\n\s*"
    rf"accel_device_id: {_ID}gyro_device_id: {_ID}"
)


class EkfBias:
    """Reads the bias estimate of PX4's EKF repeatedly at the console; `run` is its task."""

    def __init__(self, console: Px4Console, vehicle: Vehicle) -> None:
        self.instance: int | None = None  # IMU (1..) that HIGHRES_IMU shows; None while its bias is not known
        self.settled = asyncio.Event()  # set once the bias is known, or a first read has failed
        self.reading: EkfBiasReading | None = None  # latest reading; `known_of` returns whether it may be used
        self.on_read: Listeners[EkfBiasReading] = Listeners()
        self._console, self._vehicle = console, vehicle
        self._held, self._misses = 0, 0
        self._woken = asyncio.Event()
        self._from_s = -math.inf
        self._imus: dict[tuple[int, int], int] = {}  # IMU, from 1, by device ids of accelerometer and gyro
        self._primary: int | None = None
        self._at_bias = False

    def known_of(self, instance: int) -> bool:
        """Check that HIGHRES_IMU shows IMU `instance` (1 to 3), and that the EKF bias to add to it is known."""
        return self.instance == instance and not self._age_s > _OLD_S

    def forget(self) -> None:
        self.instance = self._primary = self.reading = None

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """Suspend reads of the EKF bias, which new offsets disturb, during a write of offsets and `_CALM_S` after."""
        self._held += 1
        self.forget()
        try:
            yield
        finally:
            self._held -= 1
            self.step()

    def step(self) -> None:
        """Discard the bias and pause for `_CALM_S`, until the EKF has estimated it again with new offsets."""
        self.forget()
        self._from_s = asyncio.get_running_loop().time() + _CALM_S

    async def run(self) -> None:
        ignore = self._vehicle.on_event.add(self._on_event)
        try:
            while True:
                self._woken.clear()
                await comes(self._woken, await self._look() if self.may_look else _TURN_S)
        finally:
            ignore()

    @property
    def may_look(self) -> bool:
        return self.may_ask and asyncio.get_running_loop().time() >= self._from_s

    @property
    def may_ask(self) -> bool:
        """Return True if the console may be used now, for values that do not depend on the offsets."""
        return self._vehicle.kind.tells_ekf_bias and self._vehicle.arm_state is ArmState.DISARMED and not self._held

    @property
    def _age_s(self) -> float:
        return math.inf if self.reading is None else asyncio.get_running_loop().time() - self.reading.read_s

    async def _look(self) -> float:
        if not await self._read():
            self._misses += 1
            self.settled.set()
            if self._misses < MISSES:
                return _AT_FIRST_S
            if self._misses == MISSES:
                logger.info("PX4's console does not tell the EKF's bias; its IMUs are read in whole thousandths")
            return _AGAIN_S
        self._misses = 0
        if self.instance is not None:
            self.settled.set()
            return LOOK_EVERY_S
        return _AT_FIRST_S if self._at_bias else 0.0

    async def _read(self) -> bool:
        """Read, alternating between calls, the EKF in use and its bias; False: the console did not print the answer."""
        self._at_bias = self._primary is not None and (self.instance is None or not self._at_bias)
        if not self._at_bias:
            found = await self._console.listener("estimator_selector_status", _PRIMARY)
            if found is None:
                return False
            primary = int(found[1] or 0)  # with a single EKF, no selector is published
            if primary != self._primary:
                self.forget()
                self._primary = primary
            return True
        found = await self._console.listener("estimator_sensor_bias", _BIAS, "-i", str(self._primary))
        if found is None:
            return False
        key = int(found[5]), int(found[1])
        if key not in self._imus:
            if await self._console.listener("vehicle_imu", _IMU) is None:
                return False
            imus = _IMU.findall(self._console.text)
            self._imus = {(int(accel), int(gyro)): int(number or 0) + 1 for number, accel, gyro in imus}
            return key in self._imus
        self._take(found, self._imus[key])
        return True

    def _take(self, found: re.Match[str], instance: int) -> None:
        texts = found.groups()[1:4] + found.groups()[5:8]
        steps = np.array([10.0 ** -len(text.partition(".")[2]) for text in texts])
        bias = np.array([float(text) for text in texts])
        moved = np.abs(bias - (np.full(6, np.nan) if self.reading is None else self.reading.bias))
        most = _STEADY if self.instance is None else _JUMP
        steady = bool((moved <= np.maximum(most, 1.5 * steps)).all())
        variance = np.square(steps) / 12.0 + np.square(moved) / 4.0
        now_s = asyncio.get_running_loop().time()
        self.reading = EkfBiasReading(tuple(bias.tolist()), tuple(variance.tolist()), now_s)
        self.instance = instance if steady and not self._held else None
        self.on_read.tell(self.reading)

    def _on_event(self, event: VehicleEvent) -> None:
        if event in ("rebooted", "found"):
            self._misses = 0
            self._woken.set()
        if event == "rebooted":
            self.forget()
            self._imus.clear()
            self.settled.clear()


PAUSE_S: Final = 0.2  # pause between requests: each answer costs the autopilot a task
SLOW_PAUSE_S: Final = 0.9  # pause on a line of 57600 baud, of which answers of 1100 bytes then take a fifth
_STATUS_IDLE_S: Final = 0.5
_STATUS_MISSES: Final = 5
_STATUS_AGAIN_S: Final = 30.0  # pause after `_STATUS_MISSES` answers in a row that were missing or not understood
_STATUS: Final = re.compile(
    rf"timestamp: (\d+) [^\n]*\n\s*accel_device_id: {_ID}gyro_device_id: {_ID}.*"
    rf"mean_accel: {_VECTOR}mean_gyro: {_VECTOR}var_accel: {_VECTOR}.*temperature_accel: (\S+)\s",
    re.DOTALL,
)


class ImuStatus:
    """Reads raw means of the wanted IMUs at PX4's console, one IMU after another; `run` is its task."""

    def __init__(
        self,
        console: Px4Console,
        ekf_bias: EkfBias,
        wanted: Callable[[], Collection[int]],
        tell: Callable[[int, int, int, ImuSample], None],
        *,
        slow: bool,
    ) -> None:
        """Store the callbacks; `wanted` returns the IMUs (1 to 3) whose telemetry is integers.

        `tell` is called with the IMU, the device ids of gyro and accelerometer, and the mean of 0.1 s of raw readings.
        """
        self._console, self._ekf_bias, self._wanted, self._tell = console, ekf_bias, wanted, tell
        self._pause_s = SLOW_PAUSE_S if slow else PAUSE_S
        self._seen: dict[int, str] = {}

    async def run(self) -> None:
        misses = 0
        while True:
            wanted = list(self._wanted()) if self._ekf_bias.may_ask else []
            for instance in wanted:
                misses = 0 if await self._ask(instance) else misses + 1
                await asyncio.sleep(self._pause_s if misses < _STATUS_MISSES else _STATUS_AGAIN_S)
            if not wanted:
                await asyncio.sleep(_STATUS_IDLE_S)

    async def _ask(self, instance: int) -> bool:
        found = await self._console.listener("vehicle_imu_status", _STATUS, "-i", str(instance - 1))
        if found is None:
            return False
        if not self._ekf_bias.may_ask or self._seen.get(instance) == found[1]:
            return True  # a write of offsets has begun meanwhile, or the status is the same as before
        self._seen[instance] = found[1]
        ax, ay, az, gx, gy, gz = map(float, found.group(4, 5, 6, 7, 8, 9))
        degc = float(found[13])  # the text may be "nan"
        mean = ImuSample(
            asyncio.get_running_loop().time(),
            (gx, gy, gz),
            (ax, ay, az),
            degc if math.isfinite(degc) else None,
            t_device_s=int(found[1]) * 1e-6,
        )
        self._tell(instance, int(found[3]), int(found[2]), mean)
        return True
