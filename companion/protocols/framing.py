"""What decoders of binary frames share: the buffer, the times of its bytes, and going on after a false start.

A frame that is not one costs only its first byte: in what it took for its own, a good frame may begin.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from companion.protocols.base import CUT_SHORT, Decoder
from companion.samples import Sample

if TYPE_CHECKING:
    from companion.protocols.bulk import Frames, ImuBlock

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
                # Where it took several, they were alike.
                self.frame_bytes = (end - at) // (self.accepted - accepted)
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

    def receive_many(self, reads: Sequence[bytes], read_s: Sequence[float]) -> ImuBlock | None:  # noqa: D102
        buffer = b"".join((self._buffer, *reads))
        frames = self._frames(buffer)
        if frames is None or not all(reads):
            return None
        import numpy as np

        from companion.protocols.bulk import ImuBlock

        lengths = np.fromiter(map(len, reads), np.int64, len(reads))
        read_at_s = np.array(read_s)
        ahead_s = self._line_after(lengths, read_at_s) if self.seconds_per_byte else self._ahead_s
        if ahead_s is None:
            return None
        # Where in the stream every frame and every read ends.
        first = self._received - len(self._buffer)
        ends = first + frames.frame_bytes * np.arange(1, len(frames.rows) + 1)
        before = len(self._chunks)
        chunk_ends = np.concatenate(([end for end, _ in self._chunks], self._received + np.cumsum(lengths))).astype(int)
        chunk_s = np.concatenate(([t_s for _, t_s in self._chunks], read_at_s))
        # Nearly always every read was one frame.
        chunk = np.arange(len(ends)) if np.array_equal(chunk_ends, ends) else np.searchsorted(chunk_ends, ends)
        came_s = chunk_s[chunk] - self.seconds_per_byte * (chunk_ends[chunk] - ends)
        arrival_s = came_s - frames.frame_bytes * self.seconds_per_byte
        times = self.times.place_many(arrival_s, chunk_s[chunk], frames.device_s)
        if times is None:
            return None
        consumed = int(ends[-1])
        self._received = int(chunk_ends[-1])
        self._buffer = buffer[consumed - first :]
        left = int(np.searchsorted(chunk_ends, consumed, side="right"))
        self._chunks = deque(zip(chunk_ends[left:].tolist(), chunk_s[left:].tolist(), strict=True))
        if self.seconds_per_byte:
            self._ahead_s, self._read_s = ahead_s, read_s[-1]
        self.accepted += len(ends)
        self.frame_bytes = frames.frame_bytes
        self._took(frames)
        return ImuBlock(
            t_s=times.t_s,
            rows=frames.rows,
            temperature_degc=frames.temperature_degc,
            stamps=times.device_s,
            breaks=self.times.clock.breaks,
            reads=np.maximum(chunk - before, 0),
        )

    def _frames(self, buffer: bytes) -> Frames | None:
        """What is in a buffer that holds nothing but whole good frames of one kind, each with one reading of an IMU.

        The last may be cut. None where that is not so, or nobody knows how to tell; nothing is changed.
        """
        del buffer
        return None

    def _took(self, frames: Frames) -> None:
        """What `_frames` found has been taken."""

    @abstractmethod
    def _next(self, buffer: bytes, at: int, origin: int, samples: list[Sample]) -> int:
        """Read what begins at `at`, of which `origin` is the buffer's place in the stream.

        Returns where to go on, always further on, or `WAIT`. How much of it has arrived must not change the outcome.
        Several frames of one length may be taken at once where all of them are accepted.
        """

    def _skip_to(self, start: bytes, buffer: bytes, at: int) -> int:
        """Pass over what cannot begin a frame."""
        found = buffer.find(start, at)
        end = len(buffer) if found < 0 else found
        self.skipped += end - at
        return end

    def _reject(self, reason: str, end: int) -> int:
        self.rejected[reason] += 1
        return end

    def _time_of(self, end: int) -> float:
        """When the byte before stream position `end` was on the line."""
        chunks = self._chunks
        while chunks[0][0] < end:
            chunks.popleft()
        chunk_end, t_s = chunks[0]
        return t_s - self.seconds_per_byte * (chunk_end - end)
