"""What all decoders share: counting, line framing, and the words for why something was rejected.

A decoder is fed bytes as they come, in any split, and gives samples; it never raises for what it is fed. How the
bytes were split changes neither the samples nor the counts. Whatever waits for its end is bounded.
"""

from __future__ import annotations

import binascii
from abc import ABC, abstractmethod
from collections import Counter
from typing import ClassVar

from companion.protocols.clock import SampleTimes
from companion.samples import Sample

AHEAD_S = 0.5
"""So far ahead of its line no stream gets: a baud rate then means nothing on that port (USB without a UART)."""
_STALL_S = 10.0
"""So long what came may have waited unread."""

CALIBRATING = "calibrating"
CHECKSUM = "checksum"
COMMAND_REFUSED = "command refused"
CUT_SHORT = "cut short"
FIELD_COUNT = "field count"
LINE_END = "line end"
NO_CHECKSUM = "no checksum"
NON_FINITE = "non-finite"
NOT_A_MEASUREMENT = "not a measurement"
NOT_A_NUMBER = "not a number"
NOTHING_OF_USE = "nothing of use"
ORPHAN = "orphan"
OUT_OF_RANGE = "out of range"
OVER_RANGE = "over range"
PARITY = "parity"
REPLY = "reply"
SHAPE_CHANGED = "shape changed"
SINGLE_AXIS = "single axis"
TOO_LONG = "too long"
UNKNOWN_FIELD = "unknown field"
UNKNOWN_GROUP = "unknown group"
UNKNOWN_SENTENCE = "unknown sentence"


class RejectedError(Exception):
    """A frame cannot be used; its one argument is the reason to count. Never leaves this room."""

    @property
    def reason(self) -> str:
        """Which counter of `Decoder.rejected` it belongs to."""
        return str(self.args[0])


class Decoder(ABC):
    """Bytes of one device to samples.

    Args:
        seconds_per_byte: line time of one byte; 0 where unknown (sockets, USB), which leaves the time of the read.
    """

    device_clock_wraps_s: ClassVar[float | None] = None
    """`ImuSample.t_device_s` starts again at 0 after so long; None where the device has no clock, or it never does."""
    sequence_modulus: ClassVar[int | None] = None
    """`ImuSample.sequence` counts modulo this; None where there is none, or it never wraps."""

    def __init__(self, seconds_per_byte: float = 0.0) -> None:
        self.seconds_per_byte = seconds_per_byte
        self.times = SampleTimes(self.device_clock_wraps_s, self.sequence_modulus)
        self.frame_bytes = 0
        """Of the latest frame that gave samples; 0 where the decoder does not tell."""
        self._read_s: float | None = None
        self._ahead_s = 0.0
        self.accepted = 0
        """Frames that gave samples."""
        self.rejected: Counter[str] = Counter()
        """Frames, or what began like one, that gave none, by reason."""
        self.warned: Counter[str] = Counter()
        """Frames that gave samples and said something against them, by what they said."""
        self.skipped = 0
        """Bytes passed over that did not look like part of any frame; many of them mean a wrong baud or protocol."""

    def receive(self, data: bytes, t_s: float) -> list[Sample]:
        """Take the next bytes, read at `t_s` on the host's clock; return the samples that they complete.

        A sample's time is when it was taken, as well as can be told; a counter and a device clock are unwrapped. A
        sample whose time cannot be told is counted in `times.dropped`.
        """
        samples = self.feed(data, t_s)
        if self.seconds_per_byte:
            self._check_line(len(data), t_s)
        return self.times.place(samples, t_s, self.frame_bytes * self.seconds_per_byte) if samples else samples

    def _check_line(self, received: int, t_s: float) -> None:
        """Find out whether bytes come faster than the line could carry them: then its line time means nothing."""
        if self._read_s is not None:
            self._ahead_s += received * self.seconds_per_byte - (t_s - self._read_s)
            self._ahead_s = max(self._ahead_s, -_STALL_S)
            if self._ahead_s > AHEAD_S:
                self.seconds_per_byte = 0.0
                self.times.clock.remap()
        self._read_s = t_s

    @abstractmethod
    def feed(self, data: bytes, t_s: float) -> list[Sample]:
        """Take the next bytes, read at `t_s` on the host's clock; return the samples that they complete, as they came.

        A sample's time is that of its frame's last byte: `t_s` less the line time of what came after it.
        """

    @abstractmethod
    def interrupted(self) -> None:
        """Bytes are missing before the next ones (the port was opened again): forget the frame under way."""


