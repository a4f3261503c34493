"""What a receiver makes of a serial line that it reads at another speed or with another parity than it was sent.

The line is a function of time: idle high, a low start bit, eight data bits with the least significant first, a parity
bit if any, a high stop bit. The receiver samples each bit in its middle, as a UART does, from the falling edge that
begins a frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

Parity = Literal["none", "even", "odd"]
DATA_BITS = 8


class Received(NamedTuple):
    """One frame as the receiver saw it."""

    byte: int
    framing_error: bool
    """The bit in the place of the stop bit was low."""
    parity_error: bool


@dataclass(frozen=True)
class Setting:
    """How one end of the line is set: 8 data bits and one stop bit always."""

    baud: int
    parity: Parity = "none"

    @property
    def bits(self) -> int:
        """Of one frame, from start to stop bit."""
        return DATA_BITS + (2 if self.parity == "none" else 3)


class Waveform:
    """The level of the line over time: `levels` of `bit_s` each, idle before and after."""

    def __init__(self, levels: Sequence[int], bit_s: float) -> None:
        self._levels, self._bit_s = levels, bit_s

    @property
    def end_s(self) -> float:
        """When the last bit is over."""
        return len(self._levels) * self._bit_s

    def at(self, t_s: float) -> int:
        """The level at a time."""
        index = int(t_s / self._bit_s) if t_s >= 0.0 else -1
        return self._levels[index] if 0 <= index < len(self._levels) else 1

    def next_fall_s(self, since_s: float) -> float | None:
        """When the line next goes from high to low at or after a time; None: never."""
        first = max(int(since_s / self._bit_s - 1e-9), 0)
        for index in range(first, len(self._levels)):
            before = self._levels[index - 1] if index else 1
            if before == 1 and self._levels[index] == 0 and index * self._bit_s >= since_s - 1e-12:
                return index * self._bit_s
        return None


def parity_bit(byte: int, parity: Parity) -> int:
    """The bit that makes the number of ones even, or odd."""
    ones = byte.bit_count() % 2
    return ones if parity == "even" else 1 - ones


def transmit(data: bytes, setting: Setting, gap_bits: int = 0) -> Waveform:
    """The line while bytes are sent, with `gap_bits` of idle line between them."""
    levels: list[int] = [1]
    for byte in data:
        levels.append(0)
        levels += [byte >> bit & 1 for bit in range(DATA_BITS)]
        if setting.parity != "none":
            levels.append(parity_bit(byte, setting.parity))
        levels += [1] * (1 + gap_bits)
    return Waveform(levels, 1.0 / setting.baud)


def receive(line: Waveform, setting: Setting) -> Iterator[Received]:
    """The frames that a receiver finds.

    A low stop bit is taken for the start bit of the next frame, as the 16550 and its many descendants do (NS16550
    data sheet, line status register, framing error), unless all was low: after such a break it waits for an edge.
    """
    bit_s = 1.0 / setting.baud
    now_s = 0.0
    begun_s: float | None = None
    while (start_s := begun_s if begun_s is not None else line.next_fall_s(now_s)) is not None:
        begun_s = None

        def level(bit: float, start_s: float = start_s) -> int:
            return line.at(start_s + (bit + 0.5) * bit_s)

        if level(0) == 1:  # shorter than half a bit: noise, not a start
            now_s = start_s + 0.5 * bit_s
            continue
        byte = sum(level(1 + bit) << bit for bit in range(DATA_BITS))
        parity_error = setting.parity != "none" and level(1 + DATA_BITS) != parity_bit(byte, setting.parity)
        stop = setting.bits - 1
        framing_error = level(stop) == 0
        yield Received(byte, framing_error, parity_error)
        if framing_error and byte:
            begun_s = start_s + stop * bit_s
        # The middle of the stop bit is where a receiver begins to look for the next edge.
        now_s = start_s + (stop + 0.5) * bit_s


def heard(data: bytes, sent: Setting, read: Setting, gap_bits: int = 0) -> bytes:
    """What a program on Linux reads: with parity checking on, a byte that fails it or its stop bit is NUL."""
    if sent == read:
        return data
    return bytes(
        0 if read.parity != "none" and (frame.framing_error or frame.parity_error) else frame.byte
        for frame in receive(transmit(data, sent, gap_bits), read)
    )
