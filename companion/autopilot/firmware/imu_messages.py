"""What the IMU messages of both autopilots carry: units, resolution, which IMU (autopilots 2, 4.5)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Final

import msgspec
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.links.mavlink.link import Message
from companion.physics.units import MG
from companion.samples import Vector

MRAD: Final = 1e-3


@dataclasses.dataclass(frozen=True, slots=True)
class StreamKind:
    """Which message the samples come from, and how coarse it is; the steps are 0 for floats."""

    message: str
    gyro_step_rad_s: float
    accel_step_m_s2: float
    truncates: bool
    """Whether values are cut toward zero rather than rounded."""


class Reading(msgspec.Struct, frozen=True, gc=False):
    """One message in SI units."""

    t_device_s: float
    gyro_rad_s: Vector
    accel_m_s2: Vector
    temperature_degc: float | None

    @property
    def all_zero(self) -> bool:
        """No accelerometer at rest or in flight reads exactly nothing: it is not there."""
        return not any(self.gyro_rad_s) and not any(self.accel_m_s2)


@dataclasses.dataclass(frozen=True, slots=True)
class ImuMessage:
    """A message that may carry an IMU's samples."""

    kind: StreamKind
    message: type[Message]
    decode: Callable[[Message], Reading | str]
    """The reading, or why there is none."""


_ACCEL_AND_GYRO: Final = 0b111111
"""HIGHRES_IMU.fields_updated: all three axes of both."""


def _highres(message: Any) -> Reading | str:
    if message.id != 0:  # the first usable one: not ours when the autopilot does not use its first IMU
        return f"HIGHRES_IMU shows IMU {message.id + 1}"
    if message.fields_updated & _ACCEL_AND_GYRO != _ACCEL_AND_GYRO:
        return "HIGHRES_IMU without accelerometer or gyro"
    gyro = (message.xgyro, message.ygyro, message.zgyro)
    accel = (message.xacc, message.yacc, message.zacc)
    if not all(map(math.isfinite, (*gyro, *accel))):
        return "HIGHRES_IMU with a value that is not a number"
    # Its temperature is the barometer's (ArduPilot) or the air's (PX4).
    return Reading(message.time_usec * 1e-6, gyro, accel, None)


def _integers(message: Any, t_device_s: float) -> Reading:
    return Reading(
        t_device_s,
        (message.xgyro * MRAD, message.ygyro * MRAD, message.zgyro * MRAD),
        (message.xacc * MG, message.yacc * MG, message.zacc * MG),
        # Zero means that there is none: a sensor at 0 deg C says 0.01 (MAVLink common.xml).
        message.temperature * 0.01 if message.temperature else None,
    )


def _scaled(message: Any) -> Reading:
    return _integers(message, message.time_boot_ms * 1e-3)


def _raw(message: Any) -> Reading | str:
    if message.id != 0:
        return f"RAW_IMU shows IMU {message.id + 1}"
    return _integers(message, message.time_usec * 1e-6)


def _integer_kind(name: str) -> StreamKind:
    return StreamKind(name, gyro_step_rad_s=MRAD, accel_step_m_s2=MG, truncates=True)


HIGHRES: Final = ImuMessage(
    StreamKind("HIGHRES_IMU", gyro_step_rad_s=0.0, accel_step_m_s2=0.0, truncates=False),
    mavlink.MAVLink_highres_imu_message,
    _highres,
)
SCALED: Final = ImuMessage(_integer_kind("SCALED_IMU"), mavlink.MAVLink_scaled_imu_message, _scaled)
SCALED2: Final = ImuMessage(_integer_kind("SCALED_IMU2"), mavlink.MAVLink_scaled_imu2_message, _scaled)
SCALED3: Final = ImuMessage(_integer_kind("SCALED_IMU3"), mavlink.MAVLink_scaled_imu3_message, _scaled)
RAW: Final = ImuMessage(_integer_kind("RAW_IMU"), mavlink.MAVLink_raw_imu_message, _raw)
"""Its name notwithstanding: calibrated and filtered, the same as SCALED_IMU (ArduPilot)."""

PX4_FLOATS: Final = dataclasses.replace(HIGHRES, kind=dataclasses.replace(HIGHRES.kind, message="HIGHRES_IMU+bias"))
"""HIGHRES_IMU of the IMU that PX4 flies by. PX4 takes EKF2's own estimate of the bias off it, so at rest it tells
nothing until that is known and added again (`telemetry.ekf_bias`)."""
