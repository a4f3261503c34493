"""What a MAVLink frame is, in the common case: version 2, unsigned, whole, its checksum right.

pymavlink has to decode a message to tell its name; an autopilot sends hundreds a second, most of which nobody here
wants. Format: MAVLink developer guide, "Packet Serialization".
"""

from __future__ import annotations

from typing import Final

from pymavlink.dialects.v20 import ardupilotmega as mavlink

Codec = mavlink.MAVLink
Message = mavlink.MAVLink_message
Kind = type[Message]

HEADER_BYTES: Final = 10
CHECKSUM_BYTES: Final = 2
MARKER: Final = 0xFD
KINDS: Final[dict[int, Kind]] = mavlink.mavlink_map
_EXTRA: Final[dict[Kind, bytes]] = {}
_STREAM_NAMES: Final = (
    "AHRS", "AHRS2", "AIRSPEED_AUTOCAL", "ALTITUDE", "ATTITUDE", "ATTITUDE_QUATERNION", "ATTITUDE_TARGET",
    "BATTERY_STATUS", "EKF_STATUS_REPORT", "ESTIMATOR_STATUS", "GLOBAL_POSITION_INT", "GPS2_RAW", "GPS_RAW_INT",
    "HIGHRES_IMU", "HWSTATUS", "LOCAL_POSITION_NED", "MEMINFO", "NAV_CONTROLLER_OUTPUT", "ODOMETRY",
    "POSITION_TARGET_GLOBAL_INT", "POSITION_TARGET_LOCAL_NED", "POWER_STATUS", "RANGEFINDER", "RAW_IMU",
    "RC_CHANNELS", "RC_CHANNELS_RAW", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3", "SCALED_PRESSURE",
    "SCALED_PRESSURE2", "SERVO_OUTPUT_RAW", "SYS_STATUS", "TERRAIN_REPORT", "VFR_HUD", "VIBRATION", "WIND",
    "WIND_COV",
)  # fmt: skip
STREAMS: Final = frozenset(getattr(mavlink, f"MAVLINK_MSG_ID_{name}") for name in _STREAM_NAMES)
"""Sent again and again, each the successor of the one before: nobody asks something with them or waits for one."""
AHEAD: Final = frozenset(
    {mavlink.MAVLINK_MSG_ID_TIMESYNC, mavlink.MAVLINK_MSG_ID_COMMAND_LONG, mavlink.MAVLINK_MSG_ID_COMMAND_INT}
)
"""Asked of us, and answered from what is known anyway, ahead of telemetry that waits. Not so parameters, heartbeats and
answers: what was measured before them was measured under other offsets, or before arming."""


def may_wait(datagram: bytes) -> bool:
    """Whether there are whole unsigned frames of streams in it and nothing else; nobody has checked their sums."""
    return _holds_only(datagram, STREAMS)


def goes_ahead(datagram: bytes) -> bool:
    """Whether there are such frames of `AHEAD` in it and nothing else."""
    return _holds_only(datagram, AHEAD)


def _holds_only(datagram: bytes, numbers: frozenset[int]) -> bool:
    at = 0
    while (found := _frame_at(datagram, at)) is not None:
        number, at = found
        if number not in numbers:
            return False
    return 0 < at == len(datagram)


def _frame_at(data: bytes, at: int) -> tuple[int, int] | None:
    """The message's number and the end of a whole unsigned frame of version 2; nobody has checked its sum."""
    size = len(data)
    if size - at < HEADER_BYTES + CHECKSUM_BYTES or data[at] != MARKER or data[at + 2]:
        return None
    end = at + HEADER_BYTES + data[at + 1] + CHECKSUM_BYTES
    return None if end > size else (data[at + 7] | data[at + 8] << 8 | data[at + 9] << 16, end)


def kind_at(data: bytes, at: int) -> tuple[Kind, int] | None:
    """Which message begins there and where it ends; None where it is not the common case."""
    found = _frame_at(data, at)
    if found is None:
        return None
    number, end = found
    kind = KINDS.get(number)
    if kind is None:
        return None
    extra = _EXTRA.get(kind)
    if extra is None:
        extra = _EXTRA[kind] = bytes((kind.crc_extra,))
    checksum = mavlink.x25crc(data[at + 1 : end - 2] + extra).crc
    return (kind, end) if checksum == data[end - 2] | data[end - 1] << 8 else None
