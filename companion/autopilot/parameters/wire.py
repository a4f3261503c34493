"""Encoding of a parameter on the wire: a 32 bit float, which both autopilots keep (autopilots 7.5).

ArduPilot sends every value as a number and ignores the type it is sent back. PX4 puts the bytes of an integer into
the float field, and refuses a PARAM_SET whose type is not the parameter's own.
"""

from __future__ import annotations

import math
import struct
from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink


def float32(value: float) -> float:
    """The nearest 32 bit float; infinite when there is none."""
    try:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        return math.copysign(math.inf, value)


def same_float32(one: float, other: float) -> bool:
    """Compare two numbers as 32 bit floats, to within 1 ulp; NaN equals nothing."""
    if not (math.isfinite(one) and math.isfinite(other)):
        return False
    return abs(_rank(one) - _rank(other)) <= 1


def _rank(value: float) -> int:
    """The position of a float among all 32 bit floats in order; both zeros are 0."""
    bits: int = struct.unpack("<i", struct.pack("<f", value))[0]
    return bits if bits >= 0 else -(bits & 0x7FFFFFFF)


INTEGER_FORMATS: Final[dict[int, str]] = {
    mavlink.MAV_PARAM_TYPE_UINT8: "<B",
    mavlink.MAV_PARAM_TYPE_INT8: "<b",
    mavlink.MAV_PARAM_TYPE_UINT16: "<H",
    mavlink.MAV_PARAM_TYPE_INT16: "<h",
    mavlink.MAV_PARAM_TYPE_UINT32: "<I",
    mavlink.MAV_PARAM_TYPE_INT32: "<i",
}
_HEADER_BYTES: Final = {0xFE: 6, 0xFD: 10}
"""Length of the header of MAVLink 1 and 2, by the first byte of a packet."""

REAL32: Final[int] = mavlink.MAV_PARAM_TYPE_REAL32


def decode(message: mavlink.MAVLink_param_value_message, *, bytewise: bool) -> float:
    """The value that a PARAM_VALUE means; integers of 32 bits are exact in a Python float."""
    if not bytewise or message.param_type not in INTEGER_FORMATS:
        return float(message.param_value)
    # The bytes as they came: a float that is no number would lose some of its bits on the way through one. The value
    # is the first field of the payload (param_value float, count, index, id, type).
    packet = bytes(message.get_msgbuf() or b"")
    start = _HEADER_BYTES.get(packet[0], len(packet)) if packet else 0
    carried = packet[start : start + 4] or struct.pack("<f", message.param_value)
    return float(struct.unpack_from(INTEGER_FORMATS[message.param_type], carried.ljust(4, b"\0"))[0])


def encode(value: float, kind: int, *, bytewise: bool) -> float | None:
    """The float that carries a value as a type; None when none can (a fraction, out of range, no number)."""
    if not bytewise or kind not in INTEGER_FORMATS:
        return value
    form = INTEGER_FORMATS[kind]
    try:
        if value != int(value):
            return None
        carried = struct.pack(form, int(value)).ljust(4, b"\0")
    except (struct.error, OverflowError, ValueError):
        return None
    number: float = struct.unpack("<f", carried)[0]
    # A pattern that stands for a signalling NaN does not survive as a float.
    return number if struct.pack("<f", number) == carried else None
