"""What a receiver makes of a serial line that it reads at another speed or with another parity than it was sent.

The line idles high. A frame is a low start bit, eight data bits with the least significant first, a parity bit if any,
and a high stop bit. The receiver samples each bit in its middle, as a UART does, from the falling edge that begins a
frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
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


def parity_bit(byte: int, parity: Parity) -> int:
    """Return the bit that makes the number of ones even, or odd."""
    ones = byte.bit_count() % 2
    return ones if parity == "even" else 1 - ones


def transmit(data: bytes, setting: Setting, gap_bits: int = 0) -> list[int]:
    """Return the levels of the line, one a bit, with `gap_bits` of idle line between bytes."""
    levels = [1]
    for byte in data:
        levels += [0, *(byte >> bit & 1 for bit in range(DATA_BITS))]
        if setting.parity != "none":
            levels.append(parity_bit(byte, setting.parity))
        levels += [1] * (1 + gap_bits)
    return levels


def receive(levels: list[int], sent_baud: int, setting: Setting) -> Iterator[Received]:
    """Yield the frames that a receiver finds.

    A low stop bit is taken for the start bit of the next frame, as the 16550 and its many descendants do (NS16550
    data sheet, line status register, framing error), unless all was low: after such a break it waits for an edge.
    """
    step = sent_baud / setting.baud  # bits of the line for one of the receiver's
    stop = DATA_BITS + (1 if setting.parity == "none" else 2)
    now, begun = 0.0, None
    while True:
        first = max(math.ceil(now - 1e-9), 1)
        falls = (at for at in range(first, len(levels)) if levels[at - 1] and not levels[at])
        start = begun if begun is not None else next(falls, None)
        begun = None
        if start is None:
            return

        def level(bit: int, start: float = start) -> int:
            at = int(start + (bit + 0.5) * step + 1e-9)
            return levels[at] if at < len(levels) else 1

        if level(0) == 1:  # shorter than half a bit: noise, not a start
            now = start + 0.5 * step
            continue
        byte = sum(level(1 + bit) << bit for bit in range(DATA_BITS))
        parity_error = setting.parity != "none" and level(1 + DATA_BITS) != parity_bit(byte, setting.parity)
        framing_error = level(stop) == 0
        yield Received(byte, framing_error, parity_error)
        if framing_error and byte:
            begun = start + stop * step
        # The middle of the stop bit is where a receiver begins to look for the next edge.
        now = start + (stop + 0.5) * step


def heard(data: bytes, sent: Setting, read: Setting, gap_bits: int = 0) -> bytes:
    """Return what a program on Linux reads: with parity checking on, a byte that fails it or its stop bit is NUL."""
    if sent == read:
        return data
    return bytes(
        0 if read.parity != "none" and (frame.framing_error or frame.parity_error) else frame.byte
        for frame in receive(transmit(data, sent, gap_bits), sent.baud, read)
    )
