"""Xsens (Movella) MTi: messages MTData2 of the Xbus protocol.

    FA FF 36  length  (id, size, data)...  checksum        big-endian; all bytes after FA sum to 0 modulo 256

A length of 255 means that the actual length follows in 16 bits. The low nibble of an id names the number format: 0
float32, 1 fixed point 12.20, 2 fixed point 16.32 (the fraction first), 3 float64. Fields used: 0x1020 packet counter,
0x1060 SampleTimeFine (ticks of 0.1 ms), 0x0810 temperature (sent once a second at most, and held), 0xE020 status word.
Also 0x4020 acceleration in m/s^2 and 0x8020 rate of turn in rad/s, otherwise 0x4040 and 0x8040 (the same at high rate).
Sources: MT0605P.E p. 48 (status word) and chapter 5; MT0101P for identifiers and formats.

Axes: X forward, Y left, Z up; level and at rest z reads +9.8. Samples keep the device's own axes: for an MTi on its
base with X forward, the mounting ROTATION_ROLL_180 makes them forward, right, down.
"""

from __future__ import annotations

import re
import struct
from typing import ClassVar, Final

from companion.protocols.decoding.base import Decoder, RejectedError, check_imu
from companion.protocols.decoding.dialogue import WakeDialogue
from companion.samples import ImuSample, Sample, Vector

MAX_DATA_BYTES: Final = 1024

_MT_DATA_2 = 0x36
_EXTENDED = 0xFF
_HEAD = struct.Struct(">HB")
_COUNTER, _TIME, _TEMPERATURE, _STATUS = 0x1020, 0x1060, 0x0810, 0xE020
_ACCEL, _ACCEL_HR, _GYRO, _GYRO_HR = 0x4020, 0x4040, 0x8020, 0x8040
_VECTORS = frozenset((_ACCEL, _ACCEL_HR, _GYRO, _GYRO_HR))
_TICKS_A_SECOND = 10_000.0
_CLIPPED = 0x3F00  # bits 8 to 10 of the status word: acceleration out of range on X, Y, Z; bits 11 to 13: rate

_ABSENT: Final[Vector] = (0.0, 0.0, 0.0)
_FLOAT32 = struct.Struct(">3f")


class XsensDecoder(Decoder):
    START = re.compile(rb"\xfa(?:\xff|\Z)")
    device_clock_wraps_s: ClassVar[float | None] = 2**32 / _TICKS_A_SECOND
    clock_from_start: ClassVar[bool] = True
    sequence_modulus: ClassVar[int | None] = 2**16
    _temperature_degc: float | None = None

    def interrupted(self) -> None:
        super().interrupted()
        self._temperature_degc = None

    def _size(self, buffer: bytes, at: int) -> int:
        if buffer[at + 3] != _EXTENDED:
            return 4 + buffer[at + 3] + 1
        length = buffer[at + 4] << 8 | buffer[at + 5]
        if length > MAX_DATA_BYTES:
            raise RejectedError("too long")
        return 6 + length + 1

    def _check(self, frame: bytes) -> None:
        if sum(frame[1:]) & 0xFF:
            raise RejectedError("checksum")

    def _decode(self, frame: bytes, t_s: float) -> list[Sample]:
        if frame[2] != _MT_DATA_2:
            raise RejectedError("reply")
        field, stop = 6 if frame[3] == _EXTENDED else 4, len(frame) - 1
        vectors: dict[int, Vector] = {}
        counter: int | None = None
        t_device_s: float | None = None
        while field < stop:
            if stop - field < 3:
                raise RejectedError("field count")
            kind, size = _HEAD.unpack_from(frame, field)
            field += 3
            if field + size > stop:
                raise RejectedError("field count")
            if kind & 0xFFF0 in _VECTORS:
                if size == 12 and not kind & 0x0F:
                    vectors[kind] = _FLOAT32.unpack_from(frame, field)
                else:
                    x, y, z = _numbers(frame[field : field + size], kind & 0x0F, 3)
                    vectors[kind & 0xFFF0] = (x, y, z)
            elif kind == _COUNTER:
                counter = _unsigned(frame[field : field + size], 2)
            elif kind == _TIME:
                t_device_s = _unsigned(frame[field : field + size], 4) / _TICKS_A_SECOND
            elif kind == _STATUS:
                if _unsigned(frame[field : field + size], 4) & _CLIPPED:
                    raise RejectedError("over range")
            elif kind & 0xFFF0 == _TEMPERATURE:
                (temperature_degc,) = _numbers(frame[field : field + size], kind & 0x0F, 1)
                check_imu(_ABSENT, _ABSENT, temperature_degc)
                self._temperature_degc = temperature_degc
            field += size
        return self._samples(vectors, counter, t_device_s, t_s)

    def _samples(
        self, vectors: dict[int, Vector], counter: int | None, t_device_s: float | None, t_s: float
    ) -> list[Sample]:
        gyro_rad_s, accel_m_s2 = vectors.get(_GYRO), vectors.get(_ACCEL)
        if gyro_rad_s is None or accel_m_s2 is None:
            gyro_rad_s = gyro_rad_s or vectors.get(_GYRO_HR)
            accel_m_s2 = accel_m_s2 or vectors.get(_ACCEL_HR)
        check_imu(gyro_rad_s or _ABSENT, accel_m_s2 or _ABSENT, None)
        if gyro_rad_s is None or accel_m_s2 is None:
            raise RejectedError("nothing of use")
        return [ImuSample(t_s, gyro_rad_s, accel_m_s2, self._temperature_degc, counter, t_device_s)]


def _unsigned(data: bytes, size: int) -> int:
    if len(data) != size:
        raise RejectedError("field count")
    return int.from_bytes(data, "big")


def _numbers(data: bytes, number_format: int, count: int) -> list[float]:
    if number_format == 2:
        if len(data) != 6 * count:
            raise RejectedError("field count")
        parts = struct.unpack(">" + "Ih" * count, data)
        return [whole + fraction / 2**32 for fraction, whole in zip(parts[::2], parts[1::2], strict=True)]
    code = {0: "f", 1: "i", 3: "d"}.get(number_format)
    if code is None:
        raise RejectedError("unknown field")
    unpacker = struct.Struct(f">{count}{code}")
    if len(data) != unpacker.size:
        raise RejectedError("field count")
    numbers = unpacker.unpack(data)
    return [number / 2**20 for number in numbers] if code == "i" else list(numbers)


class XsensDialogue(WakeDialogue):
    """Command GoToMeasurement: switch a device from the config state to sending (MT0605P.E, p. 53).

    After power-on a device sends WakeUp. We do not answer it: WakeUpAck would put the device into the config state.
    """

    SAYINGS = ((bytes.fromhex("FAFF1000F1"), "measurement started with GoToMeasurement"),)
