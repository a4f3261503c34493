"""IMU messages of both autopilots, and samples made from them (units: docs/reference/autopilots 2, 4.5)."""

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
    """Check that all readings are zero, as of an absent IMU: a real accelerometer never reads exactly zero."""
    return not any(sample.gyro_rad_s) and not any(sample.accel_m_s2)


@dataclasses.dataclass(frozen=True, slots=True)
class ImuMessage:
    name: str
    message: type[Message]
    decode: Callable[[Message, float], ImuSample | str]  # returns the sample in a message, or why there is none
    integers: bool = False  # values are truncated toward zero to thousandths of rad/s and g
    from_script: bool = False  # ArduPilot's script sends it, while disarmed and requested (`SCRIPT_ASK`)
    lacks_bias: bool = False  # the EKF's bias is subtracted in it and must be added again

    @property
    def gyro_step_rad_s(self) -> float:
        return MRAD if self.integers else 0.0

    @property
    def accel_step_m_s2(self) -> float:
        return MG if self.integers else 0.0


_ACCEL_AND_GYRO: Final = 0b111111  # HIGHRES_IMU.fields_updated: all three axes of both


def _highres(message: Any, t_s: float) -> ImuSample | str:
    if message.id != 0:  # the message shows the first IMU in use, which may not be IMU 1
        return f"shows IMU {message.id + 1}"
    if message.fields_updated & _ACCEL_AND_GYRO != _ACCEL_AND_GYRO:
        return "lacks accelerometer or gyro"
    gyro = (message.xgyro, message.ygyro, message.zgyro)
    accel = (message.xacc, message.yacc, message.zacc)
    if not all(map(math.isfinite, (*gyro, *accel))):
        return "carries a value that is not a number"
    # The message's temperature is the barometer's (ArduPilot) or the air's (PX4), so it is not used.
    return ImuSample(t_s, gyro, accel, t_device_s=message.time_usec * 1e-6)


def _scaled(message: Any, t_s: float) -> ImuSample:
    return ImuSample(
        t_s,
        (message.xgyro * MRAD, message.ygyro * MRAD, message.zgyro * MRAD),
        (message.xacc * MG, message.yacc * MG, message.zacc * MG),
        # Zero means no temperature: a sensor at 0 deg C reports 0.01 (MAVLink common.xml).
        message.temperature * 0.01 if message.temperature else None,
        t_device_s=message.time_boot_ms * 1e-3,
    )


HIGHRES: Final = ImuMessage("HIGHRES_IMU", mavlink.MAVLink_highres_imu_message, _highres)
SCALED: Final = ImuMessage("SCALED_IMU", mavlink.MAVLink_scaled_imu_message, _scaled, integers=True)
SCALED2: Final = ImuMessage("SCALED_IMU2", mavlink.MAVLink_scaled_imu2_message, _scaled, integers=True)
SCALED3: Final = ImuMessage("SCALED_IMU3", mavlink.MAVLink_scaled_imu3_message, _scaled, integers=True)

SCRIPT_ASK: Final = b"CMPF\x01"  # payload that requests floats from the script, which sends them for 3 s
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
"""Messages of our ArduPilot script by IMU, some eleven a second, with means of four calibrated, filtered readings."""

PX4_FLOATS: Final = dataclasses.replace(HIGHRES, name="HIGHRES_IMU+bias", lacks_bias=True)
"""HIGHRES_IMU of the IMU that PX4 uses for flight. PX4 subtracts EKF2's estimate of the bias, so at rest the message
shows no bias until that estimate is read and added again (`telemetry.px4_console`)."""

TEMPERATURE_AGE_S: Final = 5.0  # HIGHRES_IMU lacks the IMU's temperature, which the integer messages carry
_LATE_S: Final = 0.5  # a device time that goes back by less means a late message; by more, a restart
_WALK: Final = np.repeat([2.4e-6, 3e-5], 3)
"""Random walk of EKF2's bias estimate in one second at rest, (6,), rad/s and m/s^2: 0.5 deg/h and 3 micro-g. A real PX4
has 0.2 to 0.5 deg/h."""

Six = tuple[float, float, float, float, float, float]


class EkfBiasReading(msgspec.Struct, frozen=True):
    """Bias that PX4's EKF2 subtracts in HIGHRES_IMU, as read at PX4's console."""

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
    """Adds temperature and bias to the samples of one IMU's messages. It reads no clock: messages carry the time."""

    def __init__(self) -> None:
        self.temperature: tuple[float, float] | None = None  # deg C and its time; None: no value since the restart
        self._device_s: dict[str, float] = {}

    def accept(self, message: str, sample: ImuSample) -> bool:
        """Store the sample's temperature; return False if the message is repeated or late."""
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
