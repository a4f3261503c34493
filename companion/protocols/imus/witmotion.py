"""WitMotion WT901, JY901, HWT90x and SINxT: frames of 11 bytes that begin with 0x55.

    55 51 ax ay az T SUM      accelerations, 1/2048 g; temperature, 1/100 degree Celsius
    55 52 wx wy wz T SUM      rates, 2000/32768 deg/s
    55 53 roll pitch yaw V SUM      angles, 180/32768 deg

Numbers have 16 bits, little-endian; SUM is the low byte of the sum of the ten bytes before it. Sources: WitMotion's
WT901 data sheet p. 10-14, WT901SDCL p. 13-16, HWT905-TTL protocol page (9600 8N1, 10 Hz, 51 to 54 by default).

0x55 also occurs in data, and the sum is weak. So a frame is accepted only if another good frame follows at once. Noise
looks like one frame at one offset in 10^6, and like two at one in 10^12; one of 256 frames with a lost byte looks good.
The cost: the last frame of a burst waits for the next burst, but its time stays right. The packets of
Bluetooth models (0x61) have no checksum and are not read.

The axes are the device's own, and Z is up. The angles turn Z-Y-X about these axes (WT901 p. 12), so with X forward and
Y left roll is right side down and pitch nose down. As a gradienter the device therefore gives x = roll and y = -pitch,
law "euler", with its own X forward. The temperature scale is that of these documents. Six-axis models (BWT61CL, JY61)
use 1/340 degree from 36.53 instead; their temperature is wrong.
"""

from __future__ import annotations

import re
import struct
from typing import Final

from companion.physics.units import DEG, MG
from companion.protocols.decoding.base import NO_FRAME, Decoder, RejectedError
from companion.samples import ImuSample, Sample, TiltSample, Vector

FRAME_BYTES: Final = 11
ALONE: Final = "incomplete pair"

_FIRST_TYPE, _LAST_TYPE = 0x50, 0x5F
_ACCEL, _GYRO, _ANGLE, _FIELD = 0x51, 0x52, 0x53, 0x54
_NUMBERS: Final = struct.Struct("<4h")
_G_M_S2: Final = 1e3 * MG
_ACCEL_SCALE: Final = 16.0 * _G_M_S2 / 32768.0
_GYRO_SCALE: Final = 2000.0 * DEG / 32768.0
_ANGLE_SCALE: Final = 180.0 / 32768.0
_LEAST, _GREATEST = -32768, 32767


class WitMotionDecoder(Decoder):
    """Decoder of WitMotion frames into `ImuSample` (from adjacent acceleration and rate) and `TiltSample`."""

    _good_at = -1
    """Stream position of the newest frame that is known to have a right sum; -1: none."""
    _accel: tuple[int, Vector, float] | None = None
    """Acceleration frame that waits for its rate frame: stream position of its end, m/s^2, degrees Celsius."""

    def interrupted(self) -> None:
        super().interrupted()
        self._drop_accel()

    START = re.compile(b"\x55")

    def _size(self, buffer: bytes, at: int) -> int:
        here = self._origin + at
        if self._good_at != here and (size := _good(buffer, at)) != FRAME_BYTES:
            return size
        self._good_at = here
        try:
            following = _good(buffer, at + FRAME_BYTES)
        except RejectedError:
            following = NO_FRAME
        if following == NO_FRAME:
            raise RejectedError(ALONE)
        if following == FRAME_BYTES:
            self._good_at = here + FRAME_BYTES
        return following

    def _decode(self, frame: bytes, t_s: float) -> list[Sample]:
        kind, end = frame[1], self._good_at
        accel = self._accel
        if accel is not None and not (kind == _GYRO and accel[0] == end - FRAME_BYTES):
            self._drop_accel()
            accel = None
        if kind == _FIELD:
            self.accepted += 1  # not used, but it confirms the protocol
        if not _ACCEL <= kind <= _ANGLE:
            return []  # field, time, ports, pressure, position, quaternion: valid, not used
        x, y, z, last = _NUMBERS.unpack_from(frame, 2)
        if kind == _ANGLE:
            if max(abs(x), abs(y)) > 16384:  # beyond 90 degrees
                raise RejectedError("out of range")
            return [TiltSample(t_s, x * _ANGLE_SCALE, -y * _ANGLE_SCALE)]
        self._accel = None
        if kind == _GYRO and accel is None:
            raise RejectedError("orphan")
        if max(x, y, z) == _GREATEST or min(x, y, z) == _LEAST:
            raise RejectedError("over range")
        if accel is not None:
            gyro_rad_s = (x * _GYRO_SCALE, y * _GYRO_SCALE, z * _GYRO_SCALE)
            return [ImuSample(t_s, gyro_rad_s, accel[1], accel[2])]
        self._accel = end, (x * _ACCEL_SCALE, y * _ACCEL_SCALE, z * _ACCEL_SCALE), last / 100.0
        return []

    def _drop_accel(self) -> None:
        if self._accel is not None:
            self.rejected["orphan"] += 1
            self._accel = None


def _good(buffer: bytes, at: int) -> int:
    """Return `FRAME_BYTES` if a frame begins at `at`, otherwise `NO_FRAME`; raise RejectedError for a wrong sum."""
    if buffer[at] != 0x55 or not _FIRST_TYPE <= buffer[at + 1] <= _LAST_TYPE:
        return NO_FRAME
    last = at + FRAME_BYTES - 1
    if buffer[last] != sum(buffer[at:last]) & 0xFF:
        raise RejectedError("checksum")
    return FRAME_BYTES
