"""Base classes of decoders: framing of lines, sentences and binary frames, counters, and checks.

A decoder never raises, whatever its input. Samples and counts do not depend on how the stream is split into reads. The
buffer of an unfinished frame is bounded. Of a false frame only the first byte is skipped: a good one may begin inside.
"""

from __future__ import annotations

import binascii
import functools
import math
import operator
import re
from abc import ABC, abstractmethod
from collections import Counter, deque
from typing import ClassVar, Final

from companion.protocols.decoding.clock import SampleTimes
from companion.samples import Sample, Vector

AHEAD_S = 0.5
"""If bytes come more than this time, s, before the baud rate permits, the port has no UART (USB): line time is 0."""
_STALL_S = 10.0

NO_FRAME: Final = 0
WAIT: Final = -1
ECHO: Final = "echo of a command"  # own command, or one of another master, on a line shared by both directions


class RejectedError(Exception):
    """Error of an unusable frame. Decoders always catch this error and count its text in `Decoder.rejected`."""


class Decoder(ABC):
    """Finds frames in the bytes of one device; a subclass checks and decodes each frame.

    `seconds_per_byte` is the line time of one byte, 0 if unknown (sockets, USB). `ImuSample.t_device_s` wraps to 0
    after `device_clock_wraps_s`, `ImuSample.sequence` after `sequence_modulus`. None: the protocol has no such value,
    or it never wraps.
    """

    START: ClassVar[re.Pattern[bytes]]  # The bytes that may begin a frame
    device_clock_wraps_s: ClassVar[float | None] = None
    clock_from_start: ClassVar[bool] = False  # `ImuSample.t_device_s` counts from the device's start
    sequence_modulus: ClassVar[int | None] = None

    def __init__(self, seconds_per_byte: float = 0.0) -> None:
        self.seconds_per_byte = seconds_per_byte
        self.times = SampleTimes(self.device_clock_wraps_s, self.sequence_modulus)
        self.frame_bytes = self._earlier_bytes = 0
        """Bytes of the latest reading's frames; `_earlier_bytes`: those received before the reading's last frame."""
        self._read_s: float | None = None
        self._ahead_s = 0.0
        self.accepted = 0
        self.rejected: Counter[str] = Counter()
        self.warned: Counter[str] = Counter()
        self._buffer = b""  # bytes of a possible frame; never longer than the longest frame
        self._received = self._origin = 0  # stream positions of the last byte and of the buffer
        self._chunks: deque[tuple[int, float]] = deque()
        """Reads of which bytes are still in the buffer: stream position of the last byte read, and time of the read."""

    def receive(self, data: bytes, t_s: float) -> list[Sample]:
        samples = self.feed(data, t_s)
        if self.seconds_per_byte:
            self._check_line(len(data), t_s)
        return self.times.place(samples, t_s, self.frame_bytes * self.seconds_per_byte) if samples else samples

    def _check_line(self, received: int, t_s: float) -> None:
        """Set the line time to 0 once bytes come faster than the line could carry them."""
        if self._read_s is not None:
            self._ahead_s += received * self.seconds_per_byte - (t_s - self._read_s)
            self._ahead_s = max(self._ahead_s, -_STALL_S)
            if self._ahead_s > AHEAD_S:
                self.seconds_per_byte = 0.0
                self.times.clock.remap()
        self._read_s = t_s

    def feed(self, data: bytes, t_s: float) -> list[Sample]:
        """Decode bytes read at `t_s` on the host's clock. The time of a sample is that of its frame's last byte."""
        if not data:
            return []
        self._received += len(data)
        self._chunks.append((self._received, t_s))
        buffer = self._buffer + data if self._buffer else bytes(data)
        self._origin = self._received - len(buffer)
        samples: list[Sample] = []
        at, find = 0, self.START.search
        while match := find(buffer, at):
            at = match.start()
            size = self._take(buffer, at, samples)
            if size == WAIT:
                break
            at += size
        else:
            at = len(buffer)
        self._buffer = buffer[at:]
        while self._chunks and self._chunks[0][0] <= self._origin + at:
            self._chunks.popleft()
        return samples

    def interrupted(self) -> None:
        if self._buffer:
            self.rejected["cut short"] += 1
        self._buffer = b""
        self._chunks.clear()

    def _take(self, buffer: bytes, at: int, samples: list[Sample]) -> int:
        """Append the samples of a frame that begins at `buffer[at]`; return the number of bytes to skip, or `WAIT`."""
        try:
            size = self._size(buffer, at)
            if size <= 0:  # NO_FRAME or WAIT
                return size or 1
            end = at + size
            if end > len(buffer):
                return WAIT
            frame = buffer[at:end]
            self._check(frame)
        except IndexError:
            return WAIT
        except RejectedError as error:
            self.rejected[str(error)] += 1
            return 1
        try:
            found = self._decode(frame, self._time_of(self._origin + end))
        except RejectedError as error:
            self.rejected[str(error)] += 1
            return size
        if found:
            samples += found
            self.accepted += 1
            self.frame_bytes = self._earlier_bytes + size
        return size

    @abstractmethod
    def _size(self, buffer: bytes, at: int) -> int:
        """Return the length of the frame at `buffer[at]`, `NO_FRAME` for none, or `WAIT` if more bytes are needed.

        IndexError means `WAIT` too; RejectedError counts the frame and skips only its first byte.
        """

    def _check(self, frame: bytes) -> None:  # noqa: B027 - lines and sentences are checked as they are read
        """Check a whole frame; raise RejectedError to count it and skip only its first byte."""

    @abstractmethod
    def _decode(self, frame: bytes, t_s: float) -> list[Sample]:
        """Decode a whole frame; raise RejectedError to count it as a frame without a sample."""

    def _time_of(self, end: int) -> float:
        chunks = self._chunks
        while chunks[0][0] < end:
            chunks.popleft()
        chunk_end, t_s = chunks[0]
        return t_s - self.seconds_per_byte * (chunk_end - end)


