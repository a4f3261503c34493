"""IMU messages of both autopilots (units, resolution, which IMU: autopilots 2, 4.5), and samples made of them."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any, Final

import msgspec
import numpy as np
from msgspec import structs
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.links.mavlink.link import Message
from companion.physics.units import MG
from companion.samples import ImuSample

MRAD: Final = 1e-3


def all_zero(sample: ImuSample) -> bool:
    """No accelerometer at rest or in flight reads exactly nothing: it is not there."""
    return not any(sample.gyro_rad_s) and not any(sample.accel_m_s2)


@dataclasses.dataclass(frozen=True, slots=True)
class ImuMessage:
    """A message that may carry an IMU's samples."""

    name: str
    message: type[Message]
    decode: Callable[[Message, float], ImuSample | str]  # the sample in a message, or why there is none
    integers: bool = False  # values are cut toward zero to thousandths of rad/s and g
    from_script: bool = False  # ArduPilot's script sends it, while disarmed and asked (`SCRIPT_ASK`)
    lacks_bias: bool = False  # the bias of the EKF is to be added to it

    @property
    def gyro_step_rad_s(self) -> float:
        return MRAD if self.integers else 0.0

    @property
    def accel_step_m_s2(self) -> float:
        return MG if self.integers else 0.0


_ACCEL_AND_GYRO: Final = 0b111111  # HIGHRES_IMU.fields_updated: all three axes of both


def _highres(message: Any, t_s: float) -> ImuSample | str:
    if message.id != 0:  # the first usable one: not ours when the autopilot does not use its first IMU
        return f"shows IMU {message.id + 1}"
    if message.fields_updated & _ACCEL_AND_GYRO != _ACCEL_AND_GYRO:
        return "lacks accelerometer or gyro"
    gyro = (message.xgyro, message.ygyro, message.zgyro)
    accel = (message.xacc, message.yacc, message.zacc)
    if not all(map(math.isfinite, (*gyro, *accel))):
        return "carries a value that is not a number"
    # Its temperature is the barometer's (ArduPilot) or the air's (PX4).
    return ImuSample(t_s, gyro, accel, t_device_s=message.time_usec * 1e-6)


def _scaled(message: Any, t_s: float) -> ImuSample:
    return ImuSample(
        t_s,
        (message.xgyro * MRAD, message.ygyro * MRAD, message.zgyro * MRAD),
        (message.xacc * MG, message.yacc * MG, message.zacc * MG),
        # Zero means that there is none: a sensor at 0 deg C says 0.01 (MAVLink common.xml).
        message.temperature * 0.01 if message.temperature else None,
        t_device_s=message.time_boot_ms * 1e-3,
    )


HIGHRES: Final = ImuMessage("HIGHRES_IMU", mavlink.MAVLink_highres_imu_message, _highres)
SCALED: Final = ImuMessage("SCALED_IMU", mavlink.MAVLink_scaled_imu_message, _scaled, integers=True)
SCALED2: Final = ImuMessage("SCALED_IMU2", mavlink.MAVLink_scaled_imu2_message, _scaled, integers=True)
SCALED3: Final = ImuMessage("SCALED_IMU3", mavlink.MAVLink_scaled_imu3_message, _scaled, integers=True)

SCRIPT_ASK: Final = b"CMPF\x01"  # payload that asks the script for floats; it sends them for 3 s
_SCRIPT_NAME: Final = "CMP_IMU"
_SCRIPT_FLOATS: Final = 7


def _from_script(instance: int, message: Any, t_s: float) -> ImuSample | str:
    if message.name != _SCRIPT_NAME or message.array_id != 1:
        return ""  # somebody else's
    values = message.data[_SCRIPT_FLOATS * (instance - 1) :][:_SCRIPT_FLOATS]
    if not all(map(math.isfinite, values)):
        return "carries a value that is not a number"
    gx, gy, gz, ax, ay, az, degc = values
    return ImuSample(t_s, (gx, gy, gz), (ax, ay, az), degc or None, t_device_s=message.time_usec * 1e-6)


SCRIPT: Final = {
    instance: ImuMessage(
        "floats of the script",
        mavlink.MAVLink_debug_float_array_message,
        functools.partial(_from_script, instance),
        from_script=True,
    )
    for instance in (1, 2, 3)
}
"""Means of four readings, calibrated and filtered, about eleven a second."""

PX4_FLOATS: Final = dataclasses.replace(HIGHRES, name="HIGHRES_IMU+bias", lacks_bias=True)
"""HIGHRES_IMU of the IMU that PX4 flies by. PX4 takes EKF2's own estimate of the bias off it, so at rest it tells
nothing until that is known and added again (`telemetry.px4_console`)."""

TEMPERATURE_AGE_S: Final = 5.0  # HIGHRES_IMU has none of the IMU: it comes with the integer messages
_LATE_S: Final = 0.5  # a device time that goes back by less is a late message; by more, a restart
_WALK: Final = np.repeat([2.4e-6, 3e-5], 3)
"""Random walk of the EKF's bias estimate in one second at rest, rad/s and m/s^2: 0.5 deg/h and 3 micro-g (real PX4: 0.2
to 0.5 deg/h)."""

Six = tuple[float, float, float, float, float, float]


class EkfBiasReading(msgspec.Struct, frozen=True):
    """Bias that PX4's EKF takes off HIGHRES_IMU, as read at its console."""

    bias: Six  # gyro in rad/s, accelerometer in m/s^2
    variance: Six
    read_s: float

    def restored(self, sample: ImuSample) -> ImuSample:
        gx, gy, gz, ax, ay, az = (np.array(sample.gyro_rad_s + sample.accel_m_s2) + self.bias).tolist()
        variance = (np.array(self.variance) + np.square(_WALK) * (sample.t_s - self.read_s)).tolist()
        return structs.replace(
            sample, gyro_rad_s=(gx, gy, gz), accel_m_s2=(ax, ay, az), shared_variance=tuple(variance)
        )


class ImuSamples:
    """Completes the samples of one IMU's messages. Knows no clock: time comes in with the messages."""

    def __init__(self) -> None:
        self.temperature: tuple[float, float] | None = None  # deg C, and its time; None: none since the restart
        self._device_s: dict[str, float] = {}

    def accept(self, message: str, sample: ImuSample) -> bool:
        """Note the sample's temperature; False: the message is repeated or late."""
        device_s = sample.t_device_s or 0.0
        if -_LATE_S < device_s - self._device_s.get(message, -math.inf) <= 0.0:
            return False
        self._device_s[message] = device_s
        if sample.temperature_degc is not None:
            self.temperature = (sample.temperature_degc, sample.t_s)
        return True

    def temperature_degc(self, now_s: float) -> float | None:
        known = self.temperature
        return None if known is None or now_s - known[1] > TEMPERATURE_AGE_S else known[0]

    def complete(self, sample: ImuSample, bias: EkfBiasReading | None = None) -> ImuSample:
        restored = sample if bias is None else bias.restored(sample)
        return structs.replace(restored, temperature_degc=self.temperature_degc(sample.t_s))
