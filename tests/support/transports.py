"""Ways in which the same bytes may arrive: whole, byte by byte, damaged, late; all seeded.

Each takes the frames that a device sends, at its line rate, and yields chunks `(data, t_s)` as a port would.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator
from typing import Protocol

SECONDS_PER_BYTE = 10 / 115200
START_S = 1000.0


class Transport(Protocol):
    """Carries frames; `harmless` when every byte arrives."""

    harmless: bool

    def carry(self, frames: Iterable[bytes]) -> Iterator[tuple[bytes, float]]: ...


class Plain:
    """A chunk a frame, read the moment its last byte is there."""

    harmless = True

    def carry(self, frames: Iterable[bytes]) -> Iterator[tuple[bytes, float]]:
        sent = 0
        for frame in frames:
            sent += len(frame)
            yield frame, START_S + sent * SECONDS_PER_BYTE


class OneByteAtATime:
    """Delivers single bytes, as a slow port on a fast computer."""

    harmless = True

    def carry(self, frames: Iterable[bytes]) -> Iterator[tuple[bytes, float]]:
        for sent, byte in enumerate(b"".join(frames), start=1):
            yield bytes([byte]), START_S + sent * SECONDS_PER_BYTE


class LossAndCorruption:
    """Loses and damages single bytes, each with its probability."""

    harmless = False

    def __init__(self, seed: int = 1, loss: float = 0.01, corruption: float = 0.01) -> None:
        self._random = random.Random(seed)
        self._loss, self._corruption = loss, corruption

    def carry(self, frames: Iterable[bytes]) -> Iterator[tuple[bytes, float]]:
        sent = 0
        for frame in frames:
            sent += len(frame)
            damaged = bytearray()
            for byte in frame:
                fate = self._random.random()
                if fate < self._loss:
                    continue
                damaged.append(self._random.randrange(256) if fate < self._loss + self._corruption else byte)
            yield bytes(damaged), START_S + sent * SECONDS_PER_BYTE


class Delays:
    """The line runs on while nobody reads: chunks of any length, each read when its last byte has just arrived."""

    harmless = True

    def __init__(self, seed: int = 2, longest: int = 700) -> None:
        self._random = random.Random(seed)
        self._longest = longest

    def carry(self, frames: Iterable[bytes]) -> Iterator[tuple[bytes, float]]:
        stream = b"".join(frames)
        at = 0
        while at < len(stream):
            end = min(at + self._random.randint(1, self._longest), len(stream))
            yield stream[at:end], START_S + end * SECONDS_PER_BYTE
            at = end


TRANSPORTS: tuple[type[Plain | OneByteAtATime | LossAndCorruption | Delays], ...] = (
    Plain,
    OneByteAtATime,
    LossAndCorruption,
    Delays,
)
