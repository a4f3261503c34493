"""What decoders of binary frames share: the buffer, the times of its bytes, and going on after a false start.

A frame that is not one costs only its first byte: in what it took for its own, a good frame may begin.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Callable
from typing import Final

from companion.protocols.decoding import reasons
from companion.protocols.decoding.base import Decoder, RejectedError
from companion.samples import Sample

WAIT: Final = -1
"""More bytes are needed to tell."""
ECHO: Final = "echo of a command"
"""Our own words, or another master's, on a line that both sides hear."""


class FrameDecoder(Decoder):
    """Takes frames one by one from a stream of bytes; a subclass says where each one ends."""

    def __init__(self, seconds_per_byte: float = 0.0) -> None:
        super().__init__(seconds_per_byte)
        self._buffer = b""
        """What may be the beginning of a frame; never longer than the longest frame."""
        self._received = 0
        self._chunks: deque[tuple[int, float]] = deque()
        """Stream position of the end of each chunk that still has bytes in the buffer, and when it was read."""

    def feed(self, data: bytes, t_s: float) -> list[Sample]:  # noqa: D102 - as in the base class
        if not data:
            return []
        self._received += len(data)
        self._chunks.append((self._received, t_s))
        buffer = self._buffer + data if self._buffer else bytes(data)
        origin = self._received - len(buffer)
        samples: list[Sample] = []
        at, size = 0, len(buffer)
        while at < size:
            accepted = self.accepted
            end = self._next(buffer, at, origin, samples)
            if end == WAIT:
                break
            if self.accepted != accepted:
                self.frame_bytes = end - at
            at = end
        self._buffer = buffer[at:]
        while self._chunks and self._chunks[0][0] <= origin + at:
            self._chunks.popleft()
        return samples

    def interrupted(self) -> None:  # noqa: D102 - as in the base class
        if self._buffer:
            self.rejected[reasons.CUT_SHORT] += 1
        self._buffer = b""
        self._chunks.clear()

    @abstractmethod
    def _next(self, buffer: bytes, at: int, origin: int, samples: list[Sample]) -> int:
        """Read what begins at `at`, of which `origin` is the buffer's place in the stream.

        Returns where to go on, always further on, or `WAIT`. How much of it has arrived must not change the outcome.
        """

    def _skip_to(self, start: bytes, buffer: bytes, at: int) -> int:
        """Pass over what cannot begin a frame."""
        found = buffer.find(start, at)
        return len(buffer) if found < 0 else found

    def _find_mark(self, mark: bytes, buffer: bytes, at: int) -> int:
        """Where to go on when no mark of two bytes stands at `at`: `WAIT` where its second byte has not come yet."""
        if buffer[at] != mark[0]:
            return self._skip_to(mark[:1], buffer, at)
        if len(buffer) == at + 1:
            return WAIT
        return at + 1

    def _reject(self, reason: str, end: int) -> int:
        self.rejected[reason] += 1
        return end

    def _accept(self, samples: list[Sample], found: Callable[..., list[Sample]], *arguments: object, end: int) -> int:
        """Take in what `found(*arguments)` reads in a whole frame, which may reject it, and go on at `end`."""
        try:
            samples += found(*arguments)
            self.accepted += 1
        except RejectedError as error:
            self.rejected[error.reason] += 1
        return end

    def _time_of(self, end: int) -> float:
        """When the byte before stream position `end` was on the line."""
        chunks = self._chunks
        while chunks[0][0] < end:
            chunks.popleft()
        chunk_end, t_s = chunks[0]
        return t_s - self.seconds_per_byte * (chunk_end - end)
