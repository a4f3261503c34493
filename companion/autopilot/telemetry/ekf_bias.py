"""The bias that PX4's EKF takes off HIGHRES_IMU, read at PX4's console.

HIGHRES_IMU is the reading of one IMU in floats less this bias, which no message tells, and the console does.

The bias is published once a second, or as soon as it has moved by 0.001 rad/s or m/s^2, and wanders slowly between.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import re
from collections.abc import Iterator
from typing import Final

import numpy as np

from companion.autopilot.firmware.imu_messages import EkfBiasReading
from companion.autopilot.telemetry.px4_console import ID, VECTOR, Px4Console
from companion.autopilot.vehicle.vehicle import ArmState, Vehicle, VehicleEvent
from companion.links.system.listeners import Listeners
from companion.links.system.waiting import comes

logger = logging.getLogger(__name__)

LOOK_EVERY_S: Final = 5.0
"""In turn at the bias and at which EKF flies: 1300 bytes each, 4.5 % of a line of 57600 baud."""
_AT_FIRST_S: Final = 1.0
MISSES: Final = 10
_AGAIN_S: Final = 60.0
"""After so many answers that did not come or were not understood."""
_TURN_S: Final = 0.5
_OLD_S: Final = 45.0
_CALM_S: Final = 60.0
"""New offsets set the estimate to nothing, and it is some seconds until it is back. On a deck they are watched for 40 s
by the integers, and floats that came back earlier would begin that anew."""
_UNITS: Final = np.repeat([1e-3, 1e-2], 3)
_JUMP: Final = 0.5 * _UNITS
"""Largest step from one look to the next: 100 deg/h, 0.5 mg."""
_STEADY: Final = 0.02 * _UNITS
"""Within a second, before it is used: 4 deg/h, 0.02 mg."""

# Seventy bytes that are lost leave no other match: each value has its neighbours beside it.
_PRIMARY: Final = re.compile(r"primary_instance: (\d+)\s|estimator_selector_status[^>]*never published")
_BIAS: Final = re.compile(
    rf"gyro_device_id: {ID}gyro_bias: {VECTOR}gyro_bias_limit.*"
    rf"accel_device_id: {ID}accel_bias: {VECTOR}accel_bias_limit",
    re.DOTALL,
)
_IMU: Final = re.compile(
    r"(?:Instance (\d+):|TOPIC: vehicle_imu)\s+vehicle_imu\s+timestamp: [^\n]*\n\s*timestamp_sample: [^\n]*\n\s*"
    rf"accel_device_id: {ID}gyro_device_id: {ID}"
)


class EkfBias:
    """Reads the bias again and again; `run` it."""

    def __init__(self, console: Px4Console, vehicle: Vehicle) -> None:
        self.instance: int | None = None
        """The IMU (1..) that HIGHRES_IMU shows; None while its bias is not known."""
        self.settled = asyncio.Event()
        """Set once the bias is known, or the first answer did not tell it."""
        self.reading: EkfBiasReading | None = None
        """Latest reading; `known_of` says whether it may be used."""
        self.on_read: Listeners[EkfBiasReading] = Listeners()
        """Notified of every reading."""
        self._console, self._vehicle = console, vehicle
        self._held, self._misses = 0, 0
        self._woken = asyncio.Event()
        self._from_s = -math.inf
        self._imus: dict[tuple[int, int], int] = {}
        """IMUs (1..) by the device ids of accelerometer and gyro."""
        self._primary: int | None = None
        self._at_bias = False

    def known_of(self, instance: int) -> bool:
        """Whether HIGHRES_IMU shows this IMU (1..) and `reading` restores its readings."""
        return self.instance == instance and not self._age_s > _OLD_S

    def forget(self) -> None:
        """Start anew."""
        self.instance = self._primary = self.reading = None

    @contextlib.contextmanager
    def held(self) -> Iterator[None]:
        """While offsets are written the bias does nothing but step, and for some time after."""
        self._held += 1
        self.forget()
        try:
            yield
        finally:
            self._held -= 1
            self.step()

    def step(self) -> None:
        """Other offsets have come into force."""
        self.forget()
        self._from_s = asyncio.get_running_loop().time() + _CALM_S

    async def run(self) -> None:
        """Read until cancelled."""
        ignore = self._vehicle.on_event.add(self._on_event)
        try:
            while True:
                self._woken.clear()
                await comes(self._woken, await self._look() if self.may_look else _TURN_S)
        finally:
            ignore()

    @property
    def may_look(self) -> bool:
        """Whether something may be typed now."""
        disarmed = self._vehicle.kind.tells_ekf_bias and self._vehicle.arm_state is ArmState.DISARMED
        return disarmed and not self._held and asyncio.get_running_loop().time() >= self._from_s

    @property
    def _age_s(self) -> float:
        return math.inf if self.reading is None else asyncio.get_running_loop().time() - self.reading.read_s

    async def _look(self) -> float:
        """Read once; seconds to the next look."""
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
        """Whether the console told what was wanted of it: which EKF flies, or the bias of that one."""
        self._at_bias = self._primary is not None and (self.instance is None or not self._at_bias)
        if not self._at_bias:
            found = await self._console.listener("estimator_selector_status", _PRIMARY)
            if found is None:
                return False
            primary = int(found[1] or 0)  # a single EKF has no selector
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
