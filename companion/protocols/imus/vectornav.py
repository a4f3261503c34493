r"""VectorNav VN-100 and relatives: ASCII and binary asynchronous outputs on one port, in any mixture.

    $VNYMR,yaw,pitch,roll,mag x 3,accel x 3,gyro x 3*hh\r\n            degrees, gauss, m/s^2, rad/s
    $VNIMU,mag x 3,accel x 3,gyro x 3,temperature,pressure*hh\r\n      uncompensated; degrees Celsius, kPa
    0xFA ...                                                           see vectornav_binary

Source: VectorNav UM001. Axes are X forward, Y right, Z down; level and at rest the accelerometer reads z = -9.8.
"""

from __future__ import annotations

import binascii
import re
from typing import ClassVar

from companion.protocols.decoding.base import (
    CHECKSUM,
    CUT_SHORT,
    FIELD_COUNT,
    REPLY,
    TOO_LONG,
    UNKNOWN_SENTENCE,
    RejectedError,
    body_of_sentence,
)
from companion.protocols.decoding.checks import check_attitude, check_imu, numbers
from companion.protocols.decoding.framing import WAIT, FrameDecoder
from companion.protocols.imus.vectornav_binary import Layout, header_bytes, layout_of
from companion.samples import AttitudeSample, ImuSample, MagSample, Sample

SENTENCE_LIMIT = 250
"""Bytes of a sentence after its "$"; the longest asynchronous one has some 200."""
LAYOUTS_KEPT = 16

_SYNC = 0xFA
_DOLLAR = ord("$")
_START = re.compile(rb"[\xfa$]")
_END_OF_TEXT = re.compile(rb"[^ -#%-~]")
"""The first byte that cannot be inside a sentence: a line end, a "$", or nothing printable."""
_TEXT = bytes(set(range(0x20, 0x7F)) - {_DOLLAR})
"""All others."""

_REPLIES = frozenset((b"VNRRG", b"VNWRG", b"VNWNV", b"VNRFS", b"VNRST", b"VNTAR", b"VNASY", b"VNSGB", b"VNCMD"))


class VectorNavDecoder(FrameDecoder):
    """VectorNav outputs; gives `ImuSample`, `AttitudeSample` and `MagSample` as far as a frame has them."""

    device_clock_wraps_s: ClassVar[float | None] = 2**64 / 1e9

    def __init__(self, seconds_per_byte: float = 0.0) -> None:
        super().__init__(seconds_per_byte)
        self._layouts: dict[bytes, Layout] = {}
        self._header = b""
        """Of the last good frame: the next one most likely has it too."""

    def _next(self, buffer: bytes, at: int, origin: int, samples: list[Sample]) -> int:
        if buffer[at] == _SYNC:
            return self._binary(buffer, at, origin, samples)
        if buffer[at] == _DOLLAR:
            return self._sentence(buffer, at, origin, samples)
        match = _START.search(buffer, at)
        end = match.start() if match else len(buffer)
        self.skipped += len(buffer[at:end].translate(None, b"\r\n"))
        return end

    def _binary(self, buffer: bytes, at: int, origin: int, samples: list[Sample]) -> int:
        """Where to go on after what begins with a sync byte, or `WAIT` for more bytes."""
        available, header = len(buffer) - at, self._header
        layout = self._layouts.get(header) if header and buffer.startswith(header, at) else None
        if layout is None:
            if available < 2:
                return WAIT
            try:
                header_size = header_bytes(buffer[at + 1])
                if available < header_size:
                    return WAIT
                header = buffer[at : at + header_size]
                layout = self._layouts.get(header) or layout_of(header)
            except RejectedError as error:
                self.rejected[error.reason] += 1
                return at + 1
        if available < layout.frame_bytes:
            return WAIT
        end = at + layout.frame_bytes
        if binascii.crc_hqx(buffer[at + 1 : end], 0) != 0:
            self.rejected[CHECKSUM] += 1
            return at + 1  # not `end`: in what a false start took for its own, a good frame may begin
        if header not in self._layouts:
            if len(self._layouts) >= LAYOUTS_KEPT:
                self._layouts.clear()
            self._layouts[header] = layout
        self._header = header
        try:
            samples += layout.samples(buffer, at, self._time_of(origin + end))
            self.accepted += 1
        except RejectedError as error:
            self.rejected[error.reason] += 1
        return end

    def _sentence(self, buffer: bytes, at: int, origin: int, samples: list[Sample]) -> int:
        """Where to go on after what begins with a "$", or `WAIT` for more bytes."""
        begin = buffer[at : at + 3]
        if not b"$VN".startswith(begin):
            self.skipped += 1
            return at + 1
        limit = at + 1 + SENTENCE_LIMIT
        end = buffer.find(b"\r", at + 1, limit)
        # Deleting all that may be in a sentence is quicker than looking for what may not; it is nearly always whole.
        if end < 0 or buffer[at + 1 : end].translate(None, _TEXT):
            match = _END_OF_TEXT.search(buffer, at + 1, limit)
            if match is None:
                if len(buffer) < limit:
                    return WAIT
                self.rejected[TOO_LONG] += 1
                return at + 1
            end = match.start()
            if buffer[end] not in b"\r\n":
                self.rejected[CUT_SHORT] += 1
                return end
        try:
            samples += _decode(buffer[at:end], self._time_of(origin + end + 1))
            self.accepted += 1
        except RejectedError as error:
            self.rejected[error.reason] += 1
        return end


def _decode(sentence: bytes, t_s: float) -> list[Sample]:
    """The samples in one sentence, `$VN...*hh`.

    Raises:
        RejectedError: wrong checksum, not a measurement that is used here, or values that cannot be.
    """
    fields = body_of_sentence(sentence).split(b",")
    head = fields[0]
    if head == b"VNYMR":
        return _decode_ymr(fields, t_s)
    if head == b"VNIMU":
        return _decode_imu(fields, t_s)
    if head == b"VNERR":
        raise RejectedError("VNERR")
    raise RejectedError(REPLY if head in _REPLIES else UNKNOWN_SENTENCE)


def _decode_ymr(fields: list[bytes], t_s: float) -> list[Sample]:
    if len(fields) != 13:
        raise RejectedError(FIELD_COUNT)
    yaw_deg, pitch_deg, roll_deg, mx, my, mz, ax, ay, az, gx, gy, gz = numbers(fields[1:])
    gyro_rad_s, accel_m_s2, field_gauss = (gx, gy, gz), (ax, ay, az), (mx, my, mz)
    check_attitude(yaw_deg, pitch_deg, roll_deg)
    check_imu(gyro_rad_s, accel_m_s2, None)
    return [
        ImuSample(t_s, gyro_rad_s, accel_m_s2),
        AttitudeSample(t_s, yaw_deg, pitch_deg, roll_deg),
        MagSample(t_s, field_gauss),
    ]


def _decode_imu(fields: list[bytes], t_s: float) -> list[Sample]:
    if len(fields) != 12:
        raise RejectedError(FIELD_COUNT)
    mx, my, mz, ax, ay, az, gx, gy, gz, temperature_degc, _pressure_kpa = numbers(fields[1:])
    gyro_rad_s, accel_m_s2 = (gx, gy, gz), (ax, ay, az)
    check_imu(gyro_rad_s, accel_m_s2, temperature_degc)
    return [ImuSample(t_s, gyro_rad_s, accel_m_s2, temperature_degc), MagSample(t_s, (mx, my, mz))]
