"""Numbers as small computers make them."""

from __future__ import annotations

import struct


def float32(value: float) -> float:
    """The nearest float32, as everything the autopilot stores."""
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


def truncated_16(value: float) -> int:
    """A C conversion of float to int16: toward zero; what does not fit is cut at the ends."""
    return int(max(-32768.0, min(32767.0, value)))
