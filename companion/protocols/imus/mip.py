"""MicroStrain (HBK, LORD) inertial sensors: packets of the MIP protocol.

    75 65  set  length  (length, descriptor, data)...  F1 F2        big-endian; F1 F2: 8-bit Fletcher over all before

Source: 3DM-GX5-35 data communications protocol manual, p. 12; MicroStrain's `mip_sdk`. Of the sensor data (set 0x80)
are used: 0x04 accelerometer in g, 0x05 gyro in rad/s, 0x12 GPS time of week in seconds, which is the device's own clock
until it has a GPS time. Accelerometer and gyro have to be set to the same rate: they then share a packet, and only a
pair makes a sample. Axes are X forward, Y right, Z down: level and at rest it reads z = -1 g, and a unit with X forward
and its base down has the mounting ROTATION_NONE.
"""

from __future__ import annotations

import struct
from itertools import accumulate
from typing import ClassVar, Final

from companion.physics.units import G
from companion.protocols.decoding import reasons
from companion.protocols.decoding.base import WAIT, FrameDecoder, RejectedError, check_imu, check_vector
from companion.protocols.decoding.dialogue import WakeDialogue
from companion.samples import ImuSample, Sample, Vector

_MARK = b"\x75\x65"
_SENSOR_DATA = 0x80
_ACCEL, _GYRO, _GPS_TIME = 0x04, 0x05, 0x12
_VECTOR = struct.Struct(">3f")
_TIME = struct.Struct(">dHH")
_ABSENT: Final[Vector] = (0.0, 0.0, 0.0)


class MipDecoder(FrameDecoder):
    """MIP packets; gives `ImuSample`."""

    device_clock_wraps_s: ClassVar[float | None] = 7 * 86400.0  # GPS time of week

    def _next(self, buffer: bytes, at: int, origin: int, samples: list[Sample]) -> int:
        if not buffer.startswith(_MARK, at):
            return self._find_mark(_MARK, buffer, at)
        if len(buffer) < at + 4:
            return WAIT
        end = at + 4 + buffer[at + 3] + 2
        if len(buffer) < end:
            return WAIT
        if fletcher(buffer[at : end - 2]) != buffer[end - 2 : end]:
            # Not `end`: in what a false start took for its own, a good frame may begin.
            return self._reject(reasons.CHECKSUM, at + 1)
        return self._accept(samples, _decode, buffer, at, end - 2, self._time_of(origin + end), end=end)


def fletcher(data: bytes) -> bytes:
    """The two bytes at the end of a packet: the sum of all before, and the sum of all the running sums."""
    sums = list(accumulate(data))
    return bytes((sums[-1] & 0xFF, sum(sums) & 0xFF))


def _decode(buffer: bytes, at: int, stop: int, t_s: float) -> list[Sample]:
    if buffer[at + 2] != _SENSOR_DATA:
        raise RejectedError(reasons.REPLY if buffer[at + 2] < _SENSOR_DATA else reasons.NOTHING_OF_USE)
    found: dict[int, Vector] = {}
    t_device_s: float | None = None
    field = at + 4
    while field < stop:
        length = buffer[field]
        if length < 2 or field + length > stop:
            raise RejectedError(reasons.FIELD_COUNT)
        kind = buffer[field + 1]
        if kind in {_ACCEL, _GYRO, _GPS_TIME}:
            if length != 14:
                raise RejectedError(reasons.FIELD_COUNT)
            if kind == _GPS_TIME:
                t_device_s, _week, _flags = _TIME.unpack_from(buffer, field + 2)
                check_vector((t_device_s, 0.0, 0.0))
            else:
                found[kind] = _VECTOR.unpack_from(buffer, field + 2)
        field += length
    accel_g, gyro_rad_s = found.get(_ACCEL), found.get(_GYRO)
    accel_m_s2 = _ABSENT
    if accel_g is not None:
        x, y, z = accel_g
        accel_m_s2 = (x * G, y * G, z * G)
    check_imu(gyro_rad_s or _ABSENT, accel_m_s2, None)
    if accel_g is None or gyro_rad_s is None:
        raise RejectedError(reasons.NOTHING_OF_USE)
    return [ImuSample(t_s, gyro_rad_s, accel_m_s2, None, None, t_device_s)]


class MipDialogue(WakeDialogue):
    """Base command 0x06: an idle device sends again what it is set to send (mip_sdk: "out of idle mode")."""

    SAYINGS = ((bytes.fromhex("756501020206E5CB"), "stream resumed with MIP command 01 06"),)
