"""MicroStrain (HBK, LORD) inertial sensors: packets of the MIP protocol.

    75 65  set  length  (length, descriptor, data)...  F1 F2        big-endian; F1 F2: 8-bit Fletcher of all before

Source: 3DM-GX5-35 data communications protocol manual, p. 12; MicroStrain's `mip_sdk`. Fields used from the sensor data
(set 0x80): 0x04 accelerometer in g, 0x05 gyro in rad/s, 0x12 GPS time of week in seconds. Until the device has a GPS
time, 0x12 is its own clock. Accelerometer and gyro must be set to the same rate: they then share a packet, and only a
pair makes a sample. Axes are X forward, Y right, Z down: level and at rest z reads -1 g. A unit with X forward and its
base down has the mounting ROTATION_NONE.
"""

from __future__ import annotations

import re
import struct
from itertools import accumulate
from typing import ClassVar, Final

from companion.physics.units import G
from companion.protocols.decoding.base import Decoder, RejectedError, check_imu, check_vector
from companion.protocols.decoding.dialogue import WakeDialogue
from companion.samples import ImuSample, Sample, Vector

_SENSOR_DATA = 0x80
_ACCEL, _GYRO, _GPS_TIME = 0x04, 0x05, 0x12
_VECTOR = struct.Struct(">3f")
_TIME = struct.Struct(">dHH")
_ABSENT: Final[Vector] = (0.0, 0.0, 0.0)


class MipDecoder(Decoder):
    device_clock_wraps_s: ClassVar[float | None] = 7 * 86400.0  # GPS time of week

    START = re.compile(rb"\x75(?:\x65|\Z)")

    def _size(self, buffer: bytes, at: int) -> int:
        return 4 + buffer[at + 3] + 2

    def _check(self, frame: bytes) -> None:
        if fletcher(frame[:-2]) != frame[-2:]:
            raise RejectedError("checksum")

    def _decode(self, frame: bytes, t_s: float) -> list[Sample]:
        if frame[2] != _SENSOR_DATA:
            raise RejectedError("reply" if frame[2] < _SENSOR_DATA else "nothing of use")
        found: dict[int, Vector] = {}
        t_device_s: float | None = None
        field, stop = 4, len(frame) - 2
        while field < stop:
            length = frame[field]
            if length < 2 or field + length > stop:
                raise RejectedError("field count")
            kind = frame[field + 1]
            if kind in {_ACCEL, _GYRO, _GPS_TIME}:
                if length != 14:
                    raise RejectedError("field count")
                if kind == _GPS_TIME:
                    t_device_s, _week, _flags = _TIME.unpack_from(frame, field + 2)
                    check_vector((t_device_s, 0.0, 0.0))
                else:
                    found[kind] = _VECTOR.unpack_from(frame, field + 2)
            field += length
        x, y, z = found.get(_ACCEL, _ABSENT)
        gyro_rad_s, accel_m_s2 = found.get(_GYRO, _ABSENT), (x * G, y * G, z * G)
        check_imu(gyro_rad_s, accel_m_s2, None)
        if len(found) < 2:
            raise RejectedError("nothing of use")
        return [ImuSample(t_s, gyro_rad_s, accel_m_s2, None, None, t_device_s)]


def fletcher(data: bytes) -> bytes:
    sums = list(accumulate(data))
    return bytes((sums[-1] & 0xFF, sum(sums) & 0xFF))


class MipDialogue(WakeDialogue):
    """Base command 0x06, resume: an idle device sends its configured outputs again (mip_sdk: "out of idle mode")."""

    SAYINGS = ((bytes.fromhex("756501020206E5CB"), "stream resumed with MIP command 01 06"),)
