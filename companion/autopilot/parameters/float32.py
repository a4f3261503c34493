"""Both autopilots keep their parameters as 32 bit floats, so that is what is compared."""

from __future__ import annotations

import math
import struct


def float32(value: float) -> float:
    """The nearest 32 bit float; infinite when there is none."""
    try:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        return math.copysign(math.inf, value)


def same_float32(one: float, other: float) -> bool:
    """Whether two numbers are the same 32 bit float to within 1 ulp; NaN is never the same."""
    if not (math.isfinite(one) and math.isfinite(other)):
        return False
    return abs(_rank(one) - _rank(other)) <= 1


def _rank(value: float) -> int:
    """The position of a float among all 32 bit floats in order; both zeros are 0."""
    bits: int = struct.unpack("<i", struct.pack("<f", value))[0]
    return bits if bits >= 0 else -(bits & 0x7FFFFFFF)