def xor_checksum(body: bytes) -> int:
    return functools.reduce(operator.xor, body, 0)


def body_of_sentence(sentence: bytes) -> bytes:
    """Check `$body*hh` or VectorNav's `$body*hhhh` (CRC-16/XMODEM, UM001 3.8); return `body` or raise RejectedError."""
    body, _, digits = sentence[1:].rpartition(b"*")
    if len(digits) not in (2, 4) or sentence[-1 - len(digits)] != ord("*"):
        raise RejectedError("no checksum")
    try:
        expected = int.from_bytes(binascii.unhexlify(digits))
    except ValueError:
        raise RejectedError("no checksum") from None
    if (xor_checksum(body) if len(digits) == 2 else binascii.crc_hqx(body, 0)) != expected:
        raise RejectedError("checksum")
    return body


GYRO_LIMIT_RAD_S = 100.0  # 5730 deg/s; the widest ranges sold are 4000 deg/s
ACCEL_LIMIT_M_S2 = 2000.0  # 204 g; the widest range of a part with a gyro in it is 200 g
TEMPERATURE_LIMIT_DEGC = 200.0
ANY_TEMPERATURE = 800.0
"""Largest IMU temperature in any unit (degC, kelvin, 0.1 degC); `estimation/collector/intake.py` finds wrong units."""


def check_imu(gyro_rad_s: Vector, accel_m_s2: Vector, temperature_degc: float | None) -> None:
    """Raise RejectedError if a value of an IMU is not finite or beyond the range of any IMU."""
    temperature = temperature_degc or 0.0
    if not math.isfinite(sum(gyro_rad_s) + sum(accel_m_s2) + temperature):
        raise RejectedError("non-finite")
    rate, force = max(map(abs, gyro_rad_s)), max(map(abs, accel_m_s2))
    if rate > GYRO_LIMIT_RAD_S or force > ACCEL_LIMIT_M_S2 or abs(temperature) > ANY_TEMPERATURE:
        raise RejectedError("out of range")


DAMAGED: Final = re.compile(rb"[\x00\x80-\xff]")
"""Bytes that text never contains; they mean that the parity or the baud rate is wrong."""


def out_of_range(value: float) -> RejectedError:
    return RejectedError("out of range" if math.isfinite(value) else "non-finite")


def full_circle(heading_deg: float) -> float:
    """Return the heading, but 0 for 360 deg (359.96 rounded); raise RejectedError outside 0 to 360 deg."""
    if heading_deg == 360.0:
        return 0.0
    if not 0.0 <= heading_deg < 360.0:
        raise out_of_range(heading_deg)
    return heading_deg


def check_vector(vector: Vector) -> None:
    if not math.isfinite(sum(vector)):
        raise RejectedError("non-finite")


class LineDecoder(Decoder):
    r"""Decoder of lines that end in "\n". Only the last `LIMIT` bytes of a longer line are decoded, with `cut` set."""

    START = re.compile(rb".", re.DOTALL)
    LIMIT: ClassVar[int] = 80
    _cut = False

    def interrupted(self) -> None:
        super().interrupted()
        self._cut = False

    def _take(self, buffer: bytes, at: int, samples: list[Sample]) -> int:
        end = buffer.find(b"\n", at)
        excess = (end if end >= 0 else len(buffer)) - at - self.LIMIT
        if excess > 0:
            self._cut = True
            return excess
        return super()._take(buffer, at, samples)

    def _size(self, buffer: bytes, at: int) -> int:
        end = buffer.find(b"\n", at)
        return WAIT if end < 0 else end + 1 - at

    def _decode(self, frame: bytes, t_s: float) -> list[Sample]:
        cut, self._cut = self._cut, False
        sample = self._line(frame[:-1], t_s, cut=cut)
        return [] if sample is None else [sample]

    @abstractmethod
    def _line(self, line: bytes, t_s: float, *, cut: bool) -> Sample | None:
        r"""Decode a line without "\n" (`cut`: nor its beginning); None: valid, no sample yet. Raises RejectedError."""


class SentenceDecoder(Decoder):
    r"""Decoder of sentences `$...` that end in "\r" or "\n"; an earlier "$" means that the sentence is cut short."""

    START = re.compile(rb"\$")
    END: ClassVar[re.Pattern[bytes]] = re.compile(rb"[\r\n$]")
    LIMIT: ClassVar[int] = 160  # most bytes of a sentence between the "$" and the line end

    def _size(self, buffer: bytes, at: int) -> int:
        limit = at + 1 + self.LIMIT
        match = self.END.search(buffer, at + 1, limit)
        if match is None:
            if len(buffer) < limit:
                return WAIT
            raise RejectedError("too long")
        if match[0] not in b"\r\n":
            raise RejectedError("cut short")
        return match.end() - at

    def _decode(self, frame: bytes, t_s: float) -> list[Sample]:
        try:
            return self._read(body_of_sentence(frame[:-1]), t_s)
        except ValueError:
            raise RejectedError("not a number") from None

    @abstractmethod
    def _read(self, body: bytes, t_s: float) -> list[Sample]:
        """Decode a body whose checksum is right; RejectedError or ValueError count it as a frame without a sample."""
