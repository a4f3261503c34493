r"""The project's own line for an IMU behind a microcontroller; defined in docs/imu_line.md.

    $IMU,<seq>,<t_us>,<gx>,<gy>,<gz>,<ax>,<ay>,<az>,<T>*hh\r\n

`seq` counts samples modulo 2^16, `t_us` is the board's clock in microseconds modulo 2^32, rates in rad/s, specific
force in m/s^2, `T` in degrees Celsius or empty; `hh` is the exclusive or of everything between "$" and "*".
"""

from __future__ import annotations

from typing import ClassVar

from companion.protocols.base import (
    CUT_SHORT,
    FIELD_COUNT,
    NOT_A_NUMBER,
    OUT_OF_RANGE,
    TOO_LONG,
    UNKNOWN_SENTENCE,
    Decoder,
    RejectedError,
    body_of_sentence,
)
from companion.protocols.checks import check_imu, numbers
from companion.samples import ImuSample, Sample


class ImuLineDecoder(Decoder):
    r"""Lines of `$IMU`; gives `ImuSample`. A line may end in "\r", "\n" or both; a "$" always begins a new one."""

    LIMIT: ClassVar[int] = 160
    """Bytes of a line from its "$" on; the longest sensible one has some 110."""
    device_clock_wraps_s: ClassVar[float | None] = 2**32 / 1e6
    sequence_modulus: ClassVar[int | None] = 2**16

    def __init__(self, seconds_per_byte: float = 0.0) -> None:
        super().__init__(seconds_per_byte)
        self._partial = b""
        """From the "$" of the line under way; empty outside of a line."""

    def feed(self, data: bytes, t_s: float) -> list[Sample]:  # noqa: D102 - as in the base class
        text = self._partial + data.replace(b"\r", b"\n")
        remaining = len(text)
        *lines, partial = text.split(b"\n")
        samples: list[Sample] = []
        for line in lines:
            remaining -= len(line) + 1
            sentence = self._last_sentence(line)
            if sentence:
                try:
                    samples.append(_decode(sentence[1:], t_s - self.seconds_per_byte * remaining))
                    self.accepted += 1
                    self.frame_bytes = len(sentence) + 1
                except RejectedError as error:
                    self.rejected[error.reason] += 1
        self._partial = self._last_sentence(partial)
        return samples

    def interrupted(self) -> None:  # noqa: D102 - as in the base class
        if self._partial:
            self.rejected[CUT_SHORT] += 1
        self._partial = b""

    def _last_sentence(self, text: bytes) -> bytes:
        """What begins at the last "$" and is not too long yet; everything before it is counted."""
        start = text.find(b"$")
        if start < 0:
            self.skipped += len(text)
            return b""
        self.skipped += start
        while (end := text.find(b"$", start + 1)) >= 0:
            self._too_long_or(CUT_SHORT, end - start)
            start = end
        if len(text) - start > self.LIMIT:
            self._too_long_or("", len(text) - start)
            return b""
        return text[start:]

    def _too_long_or(self, reason: str, length: int) -> None:
        """Count a sentence that ends without a line end; beyond the limit its bytes belong to no frame."""
        self.rejected[TOO_LONG if length > self.LIMIT else reason] += 1
        self.skipped += max(length - self.LIMIT, 0)


def _decode(sentence: bytes, t_s: float) -> ImuSample:
    head, *fields = body_of_sentence(sentence).split(b",")
    if head != b"IMU":
        raise RejectedError(UNKNOWN_SENTENCE)
    if len(fields) != 9:
        raise RejectedError(FIELD_COUNT)
    try:
        sequence, t_us = int(fields[0]), int(fields[1])
    except ValueError:
        raise RejectedError(NOT_A_NUMBER) from None
    if not (0 <= sequence <= 0xFFFF and 0 <= t_us <= 0xFFFFFFFF):
        raise RejectedError(OUT_OF_RANGE)
    temperature_degc: float | None = None
    if fields[8]:
        gx, gy, gz, ax, ay, az, temperature_degc = numbers(fields[2:])
    else:
        gx, gy, gz, ax, ay, az = numbers(fields[2:8])
    gyro_rad_s, accel_m_s2 = (gx, gy, gz), (ax, ay, az)
    check_imu(gyro_rad_s, accel_m_s2, temperature_degc)
    return ImuSample(t_s, gyro_rad_s, accel_m_s2, temperature_degc, sequence, t_us / 1e6)