class LineDecoder(Decoder):
    r"""Frames a protocol of lines that end in "\n"; a subclass reads one line at a time.

    A line longer than `LIMIT` is given as its last `LIMIT` bytes and marked as cut, so that noise without any line
    end costs no memory.
    """

    LIMIT: ClassVar[int] = 80

    def __init__(self, seconds_per_byte: float = 0.0) -> None:
        super().__init__(seconds_per_byte)
        self._partial = b""
        self._cut = False

    def feed(self, data: bytes, t_s: float) -> list[Sample]:  # noqa: D102 - as in the base class
        text = self._partial + data
        remaining = len(text)
        *lines, partial = text.split(b"\n")
        samples: list[Sample] = []
        for line in lines:
            remaining -= len(line) + 1
            cut = self._cut or len(line) > self.LIMIT
            self._cut = False
            try:
                sample = self._line(line[-self.LIMIT :], t_s - self.seconds_per_byte * remaining, cut=cut)
            except RejectedError as error:
                self.rejected[error.reason] += 1
            else:
                if sample is not None:
                    self.accepted += 1
                    self.frame_bytes = self._frame_bytes(line)
                    samples.append(sample)
        if len(partial) > self.LIMIT:
            partial, self._cut = partial[-self.LIMIT :], True
        self._partial = partial
        return samples

    def interrupted(self) -> None:  # noqa: D102 - as in the base class
        if self._partial:
            self.rejected[CUT_SHORT] += 1
        self._partial, self._cut = b"", False

    def _frame_bytes(self, line: bytes) -> int:
        """Bytes of the frame that ends with this line."""
        return len(line) + 1

    @abstractmethod
    def _line(self, line: bytes, t_s: float, *, cut: bool) -> Sample | None:
        r"""Read one line, without its "\n"; None where it is whole and right but (yet) gives no sample.

        Raises:
            RejectedError: the line is to be counted as rejected.
        """


def xor_checksum(body: bytes) -> int:
    """The checksum of NMEA 0183 and of its imitators: all bytes between "$" and "*" exclusive-ored."""
    folded = int.from_bytes(body, "little")
    # Fold halves onto each other: some 0.5 us for a line, a tenth of a loop over its bytes.
    shift = 8
    while shift * 2 < len(body) * 8:
        shift *= 2
    while shift >= 8:
        folded ^= folded >> shift
        shift //= 2
    return folded & 0xFF


def body_of_sentence(sentence: bytes) -> bytes:
    """Check what stands between "$" and the line end, `body*hh`, and return the body.

    Four hexadecimal digits are a CRC-16/XMODEM instead, as VectorNav devices may be set to send (UM001, 3.8).

    Raises:
        RejectedError: there is no checksum, or it is wrong.
    """
    body, _, digits = sentence.rpartition(b"*")
    try:
        expected = binascii.unhexlify(digits)
    except ValueError:
        raise RejectedError(NO_CHECKSUM) from None
    if len(expected) == 1:
        computed = xor_checksum(body)
    elif len(expected) == 2:
        computed = binascii.crc_hqx(body, 0)
    else:
        raise RejectedError(NO_CHECKSUM)
    if computed != int.from_bytes(expected, "big"):
        raise RejectedError(CHECKSUM)
    return body
