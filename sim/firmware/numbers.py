"""Numbers of small computers, and the numbered board orientations of MAVLink."""

from __future__ import annotations

import struct

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sim.earth import Array, mounting_matrix


def float32(value: float) -> float:
    """Round to the nearest float32."""
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


def truncated_16(value: float) -> int:
    """Convert as C does from float to int16: toward zero, saturated."""
    return int(max(-32768.0, min(32767.0, value)))


_FINE_DEG = {68.0: 68.8, 293.0: 293.3}
_PREFIX = "MAV_SENSOR_ROTATION_"
_NOT_IN_MAVLINK = {41: (0.0, 7.0, 0.0), 42: (45.0, 0.0, 0.0), 43: (315.0, 0.0, 0.0)}


def rotation_matrix(number: int) -> Array:
    """Return the rotation from board to vehicle for a MAV_SENSOR_ORIENTATION below 100; unknown number: none."""
    if number in _NOT_IN_MAVLINK:
        return mounting_matrix(*_NOT_IN_MAVLINK[number])
    entry = mavlink.enums["MAV_SENSOR_ORIENTATION"].get(number)
    if entry is None or number >= 100:
        return np.eye(3)
    words = entry.name.removeprefix(_PREFIX).split("_")
    angles = {word: float(value) for word, value in zip(words[0::2], words[1::2], strict=False)}
    roll, pitch, yaw = (_FINE_DEG.get(angle, angle) for angle in (angles.get(w, 0.0) for w in ("ROLL", "PITCH", "YAW")))
    return mounting_matrix(roll, pitch, yaw)
