"""ArduPilot's JSON simulator interface, bytes only (the interface's own description and autopilots 9.3).

The firmware sends its servo outputs, one packet a frame, and waits for one answer: a line of JSON with the physics
time and what the IMU feels. Its reader looks for names in the text, takes the first match, and needs a newline on
either side; it is no JSON parser, so the text below has a fixed order and no name that contains another.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from sim.sitl.samples import Sample

MAGIC_16, MAGIC_32 = 18458, 29569
_HEAD = struct.Struct("<HHI")
_CHANNELS = {MAGIC_16: struct.Struct("<16H"), MAGIC_32: struct.Struct("<32H")}


class ServoPacket(NamedTuple):
    """What the firmware sends every frame."""

    frame_rate_hz: int
    """The step it wants is the inverse of this."""
    frame_count: int
    """Grows by one with every answered frame; starts anew with the firmware. Sent again: the answer was not heard."""
    pwm_us: tuple[int, ...]
    """16 channels, or 32 with SERVO_32_ENABLE."""


def decode_servos(data: bytes) -> ServoPacket | None:
    """A servo packet, or None for anything else."""
    if len(data) < _HEAD.size:
        return None
    magic, rate, count = _HEAD.unpack_from(data)
    channels = _CHANNELS.get(magic)
    if channels is None or len(data) != _HEAD.size + channels.size or rate == 0:
        return None
    return ServoPacket(rate, count, channels.unpack_from(data, _HEAD.size))


def encode_frame(physics_s: float, sample: Sample) -> bytes:
    """The answer: the first IMU of the sample, the true attitude, and a vehicle that stays at its home position."""
    return (
        b'\n{"timestamp":%.6f,"imu":{"gyro":[%.9g,%.9g,%.9g],"accel_body":[%.9g,%.9g,%.9g]},'
        b'"position":[0,0,0],"attitude":[%.8f,%.8f,%.8f],"velocity":[0,0,0]}\n'
        % (physics_s, *sample.readings[0], *sample.angles_rad)
    )
