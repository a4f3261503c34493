"""Floats of PX4's IMUs beside the one of HIGHRES_IMU: `vehicle_imu_status`, printed by the console.

It holds means of 0.1 s of an IMU's raw readings, turned into the vehicle's axes, nothing taken off (`VehicleIMU.cpp`).
Printed a few times a second it tells the bias that the integers of SCALED_IMU hide; whether the aircraft was still in
between, the integers tell.
"""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import Callable, Collection
from typing import Final

import msgspec

from companion.autopilot.telemetry.ekf_bias import EkfBias
from companion.autopilot.telemetry.px4_console import ID, VECTOR, Px4Console
from companion.samples import Vector

PAUSE_S: Final = 0.2
"""Each answer costs the autopilot a task, and a console on the same port its calm."""
SLOW_PAUSE_S: Final = 0.9
"""On a line of 57600 baud, of which 1100 bytes an answer are then a fifth."""
_IDLE_S: Final = 0.5
_MISSES: Final = 5
_AGAIN_S: Final = 30.0
"""After so many answers in a row that did not come or were not understood."""
_STATUS: Final = re.compile(
    rf"timestamp: (\d+) [^\n]*\n\s*accel_device_id: {ID}gyro_device_id: {ID}.*"
    rf"mean_accel: {VECTOR}mean_gyro: {VECTOR}var_accel: {VECTOR}.*temperature_accel: (\S+)\s",
    re.DOTALL,
)


class RawMean(msgspec.Struct, frozen=True):
    """Mean of 0.1 s of one IMU's readings, nothing taken off, vehicle FRD."""

    instance: int
    """1 to 3."""
    t_s: float
    boot_us: int
    """Time of its publication since the autopilot's boot."""
    gyro_id: int
    accel_id: int
    gyro_rad_s: Vector
    accel_m_s2: Vector
    temperature_degc: float | None


class ImuStatus:
    """Has the console print the status of the IMUs that want it, in turn; `run` it."""

    def __init__(
        self,
        console: Px4Console,
        ekf_bias: EkfBias,
        wanted: Callable[[], Collection[int]],
        tell: Callable[[RawMean], None],
        *,
        slow: bool,
    ) -> None:
        """`wanted`: instances (1 to 3) whose telemetry is integers; `tell` is given every reading."""
        self._console, self._ekf_bias, self._wanted, self._tell = console, ekf_bias, wanted, tell
        self._pause_s = SLOW_PAUSE_S if slow else PAUSE_S
        self._seen: dict[int, int] = {}
        """Publication printed last, by instance."""

    async def run(self) -> None:
        """Ask until cancelled."""
        misses = 0
        while True:
            wanted = list(self._wanted()) if self._ekf_bias.may_look else []
            for instance in wanted:
                misses = 0 if await self._ask(instance) else misses + 1
                await asyncio.sleep(self._pause_s if misses < _MISSES else _AGAIN_S)
            if not wanted:
                await asyncio.sleep(_IDLE_S)

    async def _ask(self, instance: int) -> bool:
        found = await self._console.listener("vehicle_imu_status", _STATUS, "-i", str(instance - 1))
        if found is None:
            return False
        boot_us = int(found[1])
        if not self._ekf_bias.may_look or self._seen.get(instance) == boot_us:
            return True  # offsets are being written meanwhile, or it is the same again
        self._seen[instance] = boot_us
        ax, ay, az, gx, gy, gz = map(float, found.group(4, 5, 6, 7, 8, 9))
        degc = float(found[13]) if found[13] != "nan" else math.nan
        self._tell(
            RawMean(
                instance,
                asyncio.get_running_loop().time(),
                boot_us,
                gyro_id=int(found[3]),
                accel_id=int(found[2]),
                gyro_rad_s=(gx, gy, gz),
                accel_m_s2=(ax, ay, az),
                temperature_degc=degc if math.isfinite(degc) else None,
            )
        )
        return True
