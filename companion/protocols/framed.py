"""What the decoders of binary frames share: bytes that wait for the rest of their frame, and when they were read."""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from typing import Final

from companion.protocols.base import CUT_SHORT, Decoder
from companion.samples import Sample

WAIT: Final = -1
"""In place of a position: what begins there may be a frame, but more bytes are needed to tell."""


class FramedDecoder(Decoder):
    """Frames that begin with a mark and know their length; a subclass reads what begins at one position.

    A subclass bounds what waits: it must not answer `WAIT` for more bytes than its longest frame has.
    """

    def __init__(self, seconds_per_byte: float = 0.0) -> None:
        super().__init__(seconds_per_byte)
        self._buffer = b""
        """What may be the beginning of a frame; never longer than the longest frame."""
        self._received = 0
        self._chunks: deque[tuple[int, float]] = deque()
        """Stream position of the end of each chunk that still has bytes in the buffer, and when it was read.

        A false start holds back what came behind it until it is found out; the times of that must not suffer.
        """

    def feed(self, data: bytes, t_s: float) -> list[Sample]:  # noqa: D102 - as in the base class
        if not data:
            return []
        self._received += len(data)
        self._chunks.append((self._received, t_s))
        buffer = self._buffer + data
        origin = self._received - len(buffer)
        samples: list[Sample] = []
        at, size = 0, len(buffer)
        while at < size:
            end = self._take(buffer, at, origin, samples)
            if end == WAIT:
                break
            at = end
        self._buffer = buffer[at:]
        while self._chunks and self._chunks[0][0] <= origin + at:
            self._chunks.popleft()
        return samples

    def interrupted(self) -> None:  # noqa: D102 - as in the base class
        if self._buffer:
            self.rejected[CUT_SHORT] += 1
        self._buffer = b""
        self._chunks.clear()

    @abstractmethod
    def _take(self, buffer: bytes, at: int, origin: int, samples: list[Sample]) -> int:
        """Read what begins at `at`: a frame, or bytes to pass over; add its samples.

        Args:
            buffer: all that waits.
            at: where to begin in it.
            origin: stream position of the buffer's first byte; `_time_of(origin + end)` dates a frame.
            samples: where the samples go.

        Returns:
            Where to go on, or `WAIT`.
        """

    def _time_of(self, end: int) -> float:
        """When the byte before stream position `end` was on the line."""
        while self._chunks[0][0] < end:
            self._chunks.popleft()
        chunk_end, t_s = self._chunks[0]
        return t_s - self.seconds_per_byte * (chunk_end - end)

    def _pass_over(self, buffer: bytes, at: int, mark: bytes) -> int:
        """Where the next mark of two bytes begins, or might; what stands before it is counted as skipped."""
        end = buffer.find(mark, at)
        if end < 0:
            end = len(buffer) - buffer.endswith(mark[:1])
        self.skipped += end - at
        return end if end > at else WAIT
