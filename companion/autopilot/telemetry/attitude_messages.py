"""Our attitude as MAVLink messages, in the form that each firmware uses (docs/reference/autopilots 6).

The message is VISION_POSITION_ESTIMATE rather than ODOMETRY. For an attitude without a position, PX4 treats ODOMETRY as
relative to a local frame instead of north, and ArduPilot accepts ODOMETRY only in a local frame. Also, PX4 rejects a
quaternion whose norm deviates by more than 1e-5; Euler angles have no norm. Neither firmware fuses roll and pitch.

PX4 uses our time stamps only after 500 exchanges of TIMESYNC (50 s at its 10 Hz) of less than 10 ms each. Until then a
message counts as measured on arrival (docs/reference/autopilots 4.5). ArduPilot sends TIMESYNC every 10 s, only for its
log.
"""

from __future__ import annotations

import asyncio
import math
from typing import Final

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.attitude.estimator import Attitude
from companion.autopilot.firmware.base import Firmware
from companion.autopilot.vehicle.vehicle import Vehicle
from companion.links.mavlink.link import MavlinkLink

NOWHERE_VARIANCE_M2: Final = 1e4  # variance sent for the missing position: ArduPilot limits its sigma to 100 m
_X, _Y, _Z, _ROLL, _PITCH, _YAW = 0, 6, 11, 15, 18, 20  # diagonal's indices in the upper triangle, row by row
_U32: Final = 2**32


def microseconds(t_s: float) -> int:
    """Convert a time of our clock to the time stamp in all our messages: one clock for one link."""
    return round(t_s * 1e6)


def vision_position_estimate(
    firmware: Firmware, attitude: Attitude, reset_counter: int
) -> mavlink.MAVLink_vision_position_estimate_message:
    """Make the message with the attitude in NED (true north) and without a position.

    ArduPilot discards the whole message if the position is NaN, so it gets 0; PX4 gets NaN. ArduPilot computes the
    sigma of yaw from the sum of the variances of roll, pitch and yaw, so it gets only the variance of yaw.
    """
    sigma_roll, sigma_pitch, sigma_yaw = attitude.sigma_rad
    covariance = [0.0] * 21
    covariance[_X] = covariance[_Y] = covariance[_Z] = NOWHERE_VARIANCE_M2
    covariance[_YAW] = sigma_yaw**2
    nowhere = 0.0
    if firmware.takes_nan_position:
        covariance[_ROLL], covariance[_PITCH] = sigma_roll**2, sigma_pitch**2
        nowhere = math.nan
    return mavlink.MAVLink_vision_position_estimate_message(
        microseconds(attitude.t_s),
        nowhere,
        nowhere,
        nowhere,
        attitude.roll_rad,
        attitude.pitch_rad,
        attitude.yaw_rad,
        covariance,
        reset_counter % 256,
    )


def attitude_messages(
    attitude: Attitude,
) -> tuple[mavlink.MAVLink_attitude_message, mavlink.MAVLink_attitude_quaternion_message]:
    """Make ATTITUDE and ATTITUDE_QUATERNION for ground stations and logs; both autopilots ignore them."""
    boot_ms = int(attitude.t_s * 1e3) % _U32
    q = np.array(attitude.quaternion, dtype=np.float32)
    w, x, y, z = (q / np.linalg.norm(q)).tolist()
    angles = (attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad)
    return (
        mavlink.MAVLink_attitude_message(boot_ms, *angles, *attitude.rate_rad_s),
        mavlink.MAVLink_attitude_quaternion_message(boot_ms, w, x, y, z, *attitude.rate_rad_s),
    )


class TimesyncResponder:
    """Answers the autopilot's TIMESYNC requests with the clock that stamps our messages."""

    def __init__(self, link: MavlinkLink, vehicle: Vehicle) -> None:
        self.answered = 0
        self._link = link
        vehicle.hear(mavlink.MAVLink_timesync_message, self._on_timesync)

    def _on_timesync(self, message: mavlink.MAVLink_timesync_message, _t_s: float) -> None:
        if message.tc1 == 0:
            now_ns = round(asyncio.get_running_loop().time() * 1e9)
            self._link.send(mavlink.MAVLink_timesync_message(now_ns, message.ts1))
            self.answered += 1
